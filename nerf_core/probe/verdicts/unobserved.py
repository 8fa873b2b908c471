"""Unobserved: fewer than two photos see the surface from this side, or confirm it."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked, phrase, phrases
from nerf_core.probe.standing import FEW, Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register(marked("unobserved"))
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
        shown = phrase("one shows it") if s.shown else phrase("none shows it")
        return phrases(
            "of {n} training photo that sees the point at {t:.3g}, {shown}",
            "of {n} training photos that see the point at {t:.3g}, {shown}",
            s.voters,
            t=s.layer.t,
            shown=shown,
        )
    seen = phrase("one training photo alone sees") if s.training_views else phrase("no training photo sees")
    return phrase(
        "{seen} the point at {t:.3g} from this side ({framed} of {asked} have it in their frame, {looked} see it from "
        "anywhere)",
        seen=seen,
        t=s.layer.t,
        framed=s.sightings.framed,
        asked=s.sightings.asked,
        looked=s.looked,
    )
