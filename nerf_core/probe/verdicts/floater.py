"""Floater: a layer that the photos contradict."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.probe.standing import Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts, tolerance


@VERDICTS.register("floater")
class Floater:
    rank: ClassVar[int] = 10
    tone: ClassVar[Tone] = "warning"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        return tuple(map(_floater_reason, facts.floaters))


def _floater_reason(s: Standing) -> str:
    said = ((s.against, "contradict it"), (s.blank, "do not show it"), (s.missing, "would miss it"))
    *rest, last = [f"{count} {what}" for count, what in said if count]
    votes = f"{', '.join(rest)} and {last}" if rest else last
    better = s.error is not None and s.without is not None and s.without < s.error - tolerance(s.error)
    error = f": error {s.error:.3f}, without it {s.without:.3f}" if better else ""
    layer = f"a layer at {s.layer.t:.3g} makes {s.layer.weight:.0%} of the pixel"
    return f"{layer}, but of {s.voters} photos that see it {votes}{error}"
