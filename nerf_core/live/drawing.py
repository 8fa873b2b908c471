"""Which run draws next, and one piece of its drawing: of a picture, of an opened ray, or of an export."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from nerf_core.live.budget import Budget
from nerf_core.live.mailbox import Mailbox
from nerf_core.live.messages import ViewRequest

if TYPE_CHECKING:
    from nerf_core.live.run import Run


class Drawing:
    """Draws for all runs, a piece of at most some 15 ms at a time. Owned by the worker thread.

    Attributes:
        at_work: the run whose piece is being drawn. It stays when the piece raises, so that the fault is told of it.
    """

    def __init__(self, runs: Mapping[int, Run], mailbox: Mailbox, budget: Budget) -> None:
        self.at_work: Run | None = None
        self._runs, self._mailbox, self._budget = runs, mailbox, budget

    def view(self, run: Run) -> ViewRequest | None:
        """Return what to draw of a run; None: nothing, or a view that failed before."""
        view = self._mailbox.view(run.number)
        return None if view is run.skipped else view

    def wants_pixels(self, run: Run, view: ViewRequest) -> bool:
        """Whether `view` lacks its first pixels and is still wanted; a moving camera's are finished in any case."""
        return run.artist.urgent(view) and (view is self._mailbox.view(run.number) or view.moving)

    def ray_awaited(self) -> bool:
        """Whether somebody waits for an opened ray of any run."""
        return any(run.artist.ray.urgent for run in self._runs.values())

    def pixels_awaited(self) -> bool:
        """Whether somebody waits for the first pixels of a view of any run."""
        return any(run.artist.urgent(self.view(run)) for run in self._runs.values())

    def piece(self) -> bool:
        """Draw one piece of any run; return whether there was any. Runs that somebody waits for come first."""
        runs = sorted(self._runs.values(), key=lambda run: not self._awaited(run))
        return any(self.piece_of(run, self.view(run)) for run in runs)

    def piece_of(self, run: Run, view: ViewRequest | None = None) -> bool:
        """Draw one piece of a run; return whether there was any. view: None for the newest one."""
        if run.trainer is None:
            return False
        view = view or self.view(run)
        self.at_work, begin = run, time.perf_counter()
        turns = [run.exports.advance, lambda: run.draw(view)]
        if run.artist.urgent(view) or run.artist.ray.urgent or self._budget.artist_is_next():
            turns.reverse()
        did = any(turn() for turn in turns)
        if did:
            self._budget.drew(time.perf_counter() - begin)
        self.at_work = None
        return did

    def _awaited(self, run: Run) -> bool:
        return run.artist.ray.urgent or run.artist.urgent(self.view(run))
