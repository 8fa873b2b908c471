"""Split work into shards, one thread each. A shard is a fixed range of items: results never depend on timing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

FEWEST = 256  # items in a shard: with fewer, handing over to a thread takes longer than the work


@lru_cache(maxsize=4)
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="kernel")


def shards_of(count: int, most: int, fewest: int = FEWEST) -> int:
    """Return how many shards `count` items are worth, with at least `fewest` in each.

    For work whose result is the same for any number of shards.
    """
    return max(1, min(count // fewest, most))


def each_shard(shards: int, work: Callable[[int], None]) -> None:
    """Call work(0) … work(shards − 1) in parallel, the last one in this thread. An error of any of them is raised."""
    if shards == 1:
        work(0)
        return
    others = [_pool(shards - 1).submit(work, s) for s in range(shards - 1)]
    work(shards - 1)
    for other in others:
        other.result()


def split(count: int, shards: int, s: int) -> tuple[int, int]:
    """Return the range [first, last) of `count` items that belongs to shard `s`."""
    return count * s // shards, count * (s + 1) // shards
