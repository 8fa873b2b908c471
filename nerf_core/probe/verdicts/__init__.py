"""The classes of verdicts on a pixel: one file each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from nerf_core.common.registry import Registry
from nerf_core.probe.records import RayProbe
from nerf_core.probe.standing import Standing, Tone

NOTHING = 0.05  # opacity under which a ray has met nothing that one could see
ALIKE, NOISE = 0.01, 0.25  # mean error of a channel, and share of a photo's own: the larger is no difference
COUNTS = 0.1  # weight of a layer that is worth a verdict, in this pixel and in a photo's


@dataclass(frozen=True)
class Facts:
    """What a class judges by: the ray, and what the photos say of its layers, front to back.

    heavy: the layers worth a verdict. floaters: those of them that float. real: those that neither float nor are the
    inside of another. surface: the heaviest of these, if there is one. thin: the share of the layers' weight that lies
    in layers that are not hazy.
    """

    ray: RayProbe
    standings: tuple[Standing, ...]

    @cached_property
    def heavy(self) -> list[Standing]:
        return [s for s in self.standings if s.layer.weight >= COUNTS]

    @cached_property
    def floaters(self) -> list[Standing]:
        return [s for s in self.heavy if s.floats]

    @cached_property
    def real(self) -> list[Standing]:
        return outer(self.standings)

    @cached_property
    def surface(self) -> Standing | None:
        return max(self.real, key=lambda s: s.layer.weight, default=None)

    @cached_property
    def thin(self) -> float:
        whole = sum(s.layer.weight for s in self.standings)
        return sum(s.layer.weight for s in self.standings if not s.hazy) / max(whole, 1e-12)


class VerdictClass(Protocol):
    """A class of verdicts. Classes are asked by ascending rank, the worst first, and the first that holds is taken.

    tone: the colour in which the window shows its name.
    """

    rank: ClassVar[int]
    tone: ClassVar[Tone]

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        """Why the pixel is of this class, a line each, with numbers; empty where it is not."""
        ...


VERDICTS: Registry[type[VerdictClass]] = Registry("verdict", "nerf_core.probe.verdicts")


def outer(standings: Iterable[Standing]) -> list[Standing]:
    """The layers of weight that neither float nor are another's inside, front to back."""
    found: list[Standing] = []
    for s in standings:
        if s.layer.weight >= COUNTS and not s.floats and not any(s.inside(front) for front in found):
            found.append(s)
    return found


def tolerance(error: Any) -> Any:
    """What differs from an error (or each of an array) by less is as good."""
    return np.maximum(ALIKE, NOISE * error)
