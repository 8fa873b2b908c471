"""Whole way of scenes that wide lenses have photographed: training, pictures, opened pixels, evidence and coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from balls import Ball, model_of

from nerf_core.datasets.capture import LoadOptions
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, Lens
from nerf_core.geometry.paths import PATHS
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.methods import Draw
from nerf_core.probe import open_pixel, walk
from nerf_core.rendering.images import render_camera
from nerf_core.training.batches import PixelSampler
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
BALLS = (  # ahead, behind, right, left, above, below of cameras in the middle
    Ball((0.0, 1.5, 0.0), 0.6, (0.9, 0.1, 0.1)),
    Ball((0.0, -1.5, 0.1), 0.5, (0.1, 0.8, 0.1)),
    Ball((1.4, 0.0, 0.2), 0.5, (0.1, 0.1, 0.9)),
    Ball((-1.5, 0.1, 0.0), 0.6, (0.9, 0.8, 0.1)),
    Ball((0.1, 0.0, 1.5), 0.5, (0.1, 0.8, 0.9)),
    Ball((0.0, 0.1, -1.5), 0.6, (0.8, 0.1, 0.9)),
)
LENSES = {
    "fisheye": Lens(k1=0.02, k2=-0.004, kind=FISHEYE),
    "equirectangular": Lens(kind=EQUIRECTANGULAR),
}
SIZES = {"fisheye": (22, 22), "equirectangular": (36, 18)}


def camera(kind: str, place: np.ndarray, turn: float) -> Camera:
    width, height = SIZES[kind]
    fx, fy = (width / 4.2, width / 4.2) if kind == "fisheye" else (width / 2 / np.pi, height / np.pi)
    forward = np.array([np.cos(turn), np.sin(turn), 0.1])
    back = -forward / np.linalg.norm(forward)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    c2w = np.column_stack([right, np.cross(back, right), back, place])
    return Camera(width, height, fx, fy, width / 2, height / 2, c2w, LENSES[kind])


@pytest.fixture(scope="module", params=list(LENSES))
def inside(request: pytest.FixtureRequest) -> Scene:
    """Balls in all directions, in closed form, seen from eight places in their middle; one view is held out."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.45, 0.45, (8, 3))
    cameras = [camera(request.param, place, 0.79 * k) for k, place in enumerate(places)]
    scene = Scene(
        name=request.param, format="transforms", views=tuple(View(f"{k}.png", c) for k, c in enumerate(cameras)),
        photos=Photos.empty([SIZES[request.param]] * 8), splits={"train": tuple(range(1, 8)), "test": (0,)},
        near=0.3, far=4.8, background=(1.0, 1.0, 1.0), center=np.zeros(3), radius=1.0, up=np.array([0.0, 0.0, 1.0]),
        to_input=np.eye(4), synthetic=True,
    )  # fmt: skip
    truth = model_of(scene, *BALLS)
    photos = [np.round(render_camera(truth, c, scene)[0] * 65535).astype(np.uint16) for c in cameras]
    return replace(scene, photos=Photos.of(photos))


def test_training_learns_what_wide_photos_show(inside: Scene) -> None:
    changes = {"rays": "512"}
    settings = RunSettings(load=LoadOptions(), method="voxels", changes=changes, steps=100, device="cpu", threads=1)
    trainer = Trainer(inside, settings)
    camera = inside.views[0].camera
    photo = inside.images[0] / 65535
    psnr = []
    for steps in (1, 100):
        while trainer.step_count < steps:
            trainer.step()
        color, _ = render_camera(trainer.method, camera, inside)
        psnr.append(-10 * np.log10(((color - photo) ** 2).mean()))
    assert psnr[1] > 20
    assert psnr[1] > psnr[0] + 5


def test_a_pixel_behind_the_camera_is_opened_with_evidence(inside: Scene) -> None:
    """A ball behind a camera is seen by the photos, and the walk says how the lens looks there."""
    eye = np.array([0.05, 0.0, -0.05])
    method, turned = model_of(inside, *BALLS), camera(inside.name, eye, np.pi / 2 - 0.35)
    offsets = np.array([ball.center for ball in BALLS]) - eye
    aside = np.degrees(np.arccos(-(offsets @ turned.c2w[:, 2]) / np.linalg.norm(offsets, axis=1)))
    pixels, depth = turned.project(np.array([ball.center for ball in BALLS]))
    seen = np.flatnonzero((aside > 91) & ((pixels >= 0) & (pixels < SIZES[inside.name])).all(-1))
    assert len(seen) > 0
    for k in seen:
        column, row = np.floor(pixels[k]).astype(int).tolist()
        opened = open_pixel(method, inside, turned, (column, row), 0)
        assert opened.ray.depth_median is not None
        assert abs(opened.ray.depth_median - (depth[k] - BALLS[k].radius)) < 0.25, (depth[k], opened.ray.depth_median)
        assert opened.evidence is not None
        assert opened.evidence.seen.sum() >= 2
        stages = walk(method, inside, turned, opened.ray)
        rows = dict(stages[0].rows)
        assert "on the sensor" in rows
        assert ("angle to the optical axis" in rows) == (inside.name == "fisheye")


def test_a_free_camera_stays_a_pinhole_and_sees_the_scene(inside: Scene) -> None:
    method = model_of(inside, *BALLS)
    for name in ("orbit", "test"):
        path = PATHS.get(name).cameras(inside, frames=1, width=24, height=24)
        assert path[0].lens.wide is (name == "test")
    free = replace(camera("fisheye", np.zeros(3), np.pi / 2), lens=Lens(), fx=20.0, fy=20.0)
    color, distance = render_camera(method, free, inside)
    assert np.linalg.norm(color[14, 14] - BALLS[0].color) < 0.1
    assert 0.7 < distance[14, 14] < 1.1


def test_the_corners_that_a_fisheye_lens_does_not_show_are_not_trained_on(inside: Scene) -> None:
    lens = Lens(k1=-0.15, kind=FISHEYE) if inside.name == "fisheye" else LENSES["equirectangular"]
    views = tuple(replace(v, camera=replace(v.camera, lens=lens)) for v in inside.views)
    folded, whole = replace(inside, views=views), PixelSampler(inside, 0, CPU, 0)
    rays, _ = PixelSampler(folded, 0, CPU, 0).draw(Draw(4000))
    plain, _ = whole.draw(Draw(4000))
    if inside.name != "fisheye":
        assert torch.equal(rays.directions, plain.directions)
        return
    fold = np.degrees((1 / 0.45) ** 0.5)
    index = torch.from_numpy(np.array([v.camera.c2w for v in views])[:, :, 3])
    back = torch.from_numpy(np.array([v.camera.c2w for v in views])[:, :, 2]).float()
    nearest = torch.cdist(rays.origins, index.float()).argmin(1)
    angle = torch.rad2deg(torch.arccos((-(rays.directions * back[nearest]).sum(-1)).clamp(-1, 1)))
    shown = np.pi * views[0].camera.lens.reach() ** 2 * 22**2 / 4.2**2  # pixels in the circle, in place of 22²
    assert shown < 0.5 * 22**2
    assert (angle > fold - 0.01).float().mean() < 0.05
