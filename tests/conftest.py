"""Options and fixtures that all tests share."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

# Tests check calls of these modules against the shapes that they declare. The hook must precede their import.
CHECKED = ["nerf_core.volume.encodings", "nerf_core.volume.sampling", "nerf_core.volume.compositing"]
assert not set(CHECKED) & set(sys.modules)
jaxtyping.install_import_hook(CHECKED, "beartype.beartype")


def pytest_configure() -> None:
    """Pin each xdist worker to cores of its own if the system can: threads of two workers would wait for each other.

    Processes that a test starts inherit the cores.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        os.sched_setaffinity(0, set(cores[int(worker.removeprefix("gw")) % len(cores) :: max(count, 1)]))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start the longest thorough tests first, so that all workers end at about the same time."""

    def seconds(item: pytest.Item) -> float:
        mark = item.get_closest_marker("thorough")
        return mark.args[0] if mark else 0

    items.sort(key=seconds, reverse=True)


def pytest_collection_finish() -> None:
    """Leave out of garbage collection what stays until the end: thousands of tests, of which each round asks all."""
    gc.collect()
    gc.freeze()


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "folder of real scenes (lego, fox, fern, can) to test on as well"
    parser.addoption("--scenes", type=Path, default=None, help=text)


@pytest.fixture(scope="session")
def scenes(request: pytest.FixtureRequest) -> Path:
    """The folder given with --scenes. Without that option the test is skipped."""
    folder: Path | None = request.config.getoption("--scenes")
    if folder is None:
        pytest.skip("needs --scenes DIR")
    return folder.resolve()


@pytest.fixture
def hangup() -> Iterator[None]:
    """Let SIGHUP end the processes that a test starts, although `nohup` around the tests has it ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
