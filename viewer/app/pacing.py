"""When to draw: at once for the hand, seldom for figures, never for nothing. Every frame costs training its CPU."""

from __future__ import annotations

FASTEST = 1 / 60  # seconds between frames while a hand moves something
SLOWEST = 1 / 15  # and when frames would take more than their part of the time
PICTURE = 1 / 10  # while the picture sharpens by itself: in software GL a frame takes 20 ms of a core
FIGURES = 1 / 5  # live plots and counts
UNWATCHED = 1.0  # both, where nobody looks: offscreen, all time belongs to training
SETTLE_FRAMES = 3  # imgui takes input over several frames: hover, then press, then what that opened
SETTLE_SECONDS = 0.7  # tooltips wait for the pointer to rest
SETTLE_GAP = 1 / 10


class Pacer:
    """Pure logic; the caller hands in the time in seconds. watched: whether there is a screen."""

    def __init__(self, watched: bool = True) -> None:
        self._picture_gap, self._figures_gap = (PICTURE, FIGURES) if watched else (UNWATCHED, UNWATCHED)
        self._hand_gap = FASTEST
        self._cost = 0.0  # seconds that a frame takes, of late
        self._drawn_at = -float("inf")
        self._input_at = -float("inf")
        self._settling = 0
        self._hand = self._answer = self._picture = self._figures = False

    def note(
        self, now: float, *, hand: bool = False, answer: bool = False, picture: bool = False, figures: bool = False
    ) -> None:
        """hand: input, or a movement under way; answer: what a click asked for is there; picture: a new preview;
        figures: anything else that is new."""
        if hand:
            self._input_at = now
            self._settling = SETTLE_FRAMES
        self._hand |= hand
        self._answer |= answer
        self._picture |= picture
        self._figures |= figures

    def due(self, now: float) -> bool:
        gap = self._gap(now)
        return gap is not None and now - self._drawn_at >= gap

    def wait(self, now: float) -> float:
        """Seconds until the next look: until a frame is due, else until something could be new."""
        gap = self._gap(now)
        return PICTURE if gap is None else min(max(0.0, self._drawn_at + gap - now), PICTURE)

    def drew(self, now: float, seconds: float = 0.0, part: float = 1.0) -> None:
        """A frame, in so many seconds; part: of all time that frames may take while a hand moves something."""
        self._cost = 0.8 * self._cost + 0.2 * seconds
        self._hand_gap = min(max(FASTEST, self._cost / part), SLOWEST)
        self._drawn_at = now
        self._settling = max(0, self._settling - 1)
        self._hand = self._answer = self._picture = self._figures = False

    def _gap(self, now: float) -> float | None:
        if self._answer:
            return FASTEST
        if self._hand or self._settling:
            return FASTEST if self._picture else self._hand_gap
        if self._picture:
            return self._picture_gap
        if now - self._input_at < SETTLE_SECONDS:
            return SETTLE_GAP
        return self._figures_gap if self._figures else None
