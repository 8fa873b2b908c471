"""Several surfaces: layers that photos confirm, one behind the other, such as a veil in front of a wall."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.probe.standing import Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register("several surfaces")
class SeveralSurfaces:
    rank: ClassVar[int] = 50
    tone: ClassVar[Tone] = "good"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        if len(facts.real) < 2:
            return ()
        parts = ", ".join(f"{s.layer.weight:.0%} at {s.layer.t:.3g}" for s in facts.real)
        return (f"{len(facts.real)} layers make the pixel: {parts}",)
