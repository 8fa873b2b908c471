"""Background leak: the background shows through a layer that is opaque by the photos."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked, phrases
from nerf_core.probe.standing import Standing, Tone
from nerf_core.probe.verdicts import VERDICTS, Facts

LEAK = 0.1  # the background shows if the transmittance of the whole ray is at least this


@VERDICTS.register(marked("background leak"))
class BackgroundLeak:
    rank: ClassVar[int] = 30
    tone: ClassVar[Tone] = "warning"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        left = 1 - facts.ray.opacity
        # the last, which may be the far wall of something hollow, seen from inside: a veil in front leaks, too
        leaking = next((s for s in reversed(facts.heavy) if s.leaks and not s.floats), None)
        return (_leak_reason(leaking, left),) if left >= LEAK and leaking is not None else ()


def _leak_reason(s: Standing, left: float) -> str:
    return phrases(
        "{left:.0%} of what is behind shows through the layer at {t:.3g}; if no background did, the median error of "
        "{n} photo that shows it would be {opaque:.3f} instead of {error:.3f}",
        "{left:.0%} of what is behind shows through the layer at {t:.3g}; if no background did, the median error of "
        "{n} photos that show it would be {opaque:.3f} instead of {error:.3f}",
        s.shown,
        left=left,
        t=s.layer.t,
        opaque=s.opaque,
        error=s.error,
    )
