"""Write a capture's photos, poses and points so that each program reads the same pixels.

Photos become those of a pinhole whose principal point is the picture's centre, because some programs know no other
camera. They are resampled once, with `downscale` × `downscale` samples a pixel, and stored as PNGs of 8 bits. The poses
are in the capture's own frame. The folder holds:

    images/                  every photo
    transforms.json          nerfstudio's format, with the splits and z-depth bounds
    train/transforms.json    the training photos alone, for programs that know no splits
    transforms_train.json, transforms_test.json    the same for Blender's format, if the capture is synthetic
    points.ply               sparse points with colours
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch.nn import functional

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.capture import DATASETS
from nerf_core.datasets.recognise import recognise
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import PINHOLE
from nerf_core.geometry.scene import Scene

RANDOM_POINTS = 10_000  # for captures without sparse points
ZOOM = 1.005  # step by which the focal length grows until no pixel lies outside the distorted photo
VIEWS_A_POINT = 8  # training photos at most whose median colours a point


def prepare(data: Path, format_name: str, downscale: int, folder: Path) -> dict[str, Any]:
    """Write the folder, and return what transforms.json holds.

    Args:
        data: a posed capture that nerf_core can load.
        format_name: a name of `DATASETS`, or "auto".
        downscale: full-size pixels a side that make one pixel.
        folder: where to write.
    """
    scene = load_scene(data, LoadOptions(format=format_name))
    train, (_, held_out) = scene.split("train"), scene.held_out()
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "train").mkdir(exist_ok=True)
    frames: dict[int, dict[str, Any]] = {}
    for i in sorted({*train, *held_out}):
        camera, image = pinhole(scene.views[i].camera, scene.images[i], downscale)
        name = f"images/{i:04}.png"
        Image.fromarray(image).save(folder / name)
        frames[i] = {"file_path": name, **lens(camera), "transform_matrix": in_input_frame(scene, camera).tolist()}
    unit = float(np.linalg.norm(scene.to_input[:3, 0]))
    whole = {
        "camera_model": "PINHOLE",
        "near": scene.near * unit,
        "far": scene.far * unit,
        "ply_file_path": "points.ply",
        "synthetic": scene.synthetic,
        "ndc": scene.ndc is not None,
        "background": list(scene.background),
        "train_filenames": [frames[i]["file_path"] for i in train],
        "val_filenames": [frames[i]["file_path"] for i in held_out],  # nerfstudio wants both
        "test_filenames": [frames[i]["file_path"] for i in held_out],
        "frames": list(frames.values()),
    }
    write(folder / "transforms.json", whole)
    outer = [{**frames[i], "file_path": f"../{frames[i]['file_path']}"} for i in train]
    write(folder / "train" / "transforms.json", {**common(whole), "ply_file_path": "../points.ply", "frames": outer})
    if scene.synthetic:
        for name, split in (("train", train), ("test", held_out)):
            part = {**common(whole), "frames": [frames[i] for i in split]}
            write(folder / f"transforms_{name}.json", part)
    points = sparse_points(scene, data, format_name)
    write_points(folder / "points.ply", points, colours(scene, points))
    return whole


def pinhole(camera: Camera, image: np.ndarray, downscale: int) -> tuple[Camera, np.ndarray]:
    """Resample a photo to a centred pinhole.

    Args:
        camera: the photo's camera, with a lens and any principal point.
        image: uint16 (H, W, 3).
        downscale: how many times smaller the result is.

    Returns:
        The pinhole camera, and its photo, uint8 (H', W', 3). Its view is as wide as the photo allows.
    """
    width, height = round(camera.width / downscale), round(camera.height / downscale)
    small = replace(camera.resized(width, height), cx=width / 2, cy=height / 2, lens=PINHOLE)
    u, v = np.linspace(0, width, 65), np.linspace(0, height, 65)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(x, y), -1) for x, y in ((u, 0), (u, height), (0, v), (width, v))]
    )
    size = np.array([camera.width, camera.height])
    while not (((at := seen_at(camera, small, border)) >= -1e-6) & (at <= size + 1e-6)).all():
        small = replace(small, fx=small.fx * ZOOM, fy=small.fy * ZOOM)
    x, y = ((np.arange(n * downscale) + 0.5) / downscale for n in (width, height))
    at = seen_at(camera, small, np.stack(np.meshgrid(x, y), -1))
    grid = torch.from_numpy(2 * at / size - 1)[None]
    source = torch.from_numpy(image.astype(np.float64) / 65535).permute(2, 0, 1)[None]
    fine = functional.grid_sample(source, grid, "bilinear", "border", align_corners=False)
    done = functional.avg_pool2d(fine, downscale)[0].permute(1, 2, 0).numpy()
    return small, (done * 255 + 0.5).astype(np.uint8)


def seen_at(camera: Camera, small: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return where `camera` sees what the pinhole `small` sees at `pixels` (…, 2), in pixels."""
    plane = (pixels - [small.cx, small.cy]) / [small.fx, small.fy]
    local = np.stack([plane[..., 0], -plane[..., 1], -np.ones_like(plane[..., 0])], -1).reshape(-1, 3)
    return camera.lens.see(local).bent.reshape(plane.shape) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def lens(camera: Camera) -> dict[str, float]:
    """Return a pinhole's intrinsics under nerfstudio's names, in pixels."""
    return {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
    }  # fmt: skip


