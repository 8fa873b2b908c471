"""Decide when to draw a frame: at once after input, seldom for figures, never if nothing changed.

Every frame takes CPU time from training.
"""

from __future__ import annotations

FASTEST = 1 / 60  # seconds between frames while the user moves something
SLOWEST = 1 / 15  # the same when frames would take more than their share of the time
PICTURE = 1 / 10  # while the picture sharpens by itself: in software GL a frame takes 20 ms of a core
FIGURES = 1 / 5  # for live plots and counts
UNWATCHED = 1.0  # for pictures and figures offscreen, where nobody looks and all time belongs to training
SETTLE_FRAMES = 3  # imgui processes input over several frames: hover, then press, then what the press opened
SETTLE_SECONDS = 0.7  # tooltips wait until the pointer rests
SETTLE_GAP = 1 / 10


class Pacer:
    """Decides when to draw. The caller passes the time in seconds. watched: whether there is a screen."""

    def __init__(self, watched: bool = True) -> None:
        self._watched = watched
        self._picture_gap, self._figures_gap = (PICTURE, FIGURES) if watched else (UNWATCHED, UNWATCHED)
        self._user_gap = FASTEST
        self._cost = 0.0  # running mean of the seconds that a frame takes
        self._drawn_at = -float("inf")
        self._input_at = -float("inf")
        self._settling = 0
        self._user = self._answer = self._picture = self._fading = self._figures = False

    def note(
        self,
        now: float,
        *,
        user: bool = False,
        answer: bool = False,
        picture: bool = False,
        fading: bool = False,
        figures: bool = False,
    ) -> None:
        """Note what is new.

        user: input, or a movement under way.
        answer: the result of a click has arrived.
        picture: a new preview.
        fading: a picture that fades into another.
        figures: anything else.
        """
        if user:
            self._input_at = now
            self._settling = SETTLE_FRAMES
        self._user |= user
        self._answer |= answer
        self._picture |= picture
        self._fading |= fading
        self._figures |= figures

    def due(self, now: float) -> bool:
        gap = self._gap(now)
        return gap is not None and now - self._drawn_at >= gap

    def wait(self, now: float) -> float:
        """Return the seconds to wait: until a frame is due, or until the worker may have something new."""
        gap = self._gap(now)
        return PICTURE if gap is None else min(max(0.0, self._drawn_at + gap - now), PICTURE)

    def drew(self, now: float, seconds: float = 0.0, part: float = 1.0) -> None:
        """Note that a frame was drawn.

        seconds: how long it took.
        part: the share of all time that frames may take while the user moves something.
        """
        self._cost = 0.8 * self._cost + 0.2 * seconds
        self._user_gap = min(max(FASTEST, self._cost / part), SLOWEST)
        self._drawn_at = now
        self._settling = max(0, self._settling - 1)
        self._user = self._answer = self._picture = self._fading = self._figures = False

    def _gap(self, now: float) -> float | None:
        if self._answer:
            return FASTEST
        if self._user or self._settling:
            return FASTEST if self._picture else self._user_gap
        if self._fading:
            return self._user_gap if self._watched else self._picture_gap
        if self._picture:
            return self._picture_gap
        if now - self._input_at < SETTLE_SECONDS:
            return SETTLE_GAP
        return self._figures_gap if self._figures else None
