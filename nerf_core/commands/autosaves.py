"""`nerf-core autosaves`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

from nerf_core.commands import COMMANDS
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.common.text import duration, size
from nerf_core.training.autosaves import Autosave, autosaves, clear


@COMMANDS.register("autosaves")
@dataclass(frozen=True)
class Autosaves:
    """List the checkpoints that were written where the user named no file, or delete them."""

    order: ClassVar[int] = 7

    clear: bool = False
    """Delete all that are listed. Files that this program did not write stay."""

    def run(self, signals: Signals) -> int:
        found = autosaves()
        for one in found:
            say(_line(one))
        total = f"{len(found)} autosave{'' if len(found) == 1 else 's'}, {size(sum(one.bytes for one in found))}"
        if not self.clear:
            say(f"{total}{'; --clear deletes them' if found else ''}")
            return 0
        deleted, reasons = clear(found)
        say(f"deleted {len(deleted)} of {total}")
        if reasons:
            raise UserError("; ".join(reasons))
        return 0


def _line(one: Autosave) -> str:
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(one.saved))
    what = f"{one.scene}, {one.method}, step {one.step:,}, {duration(one.seconds)} of training  " if one.method else ""
    problem = f" ({one.problem})" if one.problem else ""
    return f"{when}  {size(one.bytes):>7}  {what}{one.file}{problem}"
