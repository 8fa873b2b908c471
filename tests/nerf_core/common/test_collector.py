"""The garbage collector pauses while libraries are imported, in all threads, and is afterwards as it was."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import pytest

from nerf_core.common import collector


@pytest.fixture(autouse=True)
def enabled() -> Iterator[None]:
    assert gc.isenabled()
    yield
    gc.enable()


def test_the_collector_rests_and_comes_back_after_an_error_too() -> None:
    with collector.paused():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), collector.paused():
        raise ImportError("no such library")
    assert gc.isenabled()


def test_whoever_disabled_the_collector_keeps_it_disabled() -> None:
    gc.disable()
    with collector.paused():
        pass
    assert not gc.isenabled()


def test_of_several_pauses_the_last_that_ends_enables_the_collector() -> None:
    begun, may_end = threading.Event(), threading.Event()

    def other() -> None:
        with collector.paused():
            begun.set()
            may_end.wait(60)

    thread = threading.Thread(target=other)
    with collector.paused():
        thread.start()
        assert begun.wait(60)
    assert not gc.isenabled()
    may_end.set()
    thread.join(60)
    assert gc.isenabled()
