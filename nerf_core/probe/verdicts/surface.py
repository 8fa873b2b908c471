"""Surface: one layer makes the pixel. This class holds if no other does."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked, phrase, phrases
from nerf_core.probe.standing import WRONG, Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register(marked("surface"))
class Surface:
    rank: ClassVar[int] = 60
    tone: ClassVar[Tone] = "good"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        surface = facts.surface
        if surface is None:
            return ()
        inner = [s for s in facts.heavy if not s.floats and s is not surface]
        return (_surface_reason(surface), *map(_inner_reason, inner))


def _inner_reason(s: Standing) -> str:
    if s.training_views == 0:
        seen = phrase("no photo sees it from this side")
    else:
        seen = phrases("one photo sees it from this side", "{n} photos see it from this side", s.training_views)
    return phrase(
        "another {weight:.0%} shines through it, from {t:.3g}, where {seen}",
        weight=s.layer.weight,
        t=s.layer.t,
        seen=seen,
    )


def _surface_reason(s: Standing) -> str:
    if s.error is None:
        error = ""
    elif s.error < WRONG:
        error = phrase(", with an error of {error:.3f}", error=s.error)
    else:
        error = phrase(", with an error of {error:.3f}: there is something, but its colour is wrong", error=s.error)
    return phrases(
        "one layer at {t:.3g}, {thick:.2g} thick, makes {weight:.0%} of the pixel; {n} training photo sees it from "
        "this side{error}",
        "one layer at {t:.3g}, {thick:.2g} thick, makes {weight:.0%} of the pixel; {n} training photos see it from "
        "this side{error}",
        s.training_views,
        t=s.layer.t,
        thick=s.layer.thickness,
        weight=s.layer.weight,
        error=error,
    )
