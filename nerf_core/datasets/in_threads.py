"""Do work on photos in threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from nerf_core.datasets.images import UnreadableError

Progress = Callable[[str, int, int], None]
T = TypeVar("T")
THREADS = min(
    4, os.cpu_count() or 1
)  # decoders release the GIL; each holds a whole photo, so that more threads would take much memory


def in_threads(
    work: Callable[[int], T], items: Sequence[int], words: str, progress: Progress | None
) -> list[T | UnreadableError]:
    """Do `work` for all items in threads, in order. Damaged photos are returned as errors; other errors cancel."""

    def guarded(i: int) -> T | UnreadableError:
        try:
            return work(i)
        except UnreadableError as error:
            return error

    results: list[T | UnreadableError] = []
    pool = ThreadPoolExecutor(THREADS, thread_name_prefix="photos")
    try:
        for result in pool.map(guarded, items):
            results.append(result)
            if progress is not None:
                progress(words, len(results), len(items))
    finally:
        pool.shutdown(cancel_futures=True)
    return results
