"""A scene small enough to train on in a test: a coloured ball on white, seen from a ring of cameras."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from desk import PATIENCE, Desk
from PIL import Image
from plain_methods import Going, OfCamera, Plain, Sampled

from nerf_core.datasets.capture import LoadOptions
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

hypothesis.settings.register_profile("steady", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("steady")

SIZE, ANGLE, NEAR, FAR = 16, 0.7, 2.0, 6.0
TINY = {"rays": "32", "coarse_samples": "12", "fine_samples": "12", "depth": "3", "width": "32", "chunk_rays": "16"}


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Run torch on one thread: tensors this small gain nothing from more, and the machine may be busy."""
    torch.set_num_threads(1)


def _camera(azimuth: float) -> Camera:
    back = np.array([np.cos(azimuth), np.sin(azimuth), 0.5])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    c2w = np.stack([right, np.cross(back, right), back, 4 * back], -1)
    focal = SIZE / 2 / np.tan(ANGLE / 2)
    return Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, c2w)


def _photo(camera: Camera) -> np.ndarray:
    """RGBA uint8 of the unit ball, coloured by its normal; transparent around it."""
    rays = camera_rays(camera, NEAR, FAR)
    o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
    ahead = (o * d).sum(-1)
    root = ahead**2 - (o * o).sum(-1) + 1
    normal = o + (-ahead - np.sqrt(root.clip(0)))[:, None] * d
    rgba = np.concatenate([0.5 + 0.5 * normal, (root > 0)[:, None]], -1) * (root > 0)[:, None]
    return (rgba.clip(0, 1) * 255 + 0.5).astype(np.uint8).reshape(SIZE, SIZE, 4)


def _cameras() -> list[Camera]:
    return [_camera(azimuth) for azimuth in np.linspace(0, 2 * np.pi, 6, endpoint=False)]


@pytest.fixture(scope="session")
def scene() -> Scene:
    """Six views of 16 × 16 pixels, one of them held out."""
    return _scene("ball", _cameras(), {"train": (0, 1, 2, 3, 4), "test": (5,)})


def _scene(name: str, cameras: list[Camera], splits: dict[str, tuple[int, ...]]) -> Scene:
    photos = [_photo(c).astype(np.float64) / 255 for c in cameras]
    images = [((p[..., :3] + 1 - p[..., 3:]) * 65535 + 0.5).astype(np.uint16) for p in photos]
    return Scene(
        name=name,
        format="blender",
        views=tuple(View(f"{i}.png", c) for i, c in enumerate(cameras)),
        photos=Photos.of(images),
        splits=splits,
        near=NEAR,
        far=FAR,
        background=(1.0, 1.0, 1.0),
        center=np.zeros(3),
        radius=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        to_input=np.eye(4),
        synthetic=True,
    )


@pytest.fixture(scope="session")
def facing() -> Scene:
    """Ten views of the same ball from a grid of places, all looking the same way; one of them is held out."""
    focal = SIZE / 2 / np.tan(ANGLE / 2)
    places = [(x, y, 4.0) for y in (-0.3, 0.3) for x in (-0.6, -0.3, 0.0, 0.3, 0.6)]
    cameras = [
        Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, np.column_stack([np.eye(3), place])) for place in places
    ]
    return _scene("facing ball", cameras, {"train": (0, 1, 2, 3, 4, 5, 7, 8, 9), "test": (6,)})


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scene on disk, in Blender's format."""
    folder = tmp_path_factory.mktemp("ball")
    frames: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for i, camera in enumerate(_cameras()):
        split = "test" if i == 5 else "train"
        (folder / split).mkdir(exist_ok=True)
        Image.fromarray(_photo(camera)).save(folder / split / f"r_{i}.png")
        matrix = [*camera.c2w.tolist(), [0, 0, 0, 1]]
        frames[split].append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
    for split, listed in frames.items():
        text = json.dumps({"camera_angle_x": ANGLE, "frames": listed})
        (folder / f"transforms_{split}.json").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def tiny() -> RunSettings:
    """Networks and batches so small that a step takes milliseconds."""
    return RunSettings(
        load=LoadOptions(), method="nerf", preset="complete", changes=dict(TINY), steps=100, device="cpu", threads=1
    )


@pytest.fixture
def make_trainer(scene: Scene, tiny: RunSettings) -> Callable[..., Trainer]:
    """A trainer of the tiny scene; keyword arguments change its constants."""

    def make(seed: int = 0, on: Scene = scene, **changes: object) -> Trainer:
        words = {name: str(value).lower() for name, value in changes.items()}
        return Trainer(on, replace(tiny, seed=seed, changes=tiny.changes | words))

    return make


@pytest.fixture
def open_desk(tiny: RunSettings, capture: Path) -> Iterator[Callable[..., Desk]]:
    """Starts workers on the capture (opened=False: without a scene) and ends them after the test."""
    desks: list[Desk] = []

    def start(opened: bool = True, steps: int = 100, **changes: str) -> Desk:
        settings = replace(tiny, steps=steps, changes=tiny.changes | changes)
        desks.append(Desk(settings, capture if opened else None))
        return desks[-1]

    yield start
    for desk in desks:
        assert desk.worker.stop(PATIENCE)


@pytest.fixture
def plain_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods with little: "plain" trains and renders, "sampled" has samples, "visiting" places, "posed" a camera."""
    METHODS.names()  # loads the others
    for name, kind in (("plain", Plain), ("sampled", Sampled), ("visiting", Going), ("posed", OfCamera)):
        monkeypatch.setitem(METHODS._items, name, kind)
