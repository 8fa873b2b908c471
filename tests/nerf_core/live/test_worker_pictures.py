"""What the worker draws while it trains: previews, an opened ray, films. Watching does not change the weights."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from desk import Desk, orbit, view_of

from nerf_core.datasets import load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.live.artist import Artist
from nerf_core.live.messages import (
    CancelExport,
    Inspect,
    OpenScene,
    Pause,
    SaveCheckpoint,
    SetShare,
    StartExport,
    StopInspecting,
    Train,
    UseMethod,
    ViewRequest,
)
from nerf_core.live.worker import Worker
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.rendering.images import render_camera, to_bytes
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

OpenDesk = Callable[..., Desk]


@pytest.fixture
def on_disk(capture: Path, tiny: RunSettings) -> Scene:
    return load_scene(capture, tiny.load)


def plain(scene: Scene, settings: RunSettings, steps: int) -> Trainer:
    """The same run without a worker."""
    trainer = Trainer(scene, settings)
    for _ in range(steps):
        trainer.step()
    return trainer


def test_a_preview_is_refined_until_it_equals_the_rendering(
    open_desk: OpenDesk, on_disk: Scene, tiny: RunSettings
) -> None:
    desk = open_desk()
    desk.trained(2)
    wanted = view_of(on_disk, stamp=7)
    desk.worker.request_view(wanted)
    shown = desk.until(lambda s: s.preview is not None and s.preview.stamp == 7 and s.preview.complete).preview
    assert shown is not None
    assert (shown.stride, shown.step, shown.quality, shown.camera) == (1, 2, "fine", wanted.camera)
    color, depth = render_camera(plain(on_disk, tiny, 2).method, wanted.camera, on_disk)
    difference = shown.rgba[..., :3].astype(int) - to_bytes(color)
    assert np.abs(difference).max() <= 1  # a value between two levels may round either way
    rows, columns = np.mgrid[:13, :13]
    x, y = (columns + 0.5 - 6.5) / wanted.camera.fx, (rows + 0.5 - 6.5) / wanted.camera.fy
    np.testing.assert_allclose(shown.depth, depth / np.sqrt(x * x + y * y + 1), rtol=1e-4)


def test_the_newest_view_counts(open_desk: OpenDesk) -> None:
    desk = open_desk()
    scene = desk.worker.snapshot().scene
    desk.send(SetShare(0.3), Train())
    for stamp in range(1, 30):
        desk.worker.request_view(view_of(scene, stamp, moving=stamp < 29))
        time.sleep(0.003)
    shown = desk.until(lambda s: s.preview is not None and s.preview.stamp == 29)
    assert shown.wanted_share == 0.3
    step = shown.step
    desk.until(lambda s: s.step > step and s.preview is not None and s.preview.complete and s.preview.step > step)


def test_a_moving_camera_waits_while_the_budget_says_so_and_a_resting_one_never(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk()
    scene = desk.worker.snapshot().scene
    begun = []
    monkeypatch.setattr(desk.worker._scheduler.budget, "may_follow", lambda: False)
    monkeypatch.setattr(desk.worker._scheduler.budget, "followed", begun.append)
    desk.send(Train())
    step = desk.until(lambda s: s.step > 2).step
    desk.worker.request_view(view_of(scene, 1, moving=True))
    shown = desk.until(lambda s: s.step > step + 10)
    assert shown.preview is None
    desk.worker.request_view(view_of(scene, 2))
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 2)
    assert begun
    monkeypatch.setattr(desk.worker._scheduler.budget, "may_follow", lambda: True)
    desk.worker.request_view(view_of(scene, 3, moving=True))
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 3)


def test_the_windows_frames_do_not_count_as_training(tiny: RunSettings) -> None:
    worker = Worker(tiny, share=0.6)
    assert worker._prepare()
    worker.painted(0.25)
    worker._accounted = time.perf_counter() - 1.0
    worker._account_for_training(1, 100)
    assert worker._scheduler.budget.train_share() == pytest.approx(0.75, abs=0.01)


def test_an_opened_ray_stays_live(open_desk: OpenDesk) -> None:
    desk = open_desk(steps=100_000)
    scene = desk.worker.snapshot().scene
    assert scene is not None
    camera = scene.views[0].camera
    desk.send(Inspect(camera, (8, 8)))
    desk.until(lambda s: s.ray is not None and s.ray.pixel == (8, 8) and s.ray.step == 0)
    desk.send(Train())
    shown = desk.until(lambda s: s.ray is not None and s.ray.step > 0 and s.radiance is not None)
    assert shown.ray is not None
    assert shown.radiance is not None
    np.testing.assert_allclose(shown.ray.color, shown.ray.rendered_color, atol=1e-5)
    desk.send(Inspect(camera, (3, 4), point_t=3.5))
    moved = desk.until(lambda s: s.ray is not None and s.ray.pixel == (3, 4) and s.radiance is not None)
    assert moved.radiance is not None
    assert moved.radiance.t == 3.5
    desk.send(Inspect(camera, (99, 0)))
    assert desk.until_told("pixel 99 0: outside the picture, columns 0 … 15, rows 0 … 15").level == "error"
    desk.send(StopInspecting())
    desk.until(lambda s: s.ray is None and s.radiance is None and s.status == "training")


def test_watched_or_not_the_weights_are_the_same(
    open_desk: OpenDesk, on_disk: Scene, tiny: RunSettings, tmp_path: Path
) -> None:
    desk = open_desk()
    desk.send(Inspect(on_disk.views[0].camera, (8, 8)), Train(12))
    for stamp in range(1, 200):
        desk.worker.request_view(view_of(on_disk, stamp, moving=stamp % 5 > 0))
        time.sleep(0.005)
        if desk.worker.snapshot().step == 12:
            break
    desk.until(lambda s: s.step == 12 and s.status == "paused")
    desk.send(SaveCheckpoint(tmp_path / "watched.safetensors"))
    desk.until_told("saved step 12")
    state, alone = checkpoint.load(tmp_path / "watched.safetensors")[1], plain(on_disk, tiny, 12).state()
    assert state.keys() == alone.keys()
    assert [name for name in alone if not torch.equal(state[name], alone[name])] == []


def test_a_film_is_an_mp4(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.send(StartExport(ExportPath(orbit(desk.worker.snapshot().scene, 3), 30.0, tmp_path / "orbit.avi")))
    desk.until_told("orbit.avi: a film is written as MP4: name a .mp4 file")
    assert list(tmp_path.iterdir()) == []


def test_a_long_step_delays_no_command(open_desk: OpenDesk, tmp_path: Path) -> None:
    """A step of the official batch takes seconds on a CPU; this one would take minutes."""
    desk, path = open_desk(rays="60000", chunk_rays="1"), tmp_path / "model.safetensors"
    scene = desk.worker.snapshot().scene
    assert scene is not None
    desk.send(Train())
    desk.until(lambda s: s.status == "training")
    begin = time.monotonic()
    desk.send(Inspect(scene.views[0].camera, (3, 4)))
    desk.until(lambda s: s.ray is not None and s.ray.pixel == (3, 4))
    desk.send(StartExport(ExportPath(orbit(scene, 2), 30.0, tmp_path / "film.mp4")))
    desk.until_told("exported")
    desk.send(Pause())
    assert desk.until(lambda s: s.status == "ready").step == 0  # the step was abandoned
    desk.send(Train())
    desk.until(lambda s: s.status == "training")
    desk.send(SaveCheckpoint(path))
    assert desk.worker.stop(5.0)
    assert checkpoint.load(path)[0]["step"] == 0
    assert time.monotonic() - begin < 30


def test_a_film_is_made_while_training_goes_on(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, film = open_desk(), tmp_path / "orbit.mp4"
    desk.send(Train(), StartExport(ExportPath(orbit(desk.worker.snapshot().scene, 20), 30.0, film, frames=True)))
    shown = desk.until(lambda s: s.export is not None and s.export.state == "done")
    assert shown.export is not None
    assert shown.export.done == shown.export.total > 0
    assert shown.step > 0
    assert desk.until_told("exported").path == film
    assert film.stat().st_size > 500
    assert sorted(p.name for p in tmp_path.iterdir()) == ["orbit.mp4", "orbit_frames"]
    assert sorted(p.name for p in (tmp_path / "orbit_frames").iterdir()) == [f"{k:05d}.png" for k in range(20)]


def test_a_picture_without_memory_does_not_stop_training(
    open_desk: OpenDesk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("2 GiB are free")

    desk = open_desk()
    desk.send(Train())
    training = desk.until(lambda s: s.step > 1)
    scene = training.scene
    with monkeypatch.context() as context:
        context.setattr("nerf_core.live.artist.view_rays", full)
        desk.worker.request_view(view_of(scene, 1))
        desk.until_told("out of device memory for a picture (2 GiB are free): ")
    with monkeypatch.context() as context:
        context.setattr("nerf_core.rendering.export.jobs.tiles", full)
        desk.worker.request_view(None)
        desk.send(StartExport(ExportPath(orbit(scene, 1), 30.0, tmp_path / "film.mp4")))
        desk.until_told("export failed: out of device memory for a picture (2 GiB are free): ")
    desk.worker.request_view(view_of(scene, 2))
    shown = desk.until(lambda s: s.preview is not None and s.preview.stamp == 2)
    assert shown.status == "training"
    assert shown.config == training.config  # its chunks are as large as before
    assert len(desk.heard) == 2


def test_a_cancelled_film_leaves_nothing(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    scene = desk.worker.snapshot().scene
    desk.send(StartExport(ExportPath(orbit(scene, 5000), 30.0, tmp_path / "long.mp4", frames=True)))
    desk.until(lambda s: s.export is not None and s.export.state == "running" and s.export.done > 30)
    assert list(tmp_path.glob("long_frames/.*.part/*.png"))
    desk.send(StartExport(ExportPath(orbit(scene, 1), 30.0, tmp_path / "second.mp4")))
    desk.until_told("long.mp4 is running: cancel it or wait for it")
    desk.send(CancelExport())
    desk.until(lambda s: s.export is not None and s.export.state == "cancelled")
    assert list(tmp_path.iterdir()) == []
    desk.send(StartExport(ExportPath(orbit(scene, 1), 30.0, tmp_path / "second.mp4")))
    desk.until(lambda s: s.export is not None and s.export.state == "done")


def test_a_picture_that_is_drawn_during_training_has_one_step(
    make_trainer: Callable[..., Trainer], scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One training step passes per tile. The picture has the colours of the step at which it began.

    It can still be read although the next picture has begun.
    """
    monkeypatch.setattr("nerf_core.live.artist.WHOLE_SECONDS", 0.0)  # so that this small level counts as a slow one
    trainer, artist = make_trainer(tile=16), Artist()
    view, tiles = ViewRequest(1, scene.views[5].camera, moving=False), 16 * 16 // 16
    for _ in range(tiles):
        assert artist.draw_view(trainer, view, training=True)
    trainer.step()
    began, frozen = trainer.step_count, trainer.frozen_method()
    for _ in range(tiles + 1):
        assert artist.draw_view(trainer, view, training=True)
        trainer.step()
    picture = artist.preview(None)
    assert picture is not None
    assert (picture.step, picture.complete) == (began, True)
    color, _ = render_camera(frozen, view.camera, scene)
    assert np.abs(picture.rgba[..., :3].astype(int) - to_bytes(color)).max() <= 1


