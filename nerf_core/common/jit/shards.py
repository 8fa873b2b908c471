"""A fixed number of threads that share one piece of work by position: what each does never depends on the others."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

FEWEST = 256  # items a shard: below, handing over takes longer than doing


@lru_cache(maxsize=4)
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="kernel")


def shards_of(count: int, most: int) -> int:
    """How many threads `count` items are worth, where the result is the same for any number of them."""
    return max(1, min(count // FEWEST, most))


def each_shard(shards: int, work: Callable[[int], None]) -> None:
    """work(0) … work(shards − 1), at once, the last here; what any raises is raised."""
    if shards == 1:
        work(0)
        return
    others = [_pool(shards - 1).submit(work, s) for s in range(shards - 1)]
    work(shards - 1)
    for other in others:
        other.result()


def split(count: int, shards: int, s: int) -> tuple[int, int]:
    """The part [first, last) of `count` items that shard s has."""
    return count * s // shards, count * (s + 1) // shards
