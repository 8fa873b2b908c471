"""A film and its PNG frames appear when they are whole; an aborted one changes no file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.training.trainer import Trainer


@pytest.fixture
def job(make_trainer: Callable[..., Trainer], scene: Scene, tmp_path: Path) -> Callable[..., FilmJob]:
    """Begins a film of two small frames, from one view of the scene."""
    method = make_trainer().method

    def begin(view: int) -> FilmJob:
        cameras = 2 * (scene.views[view].camera.resized(6, 6),)
        return FilmJob(method, scene, ExportPath(cameras, 10.0, tmp_path / "a.mp4", frames=True))

    return begin


def finish(job: FilmJob) -> None:
    while job.advance():
        pass


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_cancelled_film_keeps_the_frames_of_the_one_before(job: Callable[..., FilmJob], tmp_path: Path) -> None:
    finish(job(0))
    first = contents(tmp_path)
    assert sorted(first) == ["a.mp4", "a_frames/00000.png", "a_frames/00001.png"]
    second = job(2)
    second.advance()
    second.advance()
    second.cancel()
    assert contents(tmp_path) == first
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["00000.png", "00001.png", "a.mp4", "a_frames"]


def test_a_film_replaces_the_frames_of_the_one_before(job: Callable[..., FilmJob], tmp_path: Path) -> None:
    finish(job(0))
    first = contents(tmp_path)
    (tmp_path / "a_frames" / "notes.txt").write_text("mine")
    finish(job(2))
    second = contents(tmp_path)
    assert second.pop("a_frames/notes.txt") == b"mine"
    assert second.keys() == first.keys()
    assert all(second[name] != first[name] for name in first)


def test_a_film_says_where_its_frames_cannot_be_written(job: Callable[..., FilmJob], tmp_path: Path) -> None:
    (tmp_path / "a_frames").write_text("in the way")
    with pytest.raises(UserError, match="a_frames"):
        finish(job(0))
    assert contents(tmp_path) == {"a_frames": b"in the way"}
