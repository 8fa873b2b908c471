"""Training keeps the share that the user asked for."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked
from nerf_core.live.shares import DEFAULT_SHARE, SHARES, Situation


@SHARES.register(DEFAULT_SHARE)
class Steady:
    """The same share in every situation."""

    label: ClassVar[str] = marked("Steady")
    tip: ClassVar[str] = marked("training keeps its share whatever the camera does")

    @staticmethod
    def share(wanted: float, now: Situation) -> float:
        return wanted
