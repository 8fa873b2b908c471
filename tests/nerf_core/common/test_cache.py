"""The cache folder and the command that lists and clears it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from nerf_core.cli import main
from nerf_core.common import cache


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "cache_folder", lambda: tmp_path / "cache")


def entry(kind: str, key: str, bytes_: int, used: float) -> Path:
    folder = cache.entry_folder(kind, key, "garden")
    folder.mkdir(parents=True)
    (folder / cache.FIRST[kind]).write_bytes(b"x" * bytes_)
    os.utime(folder.parent, (used, used))
    return folder


def test_room_is_made_by_deleting_what_was_not_used_for_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "MOST_BYTES", 20_000)
    old, middle, new = (entry(k, f"k{n}", 8192, n) for n, k in enumerate(("photos", "poses", "photos")))
    cache.make_room(0, new)
    assert old.exists()
    cache.used(old)
    cache.make_room(8192, new)
    assert [old.exists(), middle.exists(), new.exists()] == [True, False, True]
    cache.make_room(10**9, new)  # alone larger than the bound: all others go
    assert [old.exists(), new.exists()] == [False, True]


def test_a_link_to_the_photos_is_neither_counted_nor_followed(tmp_path: Path) -> None:
    photos = tmp_path / "mine"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"x" * 50_000)
    folder = entry("poses", "k", 10, 1)
    (folder / "images").symlink_to(photos, target_is_directory=True)
    (found,) = cache.entries()
    assert found.bytes < 20_000
    assert cache.clear([found]) == []
    assert (photos / "a.jpg").stat().st_size == 50_000


@pytest.mark.parametrize("theirs", ["holiday/x.jpg", "holiday/album/x.jpg", "holiday/images/x.jpg", "a/b/there/x.jpg"])
def test_what_was_not_made_here_is_never_deleted(theirs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder of a kind may be a link to a disk with other things on it."""
    file = tmp_path / "disk" / theirs
    file.parent.mkdir(parents=True)
    file.write_bytes(b"mine")
    (file.parent / "notes.txt").write_bytes(b"mine, too")
    (tmp_path / "cache").mkdir()
    for kind in cache.KINDS:
        (tmp_path / "cache" / kind).symlink_to(tmp_path / "disk", target_is_directory=True)
    monkeypatch.setattr(cache, "MOST_BYTES", 0)
    own = entry("photos", "k1", 100, 1)
    cache.make_room(10**9, cache.entry_folder("photos", "k2", "other"))
    assert not own.exists()
    assert main(["cache", "--clear", "all"]) == 0
    assert file.read_bytes() == b"mine"


@pytest.mark.parametrize(("kind", "left"), [("poses", ["photos"]), ("photos", ["poses"]), ("all", [])])
def test_the_command_lists_and_clears(kind: str, left: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    entry("poses", "k1", 5000, 1)
    entry("photos", "k2", 9000, 2)
    assert main(["cache"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "garden" in lines[0]
    assert "2 folders" in lines[2]
    assert "of 20 GB in" in lines[2]
    assert main(["cache", "--clear", kind]) == 0
    assert f"deleted {2 - len(left)} of" in capsys.readouterr().out
    assert [one.kind for one in cache.entries()] == left


def test_an_empty_cache_is_no_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cache"]) == 0
    assert main(["cache", "--clear", "all"]) == 0
    assert "0 folders" in capsys.readouterr().out
