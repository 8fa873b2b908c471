"""A small valid capture of every kind, and what reads it, for `fuzzing.py`."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import colmap_models
import imageio_ffmpeg
import numpy as np
from captures import orbit_pose, write_photo
from exports import WRITERS
from fuzzing import Reader

from nerf_core.captures import posing
from nerf_core.captures.raw_photos import raw_photos
from nerf_core.captures.records import PoseOptions
from nerf_core.captures.search import Job
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.formats import colmap

SIZE = (24, 16)
KEY = "0123456789abcdef-fast"


class Reached(Exception):
    """The photos were read, and the search for poses would begin."""


def captures(base: Path) -> dict[str, Reader]:
    """Write one valid capture of every kind into `base`. Returns {name: reader}."""
    found: dict[str, Reader] = {}
    writers: dict[str, tuple[str, Callable[[Path], object]]] = {
        "blender": ("blender", _blender),
        "transforms": ("transforms", lambda folder: _transforms(folder, "OPENCV")),
        "transforms, fisheye": ("transforms", lambda folder: _transforms(folder, "OPENCV_FISHEYE")),
        "transforms, panoramas": ("transforms", lambda folder: _transforms(folder, "EQUIRECTANGULAR")),
        "masks": ("transforms", _masks),
        "llff": ("llff", _llff),
        "colmap, text": ("colmap", lambda folder: _colmap(folder, colmap_models.write_text)),
        "colmap, binary": ("colmap", lambda folder: _colmap(folder, colmap_models.write_binary)),
        "poses.json": ("", _posed),
    } | {kind: (kind, write) for kind, write in WRITERS.items()}
    for name, (kind, write) in writers.items():
        folder = base / f"capture of {name}"
        folder.mkdir()
        write(folder)
        found[name] = Reader(folder, lambda f=folder, k=kind: _load(f, k))
    found["raw photos"] = Reader(_raw_photos(base / "raw photos"), lambda: _prepare(base / "raw photos", base))
    found["video"] = Reader(_video(base / "video"), lambda: _prepare(base / "video", base), cost=8)
    return found


def _load(folder: Path, kind: str) -> object:
    """Open a capture of a format; of poses.json, look whether it is a result before."""
    if not kind:
        posing._known(folder, KEY)  # pyright: ignore[reportPrivateUsage]
    with mock.patch.object(colmap, "run_limited", colmap_models.read_forked):
        return load_scene(folder, LoadOptions(format=kind or "auto"))


def _prepare(folder: Path, base: Path) -> None:
    """Recognise photos or a video without poses, and read all that a search for poses reads."""
    raw = raw_photos(folder)
    if raw is None:
        load_scene(folder, LoadOptions())  # which says that there is nothing
        raise AssertionError("what has no poses was loaded")
    with mock.patch.object(Job, "run", side_effect=Reached):
        try:
            posing.find_poses(raw, base / "poses", PoseOptions("fast"), lambda _: None)
        except Reached:
            assert not (base / "poses").exists()


def _frames(names: list[str]) -> list[dict[str, Any]]:
    return [{"file_path": n, "transform_matrix": orbit_pose(0.3 + 0.9 * i).tolist()} for i, n in enumerate(names)]


def _blender(folder: Path) -> None:
    for k, (split, count) in enumerate((("train", 2), ("val", 1), ("test", 1))):
        names = [f"./{split}/r_{i}" for i in range(count)]
        for i, name in enumerate(names):
            write_photo(folder / f"{name}.png", SIZE, "RGBA", seed=10 * k + i)
        text = json.dumps({"camera_angle_x": 0.7, "frames": _frames(names)})
        (folder / f"transforms_{split}.json").write_text(text)


def _transforms(folder: Path, model: str, **more: Any) -> None:
    names = [f"images/{i}.{'jpg' if i % 2 else 'png'}" for i in range(4)]
    for i, name in enumerate(names):
        write_photo(folder / name, SIZE, seed=i)
    common: dict[str, Any] = {"camera_model": model, "w": 24, "h": 16, "aabb_scale": 4, "near": 0.5, "far": 9.0}
    if model != "EQUIRECTANGULAR":
        common |= {"fl_x": 30.0, "fl_y": 31.0, "cx": 12.5, "cy": 7.5, "k1": 0.02, "k2": -0.01, "k3": 0.001}
        common |= {"k4": 0.0} if model == "OPENCV_FISHEYE" else {"p1": 0.001, "p2": 0.0, "camera_angle_x": 0.7}
    frames = _frames(names)
    for frame, mask in zip(frames, more.get("masks", ()), strict=False):
        frame["mask_path"] = mask
    splits = {"train_filenames": names[:3], "test_filenames": names[3:]}
    (folder / "transforms.json").write_text(json.dumps(common | splits | {"frames": frames}))


def _masks(folder: Path) -> None:
    """One mask that the file lists, one in the folder masks, one beside its photo, and one photo with alpha."""
    _transforms(folder, "OPENCV", masks=["listed/a.png"])
    write_photo(folder / "listed/a.png", SIZE, seed=8)
    write_photo(folder / "masks/1.jpg.png", (48, 32), seed=9)
    write_photo(folder / "images/2.mask.png", SIZE, seed=10)
    write_photo(folder / "images/3.jpg", SIZE)
    (folder / "images/3.jpg").unlink()
    write_photo(folder / "images/3.png", SIZE, "RGBA", seed=3)


def _llff(folder: Path) -> None:
    rows = []
    for i in range(4):
        write_photo(folder / f"images/{i}.png", SIZE, seed=i)
        pose = orbit_pose(0.3 + 0.2 * i)[:3]
        axes = np.stack([-pose[:, 1], pose[:, 0], pose[:, 2], pose[:, 3], [16, 24, 30]], 1)
        rows.append([*axes.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def _colmap(folder: Path, write: Callable[[Path], None]) -> None:
    for i, name in enumerate(colmap_models.NAMES):
        write_photo(folder / "images" / name, SIZE, seed=i)
    write(folder / "sparse/0")


def _posed(folder: Path) -> None:
    _colmap(folder, colmap_models.write_binary)
    said = {"format": posing.FORMAT, "key": KEY, "upright": True, "names": colmap_models.NAMES}
    said |= {"unplaced": [["a.png", "blurred"]], "error": 0.5, "points": 500, "advice": "", "seconds": 9.0}
    (folder / posing.DONE).write_text(json.dumps(said))


def _raw_photos(folder: Path) -> Path:
    for i, suffix in enumerate(("jpg", "png", "webp", "tif", "bmp")):
        write_photo(folder / f"a{i}.{suffix}", SIZE, seed=i)
    return folder


def _video(folder: Path) -> Path:
    folder.mkdir()
    command = "-v error -f lavfi -i testsrc2=size=192x64:rate=8:duration=1.5 -vf crop=64:48:80*t:8 -pix_fmt yuv420p"
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *command.split(), f"{folder.name}.mp4"], cwd=folder, check=True)
    return folder
