"""Who works next: training and pictures share the time by one budget, runs share training equally."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from nerf_core.live.budget import Account, Budget
from nerf_core.live.shares import DEFAULT_SHARE, SHARES, Situation


class Trainee(Protocol):
    """What the scheduler needs to know of a run."""

    number: int

    @property
    def training(self) -> bool: ...


class Scheduler:
    """One for the worker thread. share: what training keeps of the time while pictures are wanted."""

    def __init__(self, share: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.wanted, self.rule = share, DEFAULT_SHARE
        self.budget = Budget(share, clock)
        self._clock = clock
        self._accounts: dict[int, Account] = {}  # of the runs that train

    def set_share(self, wanted: float, rule: str) -> None:
        """Raises UserError for an unknown rule."""
        SHARES.get(rule)
        self.wanted, self.rule = min(max(wanted, 0.05), 0.95), rule
        self.budget.share = self.wanted

    def adapt(self, now: Situation) -> None:
        """Let the rule look at the situation."""
        self.budget.share = SHARES.get(self.rule).share(self.wanted, now)

    def next_run(self, runs: Sequence[Trainee]) -> int | None:
        """The number of the training run that had the least training time lately; None: no run trains.

        A run that begins to train stands level with the one that had the least: it neither waits nor catches up.
        """
        training = [run.number for run in runs if run.training]
        self._accounts = {number: account for number, account in self._accounts.items() if number in training}
        for account in self._accounts.values():
            account.fade()
        least = min((account.seconds for account in self._accounts.values()), default=0.0)
        for number in training:
            if number not in self._accounts:
                self._accounts[number] = Account(least, clock=self._clock)
        return min(training, key=lambda number: (self._accounts[number].seconds, number), default=None)

    def trained(self, number: int, seconds: float, rays: int) -> None:
        """Run `number` trained for `seconds` on so many rays."""
        self.budget.trained(seconds)
        if number in self._accounts:
            self._accounts[number].add(seconds, rays)

    def rays_per_second(self, number: int) -> float:
        """Rays that a run was trained on per second of wall time, pictures and other runs included."""
        account, total = self._accounts.get(number), self.budget.total()
        if account is None or total <= 0:
            return 0.0
        account.fade()
        return account.rays / total
