"""Render the demo scene into Blender's NeRF format: `python assets/make_demo.py [--out DIR]`.

Deterministic: the same numpy and Pillow give the same bytes; others may round a pixel's value the other way.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from demo_scene import render
from demo_shapes import Array, unit
from PIL import Image

SIZE = 200
SUPERSAMPLE = 5
CAMERA_ANGLE_X = 0.69
DISTANCE = 4.0
# views, lowest and highest elevation in degrees, turn of the spiral: no two splits share a pose
SPLITS = {"train": (72, 3, 72, 0.0), "val": (6, 12, 55, 0.37), "test": (12, 8, 60, 0.71)}


def look_at_origin(azimuth: float, elevation: float) -> Array:
    """Pose (4, 4) at DISTANCE from the origin, OpenGL axes, z up; radians. Rounded so that JSON holds it exactly."""
    sideways = np.cos(elevation)
    back = np.array([sideways * np.cos(azimuth), sideways * np.sin(azimuth), np.sin(elevation)])
    right = unit(np.cross([0.0, 0.0, 1.0], back))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, DISTANCE * back], -1)
    return pose.round(12)


def poses(count: int, lowest: float, highest: float, turn: float) -> list[Array]:
    """A Fibonacci spiral over the band of the sphere between two elevations: every view has as much area."""
    golden = np.pi * (3 - np.sqrt(5))
    low, high = np.sin(np.radians([lowest, highest]))
    heights = low + (high - low) * (np.arange(count) + 0.5) / count
    return [look_at_origin(golden * i + 2 * np.pi * turn, np.arcsin(z)) for i, z in enumerate(heights)]


def picture(pose: Array) -> np.ndarray:
    """The RGBA picture (SIZE, SIZE, 4) uint8 of one pose."""
    return (render(pose, SIZE, SIZE, CAMERA_ANGLE_X, SUPERSAMPLE) * 255).round().astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "demo")
    out: Path = parser.parse_args().out
    with ProcessPoolExecutor() as pool:
        for split, spiral in SPLITS.items():
            (out / split).mkdir(parents=True, exist_ok=True)
            frames = []
            for i, (pose, rgba) in enumerate(zip(poses(*spiral), pool.map(picture, poses(*spiral)), strict=True)):
                Image.fromarray(rgba).save(out / split / f"r_{i}.png", optimize=True)
                frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
            transforms = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
            (out / f"transforms_{split}.json").write_text(json.dumps(transforms, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
