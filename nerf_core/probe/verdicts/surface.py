"""Surface: one layer makes the pixel. This class holds if no other does."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.probe.standing import WRONG, Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts


@VERDICTS.register("surface")
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
    seen = {0: "no photo sees", 1: "one photo sees"}.get(s.training_views, f"{s.training_views} photos see")
    return f"another {s.layer.weight:.0%} shines through it, from {s.layer.t:.3g}, where {seen} from this side"


def _surface_reason(s: Standing) -> str:
    error = "" if s.error is None else f", with an error of {s.error:.3f}"
    if s.error is not None and s.error >= WRONG:
        error += ": there is something, but its colour is wrong"
    return (
        f"one layer at {s.layer.t:.3g}, {s.layer.thickness:.2g} thick, makes {s.layer.weight:.0%} of the pixel; "
        f"{s.training_views} training photos see it from this side{error}"
    )
