"""`nerf-core cache`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.common import cache
from nerf_core.common.errors import UserError
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.common.text import counted, size

Clear = Literal["nothing", "poses", "photos", "all"]


@COMMANDS.register("cache")
@dataclass(frozen=True)
class Cache:
    """List what is kept so that it need not be made again (found poses, photos of large captures), or delete it."""

    order: ClassVar[int] = 8

    clear: Annotated[Clear, tyro.conf.arg(metavar="{poses,photos,all}")] = "nothing"
    """Delete what is kept of this kind. A capture that is open keeps its photos until it is closed."""

    def run(self, signals: Signals) -> int:
        found = [e for e in cache.entries() if self.clear in ("nothing", "all", e.kind)]
        for entry in found:
            when = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.used))
            say(f"{when}  {size(entry.bytes):>7}  {entry.kind:<6}  {entry.name}  {entry.folder}")
        total = f"{counted(len(found), 'folder')}, {size(sum(e.bytes for e in found))}"
        if self.clear == "nothing":
            ways = "; --clear poses, photos or all deletes" if found else ""
            say(f"{total} of {size(cache.MOST_BYTES)} in {cache.cache_folder()}{ways}")
            return 0
        kept = cache.clear(found)
        say(f"deleted {len(found) - len(kept)} of {total}")
        if kept:
            raise UserError(f"{kept[0].folder}: cannot be deleted: check its rights")
        return 0
