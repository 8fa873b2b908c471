"""Floater: a layer that the photos contradict."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import listed, marked, phrase, phrases
from nerf_core.probe.standing import Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts, tolerance


@VERDICTS.register(marked("floater"))
class Floater:
    rank: ClassVar[int] = 10
    tone: ClassVar[Tone] = "warning"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        return tuple(map(_floater_reason, facts.floaters))


def _floater_reason(s: Standing) -> str:
    votes = [
        *([phrases("{n} contradict it", "{n} contradict it", s.against)] if s.against else []),
        *([phrases("{n} do not show it", "{n} do not show it", s.blank)] if s.blank else []),
        *([phrases("{n} would miss it", "{n} would miss it", s.missing)] if s.missing else []),
    ]
    *rest, last = votes
    better = s.error is not None and s.without is not None and s.without < s.error - tolerance(s.error)
    return phrases(
        "a layer at {t:.3g} makes {weight:.0%} of the pixel, but of {n} photo that sees it {votes}{error}",
        "a layer at {t:.3g} makes {weight:.0%} of the pixel, but of {n} photos that see it {votes}{error}",
        s.voters,
        t=s.layer.t,
        weight=s.layer.weight,
        votes=phrase("{rest} and {last}", rest=listed(rest), last=last) if rest else last,
        error=phrase(": error {error:.3f}, without it {without:.3f}", error=s.error, without=s.without)
        if better
        else "",
    )
