"""The classes of verdicts on a pixel, one file each, and what they share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from nerf_core.common.registry import Registry
from nerf_core.probe.records import RayProbe
from nerf_core.probe.standing import Standing, Tone

NOTHING = 0.05  # under this opacity a ray has hit nothing visible
ALIKE, NOISE = 0.01, 0.25  # two errors are equal if they differ by less than ALIKE, or than NOISE times the error
COUNTS = 0.1  # a layer counts, in the ray's pixel or in a photo's, if it weighs at least this


@dataclass(frozen=True)
class Facts:
    """What a class of verdicts judges by.

    ray: the opened ray.
    standings: its heaviest layers from front to back, with what the photos say about each.
    """

    ray: RayProbe
    standings: tuple[Standing, ...]

    @cached_property
    def heavy(self) -> list[Standing]:
        """The layers that weigh at least COUNTS, front to back."""
        return [s for s in self.standings if s.layer.weight >= COUNTS]

    @cached_property
    def floaters(self) -> list[Standing]:
        """The heavy layers that float, front to back."""
        return [s for s in self.heavy if s.floats]

    @cached_property
    def real(self) -> list[Standing]:
        """The heavy layers that neither float nor are another's inside, front to back."""
        return outer(self.standings)

    @cached_property
    def surface(self) -> Standing | None:
        """The heaviest of the real layers; None if there is none."""
        return max(self.real, key=lambda s: s.layer.weight, default=None)

    @cached_property
    def thin(self) -> float:
        """The share of the layers' weight that lies in layers that are not hazy."""
        whole = sum(s.layer.weight for s in self.standings)
        return sum(s.layer.weight for s in self.standings if not s.hazy) / max(whole, 1e-12)


class VerdictClass(Protocol):
    """A class of verdicts. The verdict is the first class, by ascending rank, that gives reasons.

    rank: the place in that order. The background comes first, then the faults, then what is in order.
    tone: how good or bad this is; it chooses the colour in which the window shows the verdict.
    """

    rank: ClassVar[int]
    tone: ClassVar[Tone]

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        """Return lines that say, with numbers, why the pixel is of this class; empty if it is not.

        A line may be a phrase (`nerf_core.common.language`), which the window says in its language.
        """
        ...


VERDICTS: Registry[type[VerdictClass]] = Registry("verdict", "nerf_core.probe.verdicts")


def outer(standings: Iterable[Standing]) -> list[Standing]:
    """Choose the layers that weigh at least COUNTS and neither float nor are another's inside.

    standings: layers from front to back; the result is in the same order.
    """
    found: list[Standing] = []
    for s in standings:
        if s.layer.weight >= COUNTS and not s.floats and not any(s.inside(front) for front in found):
            found.append(s)
    return found


def tolerance(error: Any) -> Any:
    """Return by how much another error must differ from `error` to be different: max(ALIKE, NOISE · error).

    error: a number or an array; the result is of the same kind.
    """
    return np.maximum(ALIKE, NOISE * error)
