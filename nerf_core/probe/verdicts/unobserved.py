"""Unobserved: fewer than two photos see the surface from this side, or confirm it."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.probe.standing import FEW, Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register("unobserved")
class Unobserved:
    rank: ClassVar[int] = 20
    tone: ClassVar[Tone] = "warning"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        surface = facts.surface
        if surface is None or min(surface.training_views, max(surface.shown, surface.missing)) >= FEW:
            return ()
        return (_unobserved_reason(surface),)


def _unobserved_reason(s: Standing) -> str:
    if s.training_views >= FEW:
        shown = "one shows it" if s.shown else "none shows it"
        return f"of {s.voters} training photos that see the point at {s.layer.t:.3g}, {shown}"
    seen = {0: "no training photo sees", 1: "one training photo alone sees"}[s.training_views]
    return (
        f"{seen} the point at {s.layer.t:.3g} from this side ({s.sightings.framed} of {s.sightings.asked} have it in "
        f"their frame, {s.looked} see it from anywhere)"
    )
