"""How the worker's time is divided between training and pictures: an account, with decay, of measured seconds."""

from __future__ import annotations

import time
from collections.abc import Callable

MEMORY_SECONDS = 2.0  # the half-life of what the account remembers: yesterday's idle hour earns no burst today


PATIENCE_SECONDS = 1 / 4  # how long a hand that moves the camera waits at most for the next picture


class Budget:
    """While pictures are wanted, training keeps `share` of the time; with none wanted it has all of it.

    The window's frames count as pictures.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.share = share
        self._clock = clock
        self._last = clock()
        self._train = self._draw = self._rays = 0.0
        self._turns = 0
        self._next_at = self._last  # when a moving camera's next picture may begin

    def trained(self, seconds: float, rays: int) -> None:
        self._decay()
        self._train += seconds
        self._rays += rays

    def drew(self, seconds: float) -> None:
        self._decay()
        self._draw += seconds
        self._turns += 1

    def showed(self, seconds: float) -> None:
        """Spent on handing pictures over, or by the window on a frame."""
        self._decay()
        self._draw += seconds

    def may_draw(self) -> bool:
        """Whether drawing has used less than its part of what was spent lately."""
        return self._draw * self.share <= self._train * (1 - self.share)

    def followed(self, seconds: float) -> None:
        """So long took the first pixels of a new view, which were drawn whatever else drawing had used."""
        part = (1 - self.share) / 2
        self._next_at = self._clock() + min(seconds * (1 / part - 1), PATIENCE_SECONDS)

    def may_follow(self) -> bool:
        """Whether a moving camera's next picture may begin: such pictures take half of what training leaves, since
        the window's frames want the other half, or more while nothing else is drawn."""
        return self._clock() >= self._next_at or self.may_draw()

    def artist_is_next(self) -> bool:
        """Preview and export take turns."""
        return self._turns % 2 == 0

    def train_share(self) -> float:
        total = self._train + self._draw
        return self._train / total if total > 0 else 0.0

    def rays_per_second(self) -> float:
        """Rays trained on per second of wall time, pictures included."""
        total = self._train + self._draw
        return self._rays / total if total > 0 else 0.0

    def _decay(self) -> None:
        now = self._clock()
        keep = 0.5 ** ((now - self._last) / MEMORY_SECONDS)
        self._last = now
        self._train, self._draw, self._rays = self._train * keep, self._draw * keep, self._rays * keep
