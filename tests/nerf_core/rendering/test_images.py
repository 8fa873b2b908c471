"""Whole pictures are made of the method's tiles, in row order; render modes draw other numbers of a pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from nerf_core.common.colormaps import Name
from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import traced
from nerf_core.rendering.export.requests import ExportStill
from nerf_core.rendering.export.still import StillJob
from nerf_core.rendering.images import render_camera, tiles, to_bytes
from nerf_core.rendering.modes import COLOR, MODES, mode_names, shaded
from nerf_core.training.trainer import Trainer


def test_tiles_are_the_pixels_row_by_row(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    method, camera = make_trainer(tile=37).method, scene.views[0].camera
    parts = list(tiles(method, camera, scene))
    assert [len(p) for p in parts] == [37] * 6 + [34]
    whole = camera_rays(camera, scene.near, scene.far)
    assert torch.equal(torch.cat([p.directions for p in parts]), whole.directions)


def test_a_picture_is_its_pixels_and_reports_progress(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    trainer, camera = make_trainer(tile=37), scene.views[0].camera.resized(9, 7)
    trainer.step()
    heard: list[tuple[int, int]] = []
    color, depth = render_camera(trainer.method, camera, scene, lambda done, total: heard.append((done, total)))
    assert color.shape == (7, 9, 3)
    assert depth.shape == (7, 9)
    assert heard == [(37, 63), (63, 63)]
    one = trainer.method.render(camera_rays(camera, scene.near, scene.far, np.array([[8, 2]])))
    np.testing.assert_allclose(color[2, 8], one.color[0].numpy(), atol=1e-5)


def test_progress_may_cancel(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    def cancel(done: int, total: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        render_camera(make_trainer().method, scene.views[0].camera, scene, cancel)


def test_a_picture_is_written_in_the_wanted_mode(
    make_trainer: Callable[..., Trainer], scene: Scene, tmp_path: Path
) -> None:
    trainer, camera, file = make_trainer(tile=37), scene.views[0].camera.resized(9, 7), tmp_path / "picture.npy"
    trainer.step()
    job = StillJob(trainer.method, scene, ExportStill(camera, file, "view-dependence"))
    while job.advance():
        pass
    method = trainer.method
    expected = [shaded(method, rays, traced(method, rays), "view-dependence") for rays in tiles(method, camera, scene)]
    np.testing.assert_allclose(np.load(file), np.concatenate(expected).reshape(7, 9, 3), atol=1e-5)


def test_a_picture_in_an_unknown_mode_is_refused_at_once(
    make_trainer: Callable[..., Trainer], scene: Scene, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="unknown render mode 'heat'"):
        StillJob(make_trainer().method, scene, ExportStill(scene.views[0].camera, tmp_path / "x.png", "heat"))


def test_bytes_are_rounded_and_clipped() -> None:
    assert to_bytes(np.array([-1, 0, 0.5 / 255 - 1e-9, 0.5 / 255 + 1e-9, 1, 3])).tolist() == [0, 0, 0, 1, 255, 255]


@pytest.mark.parametrize("name", MODES.names())
def test_a_mode_has_a_number_for_each_pixel(make_trainer: Callable[..., Trainer], scene: Scene, name: str) -> None:
    mode = MODES.get(name)
    assert mode.label
    assert mode.tip
    assert mode.low < mode.high
    assert mode.colors in get_args(Name)
    method, rays = make_trainer().method, camera_rays(scene.views[0].camera, scene.near, scene.far)[:40]
    away = replace(rays, origins=rays.origins + 100)  # these rays meet nothing
    for some in (rays, away, rays[:1]):
        trace = traced(method, some)
        values = mode.values(method, some, trace)
        assert values.shape == (len(some),)
        assert values.is_floating_point()
        assert not values.isinf().any()
        picture = shaded(method, some, trace, name)
        assert (picture.shape, picture.dtype) == ((len(some), 3), np.float32)


def test_the_modes_stand_in_their_order_after_colour() -> None:
    first, *others = mode_names()
    assert first == COLOR
    assert sorted(others) == list(MODES.names())
    assert [MODES.get(name).order for name in others] == sorted(MODES.get(name).order for name in others)
