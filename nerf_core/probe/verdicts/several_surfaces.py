"""Several surfaces: layers that photos confirm, one behind the other, such as a veil in front of a wall."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import listed, marked, phrase, phrases
from nerf_core.probe.standing import Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register(marked("several surfaces"))
class SeveralSurfaces:
    rank: ClassVar[int] = 50
    tone: ClassVar[Tone] = "good"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        if len(facts.real) < 2:
            return ()
        parts = listed(phrase("{weight:.0%} at {t:.3g}", weight=s.layer.weight, t=s.layer.t) for s in facts.real)
        count = len(facts.real)
        return (
            phrases("{n} layer makes the pixel: {parts}", "{n} layers make the pixel: {parts}", count, parts=parts),
        )
