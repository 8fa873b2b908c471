"""The subcommands of `nerf-core`: one file each."""

from __future__ import annotations

from typing import ClassVar, Protocol

from nerf_core.common.registry import Registry
from nerf_core.common.signals import Signals


class Subcommand(Protocol):
    """A frozen dataclass: its fields are the options, its docstring is the help. A smaller `order` is listed first."""

    order: ClassVar[int]

    def run(self, signals: Signals) -> int:
        """Do it and return the exit status. Raises UserError for what the user can mend."""
        ...


COMMANDS: Registry[type[Subcommand]] = Registry("command", "nerf_core.commands")
