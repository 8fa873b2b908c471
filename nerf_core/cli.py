"""The `nerf-core` command."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.common.command_line import parse
from nerf_core.common.errors import UserError
from nerf_core.common.output import complain, forgiving_output, unprinted
from nerf_core.common.processes import is_first
from nerf_core.common.signals import Interrupted, Signals

DESCRIPTION = "Train, render and open up neural radiance fields. --version prints the version."


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit status: 0; 1 when training diverged; 2 for what the user can mend; 129, 130 and 143 after signals.

    2 also if what a command prints could not be written, unless the command has its work in files.
    """
    with forgiving_output(silent=not is_first()) as output, Signals() as signals:
        try:
            arguments = sys.argv[1:] if arguments is None else arguments
            if arguments and not arguments[0].startswith("-"):
                COMMANDS.get(arguments[0])  # raises UserError with all names, for an unknown command
            status = parse(_any_command(), "nerf-core", arguments, DESCRIPTION).run(signals)
            text = unprinted(output)
            if not text:
                return status
            status = status if signals.polite else 2
        except UserError as error:
            status, text = error.status, str(error)
        except Interrupted as error:
            status, text = error.status, f"interrupted ({error})"
        complain(f"nerf-core: {text}")
        return status


def _any_command() -> Any:
    """The union of all subcommands, as tyro takes it."""
    names = sorted(COMMANDS.names(), key=lambda name: COMMANDS.get(name).order)
    return Union[tuple(Annotated[COMMANDS.get(name), tyro.conf.subcommand(name)] for name in names)]  # noqa: UP007  (a number of them)


if __name__ == "__main__":
    sys.exit(main())