def in_input_frame(scene: Scene, camera: Camera) -> np.ndarray:
    """Return camera-to-world (4, 4) with OpenGL axes in the frame of the capture's files."""
    pose = scene.to_input @ np.vstack([camera.c2w, [0, 0, 0, 1]])
    pose[:3, :3] /= np.linalg.norm(scene.to_input[:3, 0])  # a similarity scales positions alone, not the axes
    return pose


def common(whole: dict[str, Any]) -> dict[str, Any]:
    return {key: whole[key] for key in ("camera_model", "near", "far", "ply_file_path")}


def write(file: Path, content: dict[str, Any]) -> None:
    file.write_text(json.dumps(content, indent=1), encoding="utf-8")


def sparse_points(scene: Scene, data: Path, format_name: str) -> np.ndarray:
    """Return the capture's sparse points (P, 3) in its own frame, or random ones in a ball around its centre."""
    source, name, _ = recognise(data, format_name)
    found = DATASETS.get(name).read(source, LoadOptions(format=format_name)).points
    if found is not None:
        return found
    random = np.random.default_rng(0)
    inside = random.normal(size=(RANDOM_POINTS, 3))
    inside *= random.random((RANDOM_POINTS, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    points = scene.center + min(scene.radius, (scene.far - scene.near) / 2) * inside
    return points @ scene.to_input[:3, :3].T + scene.to_input[:3, 3]


def colours(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return a colour for each point, uint8 (P, 3): the median of those training photos that have it in their frame.

    Args:
        scene: the capture.
        points: (P, 3) in the frame of the capture's files.
    """
    local = (np.c_[points, np.ones(len(points))] @ np.linalg.inv(scene.to_input).T)[:, :3]
    seen = np.full((VIEWS_A_POINT, len(points), 3), np.nan)
    count = np.zeros(len(points), int)
    for i in scene.split("train"):
        camera, image = scene.views[i].camera, scene.images[i]
        pixels, depth = camera.project(local)
        with np.errstate(invalid="ignore"):
            framed = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        index = np.flatnonzero(framed & (count < VIEWS_A_POINT))
        x, y = pixels[index].astype(int).T
        seen[count[index], index] = image[y, x] / 257
        count[index] += 1
    seen[0, count == 0] = 128  # no training photo has it in its frame
    return np.nanmedian(seen, 0).round().astype(np.uint8)


def write_points(file: Path, points: np.ndarray, colour: np.ndarray) -> None:
    """Write points (P, 3) with colours uint8 (P, 3) as a binary PLY."""
    names = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *names, "end_header", ""]
    rows = (struct.pack("<3f3B", *p, *c) for p, c in zip(points.tolist(), colour.tolist(), strict=True))
    file.write_bytes("\n".join(head).encode() + b"".join(rows))
