"""What corrected the poses of training photos, as windows and reports show it. Only numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerf_core.common.language import marked, phrase

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
        """Describe them in a line: medians and how many cameras never moved, or why none did."""
        if not self.rounds:
            return marked("not corrected yet")
        if self.stayed == len(self.views):
            return marked("none is corrected: left-out pixels agree no better than by chance")
        return phrase(
            "corrected by {degrees:.2f}° and {percent:.2%} of the radius (median), {stayed:,} of {count:,} not moved",
            degrees=float(np.median(self.turned)),
            percent=float(np.median(self.shifted)),
            stayed=self.stayed,
            count=len(self.views),
        )
