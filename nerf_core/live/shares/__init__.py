"""Rules for the share of time that training keeps while pictures are drawn: one file per rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from nerf_core.common.registry import Registry


@dataclass(frozen=True)
class Situation:
    """What a rule may look at. moving: the camera moves. exporting: a file is being rendered."""

    moving: bool
    exporting: bool


class ShareRule(Protocol):
    """label, tip: for menus."""

    label: ClassVar[str]
    tip: ClassVar[str]

    @staticmethod
    def share(wanted: float, now: Situation) -> float:
        """The share of the time, 0.05 … 0.95, that training gets now. wanted: what the user asked for."""
        ...


SHARES: Registry[type[ShareRule]] = Registry("share rule", "nerf_core.live.shares")
DEFAULT_SHARE = "steady"
