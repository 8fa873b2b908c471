"""Rules for the share of time that training keeps while pictures are drawn. One file per rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from nerf_core.common.registry import Registry


@dataclass(frozen=True)
class Situation:
    """What a rule may look at.

    moving: whether a camera moves.
    exporting: whether a file is being rendered.
    """

    moving: bool
    exporting: bool


class ShareRule(Protocol):
    """A rule for the share.

    label: the name in menus.
    tip: a sentence on what the rule does.
    """

    label: ClassVar[str]
    tip: ClassVar[str]

    @staticmethod
    def share(wanted: float, now: Situation) -> float:
        """Return the share of the time that training gets now, 0.05 … 0.95.

        Args:
            wanted: the share that the user asked for.
            now: the situation.
        """
        ...


SHARES: Registry[type[ShareRule]] = Registry("share rule", "nerf_core.live.shares")
DEFAULT_SHARE = "steady"
