"""What a method must know to share its training steps with other processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nerf_core.common.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor


class Lost(UserError):
    """Another process of the group ended or does not answer. It is raised before a step changes anything."""


class Group:
    """The processes that train one model together; this class is the group of one process.

    A step of a group is the step of one process with the whole batch. Every process draws the random numbers of the
    whole batch, computes the gradient of its own part, and adds up the gradients of all (all-reduce) before the
    optimiser's step. So the weights stay the same in all of them.

    rank: the number of this process, from 0. The first one writes files and prints.
    size: the number of processes.
    local: how many of them run on this machine.
    device: this process's own device; empty: the one that was asked for.
    """

    rank, size, local, device = 0, 1, 1, ""

    def part(self, count: int) -> range:
        """Return which of `count` rays are this process's own: consecutive ones, as many as the others' within 1."""
        return range(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over all processes. They are of one type and on one device."""

    def greatest(self, value: int) -> int:
        """Return the greatest value that a process gives. All wait here for each other."""
        return value

    def compare(self, description: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
        """Raise UserError if a process gives another description (JSON values by name) or other tensors."""


ALONE = Group()
