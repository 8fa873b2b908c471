"""Decide who works next.

Training and pictures share the time by one budget. Runs share the training time equally.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from nerf_core.live.budget import Account, Budget
from nerf_core.live.shares import DEFAULT_SHARE, SHARES, Situation

LEAST_SECONDS = 0.1  # of training, fading: a rate of less is that of a few steps, or of long ago


class Trainee(Protocol):
    """What the scheduler needs to know about a run.

    number: the run's number.
    training: whether it trains now.
    """

    number: int

    @property
    def training(self) -> bool: ...


class Scheduler:
    """Divides the worker thread's time. The worker has one scheduler.

    wanted: the share of training that the user asked for.
    rule: the name in `SHARES` of the rule that adapts it.
    budget: the budget of training and pictures.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with the default rule.

        Args:
            share: the share of the time that training keeps while pictures are wanted, 0.05 … 0.95.
            clock: returns the time in seconds.
        """
        self.wanted, self.rule = share, DEFAULT_SHARE
        self.budget = Budget(share, clock)
        self._clock = clock
        self._accounts: dict[int, Account] = {}  # of the runs that train, by number

    def set_share(self, wanted: float, rule: str) -> None:
        """Set the user's choice.

        Args:
            wanted: the share of training; it is limited to 0.05 … 0.95.
            rule: a name of `SHARES`.

        Raises:
            UserError: the rule is unknown.
        """
        SHARES.get(rule)
        self.wanted, self.rule = min(max(wanted, 0.05), 0.95), rule
        self.budget.share = self.wanted

    def adapt(self, now: Situation) -> None:
        """Set the budget's share to what the rule gives in this situation."""
        self.budget.share = SHARES.get(self.rule).share(self.wanted, now)

    def next_run(self, runs: Sequence[Trainee]) -> int | None:
        """Choose the run that trains next: the one that had the least training time lately.

        A run that begins to train starts with the time of the run that had the least. So it neither waits nor catches
        up.

        Args:
            runs: all runs.

        Returns:
            The run's number; None if no run trains.
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
        """Note that run `number` trained on `rays` rays for `seconds`."""
        self.budget.trained(seconds)
        if number in self._accounts:
            self._accounts[number].add(seconds, rays)

    def forget(self, number: int) -> None:
        """Begin the account of a run anew: it has another model, whose speed is not known yet."""
        self._accounts.pop(number, None)

    def rays_per_second(self, number: int) -> float:
        """Return the rays per second that a run is trained on. The time of pictures and of other runs counts, too.

        0 as long as there is too little training lately to tell.
        """
        account, total = self._accounts.get(number), self.budget.total()
        if account is None:
            return 0.0
        account.fade()
        if account.seconds < LEAST_SECONDS:
            return 0.0
        return account.rays / total
