"""Where compiled loops are kept, and for how long."""

from __future__ import annotations

import importlib
import inspect
import os
import time
from pathlib import Path

import pytest

from nerf_core.common.jit import cache as numba_here


@pytest.fixture
def caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / name)
    return tmp_path / "nerf-viewer"


def test_only_folders_unused_for_30_days_are_deleted(caches: Path) -> None:
    now = time.time()
    for name, days in (("numba-old", 31), ("numba-recent", 29), ("other", 99)):
        (caches / name).mkdir(parents=True)
        (caches / name / "loop.nbi").write_bytes(b"x")
        os.utime(caches / name, (now - days * 86400, now - days * 86400))
    own = numba_here._own_folder()
    assert own.parent == caches
    assert {folder.name for folder in caches.iterdir()} == {own.name, "numba-recent", "other"}
    os.utime(own, (now - 99 * 86400, now - 99 * 86400))
    assert numba_here._own_folder() == own  # use keeps it
    assert own.is_dir()


def test_without_a_cache_folder_private_temporary_ones_are_used(caches: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    caches.parent.joinpath("nerf-viewer").write_text("a file in the way")
    first, second = numba_here._own_folder(), numba_here._own_folder()
    assert first != second
    assert first.stat().st_mode & 0o077 == 0


def test_every_compiled_file_is_a_source() -> None:
    """A change of a file that is none would leave the old loops in the cache."""
    compiled = set()
    for file in numba_here.PACKAGE.rglob("*.py"):
        if numba_here.IMPORTS_JIT.decode() not in file.read_text(encoding="utf-8"):
            continue
        name = ".".join(("nerf_core", *file.relative_to(numba_here.PACKAGE).with_suffix("").parts))
        for value in vars(importlib.import_module(name)).values():
            if hasattr(value, "py_func"):
                compiled.add(Path(inspect.getfile(value.py_func)))
    assert {numba_here.PACKAGE / "kernels" / "numba_march.py"} <= compiled <= set(numba_here.sources())
