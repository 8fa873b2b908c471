"""How the worker's time is divided between training and pictures: measured seconds that fade."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

HALF_LIFE_SECONDS = 2.0  # of what an account remembers: yesterday's idle hour earns no burst today
PATIENCE_SECONDS = 1 / 4  # the longest that a hand which moves the camera waits for the next picture


def kept(seconds: float) -> float:
    """The share of an account that is left after `seconds`."""
    return 0.5 ** (seconds / HALF_LIFE_SECONDS)


@dataclass
class Account:
    """Training seconds and rays of one run, fading."""

    seconds: float = 0.0
    rays: float = 0.0
    clock: Callable[[], float] = time.monotonic
    _last: float = field(init=False)

    def __post_init__(self) -> None:
        self._last = self.clock()

    def add(self, seconds: float, rays: int) -> None:
        self.fade()
        self.seconds += seconds
        self.rays += rays

    def fade(self) -> None:
        """Bring seconds and rays up to now."""
        now = self.clock()
        keep, self._last = kept(now - self._last), now
        self.seconds, self.rays = self.seconds * keep, self.rays * keep


class Budget:
    """While pictures are wanted, training keeps `share` of the time; with none wanted it has all of it.

    The window's frames count as pictures.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.share = share
        self._clock = clock
        self._last = clock()
        self._train = self._draw = 0.0
        self._turns = 0
        self._next_at = self._last  # when a moving camera's next picture may begin

    def trained(self, seconds: float) -> None:
        self._fade()
        self._train += seconds

    def drew(self, seconds: float) -> None:
        self._fade()
        self._draw += seconds
        self._turns += 1

    def showed(self, seconds: float) -> None:
        """Spent on handing pictures over, or by the window on a frame."""
        self._fade()
        self._draw += seconds

    def may_draw(self) -> bool:
        """Whether drawing used less than its share of the time lately."""
        return self._draw * self.share <= self._train * (1 - self.share)

    def frame_share(self) -> float:
        """Half of what training leaves: frames of the window take one half, pictures the other."""
        return (1 - self.share) / 2

    def followed(self, seconds: float) -> None:
        """The first pixels of a new view took so long; they are drawn whatever else drawing used."""
        self._next_at = self._clock() + min(seconds * (1 / self.frame_share() - 1), PATIENCE_SECONDS)

    def may_follow(self) -> bool:
        """Whether a moving camera's next picture may begin.

        Such pictures take half of what training leaves, since the window's frames take the other half; more while
        nothing else is drawn.
        """
        return self._clock() >= self._next_at or self.may_draw()

    def artist_is_next(self) -> bool:
        """Preview and export take turns."""
        return self._turns % 2 == 0

    def total(self) -> float:
        """Seconds of training and drawing lately."""
        self._fade()
        return self._train + self._draw

    def train_share(self) -> float:
        """The measured share of training lately."""
        total = self.total()
        return self._train / total if total > 0 else 0.0

    def _fade(self) -> None:
        now = self._clock()
        keep, self._last = kept(now - self._last), now
        self._train, self._draw = self._train * keep, self._draw * keep
