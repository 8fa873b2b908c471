"""What corrected the poses of training photos, as windows and reports show it. Only numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerf_core.common.language import listed, marked, phrases

UNTRIED, MOVED, REFUSED = range(3)
OUTCOMES = "untried", "moved", "refused"


@dataclass(frozen=True)
class PoseCorrections:
    """The corrections of N training photos.

    views: (N,) indices into `Scene.views`.
    given: (N, 3, 4) the poses of the capture.
    turned: (N,) by how much each camera is turned now, in degrees.
    shifted: (N,) how far it is moved, as a share of the scene's radius.
    outcome: (N,) of the last round of each photo: UNTRIED, MOVED, or REFUSED by the left-out pixels.
    rounds: the number of rounds.
    """

    views: np.ndarray
    given: np.ndarray
    turned: np.ndarray
    shifted: np.ndarray
    outcome: np.ndarray
    rounds: int

    @property
    def stayed(self) -> int:
        """The number of cameras of which no correction was ever kept."""
        return int(((self.turned == 0) & (self.shifted == 0)).sum())

    def summary(self) -> str:
        """Describe them in a line: how many cameras moved, how far (medians of those), and why the others did not."""
        if not self.rounds:
            return marked("not corrected yet")
        moved = (self.turned != 0) | (self.shifted != 0)
        untried = int((~moved & (self.outcome == UNTRIED)).sum())
        parts = []
        if moved.any():
            parts.append(
                phrases(
                    "{n:,} camera moved, by {degrees:.2g}° and {percent:.2%} of the radius",
                    "{n:,} cameras moved, by a median of {degrees:.2g}° and {percent:.2%} of the radius",
                    int(moved.sum()),
                    degrees=float(np.median(self.turned[moved])),
                    percent=float(np.median(self.shifted[moved])),
                )
            )
        if (stayed := self.stayed - untried) > 0:
            parts.append(
                phrases(
                    "{n:,} camera stayed where it was: pixels left out of the fit agreed no better elsewhere",
                    "{n:,} cameras stayed where they were: pixels left out of the fit agreed no better elsewhere",
                    stayed,
                )
            )
        if untried:
            parts.append(phrases("{n:,} camera not tried yet", "{n:,} cameras not tried yet", untried))
        return listed(tuple(parts), "; ")
