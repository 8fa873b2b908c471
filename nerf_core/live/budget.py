"""Divide the worker's time between training and pictures.

It is done by measured seconds, which fade: their weight halves every HALF_LIFE_SECONDS.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

HALF_LIFE_SECONDS = 2.0  # short, so that a long idle time is not followed by a long burst
PATIENCE_SECONDS = 1 / 4  # the longest wait for the next picture while the camera moves


def kept(seconds: float) -> float:
    """Return the share of an account that is left after `seconds`: ½ to the power of seconds / HALF_LIFE_SECONDS."""
    return 0.5 ** (seconds / HALF_LIFE_SECONDS)


@dataclass
class Account:
    """The training of one run lately.

    seconds: seconds of training, fading.
    rays: rays that it was trained on, fading.
    clock: returns the time in seconds.
    """

    seconds: float = 0.0
    rays: float = 0.0
    clock: Callable[[], float] = time.monotonic
    _last: float = field(init=False)

    def __post_init__(self) -> None:
        self._last = self.clock()

    def add(self, seconds: float, rays: int) -> None:
        """Add a piece of training."""
        self.fade()
        self.seconds += seconds
        self.rays += rays

    def fade(self) -> None:
        """Reduce seconds and rays by what has faded until now."""
        now = self.clock()
        keep, self._last = kept(now - self._last), now
        self.seconds, self.rays = self.seconds * keep, self.rays * keep


class Budget:
    """Decides whether to draw or to train.

    While pictures are wanted, training keeps `share` of the time. If none is wanted, it has all the time. The window's
    frames count as pictures.

    share: the share of training, 0.05 … 0.95. It may be set at any time.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with empty accounts.

        Args:
            share: the share of training, 0.05 … 0.95.
            clock: returns the time in seconds.
        """
        self.share = share
        self._clock = clock
        self._last = clock()
        self._train = self._draw = 0.0
        self._turns = 0
        self._next_at = self._last  # when a moving camera's next picture may begin

    def trained(self, seconds: float) -> None:
        """Note that training took `seconds`."""
        self._fade()
        self._train += seconds

    def drew(self, seconds: float) -> None:
        """Note that a piece of a preview or export took `seconds`. This also ends its turn."""
        self._fade()
        self._draw += seconds
        self._turns += 1

    def showed(self, seconds: float) -> None:
        """Note that the handing over of pictures, or a frame of the window, took `seconds`."""
        self._fade()
        self._draw += seconds

    def may_draw(self) -> bool:
        """Return whether drawing used at most its share of the time lately."""
        return self._draw * self.share <= self._train * (1 - self.share)

    def frame_share(self) -> float:
        """Return the share of pictures of a moving camera: half of what training leaves.

        The window's frames take the other half.
        """
        return (1 - self.share) / 2

    def followed(self, seconds: float) -> None:
        """Note that the first pixels of a new view took `seconds`.

        They may exceed drawing's share, so the next ones wait: until they and the wait together match `frame_share`,
        but at most PATIENCE_SECONDS.
        """
        self._next_at = self._clock() + min(seconds * (1 / self.frame_share() - 1), PATIENCE_SECONDS)

    def may_follow(self) -> bool:
        """Return whether the next picture of a moving camera may begin.

        Such pictures take `frame_share` of the time, and more if drawing has not used its share.
        """
        return self._clock() >= self._next_at or self.may_draw()

    def artist_is_next(self) -> bool:
        """Return whether it is the preview's turn. Preview and export take turns."""
        return self._turns % 2 == 0

    def total(self) -> float:
        """Return the seconds of training and drawing lately, as they fade."""
        self._fade()
        return self._train + self._draw

    def train_share(self) -> float:
        """Return the measured share of training lately, in [0, 1]; 0 if nothing was done."""
        total = self.total()
        return self._train / total if total > 0 else 0.0

    def _fade(self) -> None:
        now = self._clock()
        keep, self._last = kept(now - self._last), now
        self._train, self._draw = self._train * keep, self._draw * keep