def test_a_pause_drops_a_picture_of_an_older_step(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    trainer, artist = make_trainer(tile=16), Artist()
    view, tiles = ViewRequest(1, scene.views[5].camera, moving=False), 16 * 16 // 16
    for _ in range(tiles):
        artist.draw_view(trainer, view, training=True)
    trainer.step()
    artist.draw_view(trainer, view, training=True)
    trainer.step()
    drawn = 0
    while artist.draw_view(trainer, view, training=False):
        drawn += 1
    assert drawn == tiles
    picture = artist.preview(None)
    assert picture is not None
    assert picture.step == trainer.step_count


def test_other_weights_draw_another_picture(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    """When a network takes over from its proposal grid, earlier pictures and timings do not count."""
    trainer, artist = make_trainer(tile=16), Artist()
    view = ViewRequest(1, scene.views[5].camera, moving=False)
    while artist.draw_view(trainer, view, training=False):
        assert artist.preview(None) is None or not artist.urgent(view)
    assert artist.rays_per_second("fine") > 0
    trainer.method.born = 7  # type: ignore[misc]  as if a network took over
    assert artist.draw_view(trainer, view, training=False)
    assert artist.urgent(view)
    assert artist.rays_per_second("fine") > 0  # from the one piece that the new weights drew
    kept = artist.preview(None)
    assert kept is not None
    assert kept.complete  # the old picture stays until the new one's first level is drawn
    while artist.draw_view(trainer, view, training=False):
        pass
    taken_over = artist.preview(None)
    assert taken_over is not None
    assert (kept.born, taken_over.born) == (0, 7)
    artist.forget_pictures()
    while artist.draw_view(trainer, view, training=False):
        pass
    exchanged = artist.preview(None)
    assert exchanged is not None
    assert len({kept.model, taken_over.model, exchanged.model}) == 3


@pytest.mark.parametrize(("rests", "expected"), [((), (32, 8, 2)), ((1,), (1, 1, 1)), ((2,), (32, 1, 1))])
def test_a_camera_that_never_rests_gets_the_pixels_that_the_model_can_draw(
    make_trainer: Callable[..., Trainer],
    scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
    rests: tuple[int, ...],
    expected: tuple[int, ...],
) -> None:
    """Its first levels are smaller than a tile. After a rest, its speed is known."""
    now = itertools.count(0.0, 1e-3)  # each piece takes a millisecond
    monkeypatch.setattr("nerf_core.live.artist.time", SimpleNamespace(monotonic=lambda: 0.0, perf_counter=now.__next__))
    trainer, artist = make_trainer(tile=4096), Artist()
    camera = scene.views[5].camera.resized(256, 256)
    strides = []
    for stamp in range(1, 8):
        view = ViewRequest(stamp, camera, moving=stamp not in rests)
        while artist.urgent(view) or not view.moving:
            if not artist.draw_view(trainer, view, training=view.moving):
                break
        picture = artist.preview(None)
        assert picture is not None
        strides.append(picture.stride)
        trainer.step()
    assert tuple(strides[:3]) == expected


def test_a_view_that_cannot_be_drawn_delays_no_export(open_desk: OpenDesk, plain_methods: None, tmp_path: Path) -> None:
    desk = open_desk(steps=1_000_000)
    desk.send(UseMethod("sampled"))
    scene = desk.until(lambda s: s.method == "sampled").scene
    desk.worker.request_view(replace(view_of(scene, 1), mode="view-dependence"))
    desk.until_told("choose another picture")
    desk.send(Train(), StartExport(ExportPath(orbit(scene, 3), 30.0, tmp_path / "short.mp4")))
    desk.until_told("exported")
    assert desk.worker.snapshot().status == "training"


def test_an_answer_that_comes_later_has_its_commands_number(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    scene = desk.worker.snapshot().scene
    assert scene is not None
    film, ray, _ = desk.send(
        StartExport(ExportPath(orbit(scene, 2), 30.0, tmp_path / "short.mp4")),
        Inspect(scene.views[0].camera, (99, 0)),
        Pause(),
    )
    assert desk.until_told("exported").command == film
    assert desk.until_told("pixel 99 0: outside the picture").command == ray


def test_another_scene_begins_without_the_picture_of_the_last(open_desk: OpenDesk, capture: Path) -> None:
    desk = open_desk()
    desk.worker.request_view(view_of(desk.worker.snapshot().scene, 1))
    desk.until(lambda s: s.preview is not None)
    desk.worker.request_view(None)
    desk.send(OpenScene(capture, desk.settings))
    assert desk.until(lambda s: s.loaded == 2).preview is None
