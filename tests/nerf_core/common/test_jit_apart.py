"""Loops are compiled by a process of its own, and by this one only where that fails."""

from __future__ import annotations

import importlib
import itertools
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

from nerf_core.common.jit import apart

NUMBERS = itertools.count()
LOOPS = """
import os
from pathlib import Path

from nerf_core.common.jit.vectors import jit

HERE = Path(__file__).parent


@jit
def twice(x):
    return 2.0 * x


def call_each():
    if (HERE / "only-here").exists() and os.getpid() != int((HERE / "only-here").read_text()):
        raise SystemExit("not here")
    with open(HERE / "called", "a") as file:
        print(os.getpid(), twice(1.0), file=file)
"""


@pytest.fixture
def loops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module with one loop, and with a cache of its own."""
    importlib.import_module("nerf_core.common.jit.vectors")  # sets CACHE_DIR when first imported
    name = f"loops_{next(NUMBERS)}"  # a name is imported once
    (tmp_path / f"{name}.py").write_text(LOOPS)
    (tmp_path / "cache").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(apart, "cache_folder", lambda: str(tmp_path / "cache"))
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    return importlib.import_module(name)


def callers(folder: Path) -> list[int]:
    return [int(line.split()[0]) for line in (folder / "called").read_text().splitlines()]


def test_another_process_compiles_and_this_one_reads(loops: ModuleType, tmp_path: Path) -> None:
    apart.compile_loops(loops.call_each)
    first, second = callers(tmp_path)
    assert first != os.getpid() == second
    assert not loops.twice.stats.cache_misses
    assert sum(loops.twice.stats.cache_hits.values()) == 1
    apart.compile_loops.__wrapped__(loops.call_each)  # as the next start does
    assert callers(tmp_path)[2:] == [os.getpid()]


def test_loops_of_other_sources_are_compiled_anew(
    loops: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    apart.compile_loops(loops.call_each)
    monkeypatch.setattr(apart, "sources_digest", lambda: "others")
    apart.compile_loops.__wrapped__(loops.call_each)
    assert [caller == os.getpid() for caller in callers(tmp_path)] == [False, True, False, True]


def test_where_it_fails_this_process_compiles(loops: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "only-here").write_text(str(os.getpid()))
    apart.compile_loops(loops.call_each)
    assert callers(tmp_path) == [os.getpid()]
    assert sum(loops.twice.stats.cache_misses.values()) == 1
    assert not list((tmp_path / "cache").glob("*.compiled"))


@pytest.mark.parametrize("executable", ["", "/nowhere/python"])
def test_without_an_interpreter_this_process_compiles(
    loops: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, executable: str
) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    apart.compile_loops(loops.call_each)
    assert callers(tmp_path) == [os.getpid()]
