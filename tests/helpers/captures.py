"""Poses and photos of small captures, for the tests of all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image


def orbit_pose(angle: float, radius: float = 4.0) -> np.ndarray:
    """(4, 4) camera to world on a circle in the plane z = 1, looking at the origin, +z up."""
    centre = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.0])
    back = centre / np.linalg.norm(centre)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose


def write_photo(path: Path, size: tuple[int, int] = (24, 16), mode: str = "RGB", seed: int = 0) -> None:
    """A photo of random pixels, size = (width, height)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], len(mode)), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
