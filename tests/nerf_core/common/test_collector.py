"""Imports run without the garbage collector, and what they made is left alone by it."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from nerf_core.common import collector


@pytest.fixture(autouse=True)
def enabled() -> Iterator[None]:
    assert gc.isenabled()
    yield
    gc.enable()


def test_the_collector_rests_while_libraries_are_imported_and_leaves_them_alone() -> None:
    before = gc.get_freeze_count()
    with collector.imports():
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() >= before + len(made)


def test_the_collector_comes_back_after_an_error() -> None:
    with pytest.raises(ImportError), collector.imports():
        raise ImportError("no such library")
    assert gc.isenabled()


def test_whoever_disabled_the_collector_keeps_it_disabled() -> None:
    gc.disable()
    with collector.imports():
        pass
    assert not gc.isenabled()


def test_of_two_imports_at_once_the_first_that_began_enables_the_collector() -> None:
    with collector.imports():
        with collector.imports():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
