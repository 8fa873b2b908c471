"""OpenSplat: 3D Gaussian splatting in C++ (https://github.com/pierotofy/OpenSplat), a binary that the user names.

It draws one held-out photo at most, and only while it trains, so the splats that it writes are drawn here: as in 3D
Gaussian splatting (Kerbl et al. 2023, arXiv:2308.04079), with the constants of OpenSplat's own rasteriser. Pictures
agree with OpenSplat's to the rounding of 8 bits.

The CPU rasteriser of version 1.1.5 does not sort by depth: it reads the third columns of a (P, 3) array as if they lay
side by side. It trains with that order too, so that its models look best in it. Here the training photos tell whether a
model is to be drawn in that order or by depth.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from PIL import Image

Key = Callable[[np.ndarray, dict[str, Any]], np.ndarray]

NAME, UNIT, FIRST = "OpenSplat", "iterations", 200
OPTION, HELP = "opensplat", "the opensplat binary"

BACKGROUND = (0.6130, 0.0101, 0.3984)  # OpenSplat trains over this colour
BLUR = 0.3  # square pixels added to a splat's covariance
NEAR, FAR = 0.001, 1000.0  # of its projection
LIMIT = 1.3  # of the field of view: farther out the projection is linearised there
Y0, Y1 = 0.28209479177387814, 0.4886025119029199  # real spherical harmonics, degrees 0 to 3
Y2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
Y3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def missing(given: str) -> str:
    if shutil.which(given or "opensplat"):
        return ""
    return "build it for a CPU (cmake -DGPU_RUNTIME=CPU with libtorch and OpenCV), then --opensplat PATH"


def command(photos: Path, folder: Path, amount: float, given: str) -> list[str]:
    """Train for `amount` iterations. Its schedule is for 30,000: the parts that count iterations are shortened alike.

    The photos are small already, so that training does not begin with smaller ones.
    """
    n = max(10, round(amount))
    schedule = {
        "num-iters": n,
        "num-downscales": 0,
        "sh-degree-interval": max(1, n // 30),
        "warmup-length": min(500, max(100, n // 10)),  # from 100 on, opacities are not reset at the start
    }
    words = [f"--{name}={value}" for name, value in schedule.items()]
    # its rasteriser has one thread; a second one of torch waits busily: a third more CPU seconds, 6 % less wall
    start = ["env", "OMP_NUM_THREADS=1", given or "opensplat"]
    return [*start, str(photos / "train"), "--cpu", "--keep-crs", "-o", str(folder / "splat.ply"), *words]


def render(photos: Path, folder: Path, given: str) -> list[np.ndarray]:
    """Draw the held-out views, float (H, W, 3) in [0, 1], in the order of test_filenames."""
    whole = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
    frames = {frame["file_path"]: frame for frame in whole["frames"]}
    splats = read_splats(folder / "splat.ply")
    train = whole["train_filenames"]
    places = np.array([frames[name]["transform_matrix"] for name in train])[:, :3, 3]
    unit = float(np.abs(places - places.mean(0)).max())
    errors = {}
    for key in (depth_order, lambda view, frame: released_order(view / unit, frame)):
        shown = [draw(splats, frames[name], key) - picture(photos / name) for name in train[:: len(train) // 4]]
        errors[key] = np.mean([np.square(v).mean() for v in shown])
    best = min(errors, key=lambda key: errors[key])
    return [draw(splats, frames[name], best) for name in whole["test_filenames"]]


def picture(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file)) / 255


def depth_order(view: np.ndarray, frame: dict[str, Any]) -> np.ndarray:
    """Return what to sort splats by: their depth.

    Args:
        view: (P, 3) their centres in camera axes, z forward.
        frame: one of transforms.json.
    """
    return view[:, 2]


def released_order(view: np.ndarray, frame: dict[str, Any]) -> np.ndarray:
    """Return what version 1.1.5 sorts by; see above. Lengths are in its unit, the cameras' largest coordinate."""
    x, y, z = view.T
    w = np.maximum(z, 1e-6)
    depth = ((FAR + NEAR) * z - FAR * NEAR) / (FAR - NEAR)
    projected = np.stack(
        [2 * frame["fl_x"] / frame["w"] * x / w, 2 * frame["fl_y"] / frame["h"] * y / w, depth / w], -1
    )
    return np.append(projected.astype(np.float32).ravel(), [0, 0])[2 : 2 + len(view)]


def read_splats(file: Path) -> dict[str, np.ndarray]:
    """Read the properties of P splats by name, float32 (P,)."""
    head, body = file.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property float")]
    rows = np.frombuffer(body, np.float32).reshape(-1, len(names))
    return dict(zip(names, rows.T, strict=True))


def draw(splats: dict[str, np.ndarray], frame: dict[str, Any], key: Key) -> np.ndarray:
    """Draw one frame of transforms.json, float64 (H, W, 3), with the splats sorted by `key`."""

    def stacked(name: str, count: int) -> np.ndarray:
        return np.stack([splats[f"{name}_{i}"] for i in range(count)], -1).astype(np.float64)

    c2w, focal = np.array(frame["transform_matrix"]), np.array([frame["fl_x"], frame["fl_y"]])
    size = np.array([frame["w"], frame["h"]])
    w2c = (c2w[:3, :3] * (1, -1, -1)).T  # to axes with y down and z forward
    means = np.stack([splats[axis] for axis in "xyz"], -1).astype(np.float64)
    ahead = means - c2w[:3, 3]
    view = ahead @ w2c.T
    kept = view[:, 2] > 0.01 * np.median(np.abs(view[:, 2]))
    x, y, z = view[kept].T
    turned = w2c @ rotations(stacked("rot", 4)[kept]) * np.exp(stacked("scale", 3)[kept])[:, None]
    edge = LIMIT * size / (2 * focal)
    tx, ty = (np.clip(v / z, -e, e) for v, e in zip((x, y), edge, strict=True))
    zero = np.zeros_like(z)
    jacobian = np.stack(
        [focal[0] * np.stack([1 / z, zero, -tx / z], -1), focal[1] * np.stack([zero, 1 / z, -ty / z], -1)], 1
    )
    flat = jacobian @ turned
    covariance = flat @ flat.transpose(0, 2, 1) + BLUR * np.eye(2)
    centres = np.stack([x, y], -1) / z[:, None] * focal + size / 2 - 0.5
    opacity = 1 / (1 + np.exp(-splats["opacity"][kept].astype(np.float64)))
    rest = stacked("f_rest", 45)[kept].reshape(-1, 3, 15)
    harmonics = np.concatenate([stacked("f_dc", 3)[kept][:, :, None], rest], 2)
    directions = ahead[kept] / np.linalg.norm(ahead[kept], axis=1, keepdims=True)
    colour = np.maximum(np.einsum("pck,pk->pc", harmonics, basis(directions)) + 0.5, 0)
    order = np.argsort(key(view, frame)[kept], kind="stable")
    centres, covariance, opacity, colour = (v[order] for v in (centres, covariance, opacity, colour))
    return blend(size[::-1], centres, covariance, opacity, colour, np.array(BACKGROUND))


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Turn quaternions w, x, y, z (P, 4) into matrices (P, 3, 3)."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], 1)


def basis(directions: np.ndarray) -> np.ndarray:
    """Return the 16 real spherical harmonics up to degree 3 of unit vectors (P, 3), as (P, 16)."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    first = (-Y1 * y, Y1 * z, -Y1 * x)
    second = (x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy)
    third = (
        y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy), x * (4 * zz - xx - yy),
        z * (xx - yy), x * (xx - 3 * yy),
    )  # fmt: skip
    parts = [np.full_like(x, Y0), *first]
    parts += [c * v for c, v in zip((*Y2, *Y3), (*second, *third), strict=True)]
    return np.stack(parts, -1)


@numba.njit(cache=True)
def blend(
    shape: np.ndarray, centres: np.ndarray, covariance: np.ndarray, opacity: np.ndarray, colour: np.ndarray,
    background: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Composite P splats, sorted by depth, in front of a background.

    Args:
        shape: height and width.
        centres: (P, 2) column and row of the centres; a pixel's centre has whole numbers.
        covariance: (P, 2, 2) in square pixels.
        opacity, colour: (P,) and (P, 3).
        background: (3,).
    """
    height, width = shape
    image, left = np.zeros((height, width, 3)), np.ones((height, width))
    done = np.zeros((height, width), np.bool_)
    for p in range(len(centres)):
        a, b, c = covariance[p, 0, 0], covariance[p, 0, 1], covariance[p, 1, 1]
        det = max(a * c - b * b, 1e-6)
        reach_x, reach_y = 3 * np.sqrt(a), 3 * np.sqrt(c)
        x, y = centres[p]
        for i in range(max(0, int(np.floor(y - reach_y)) - 2), min(height, int(np.ceil(y + reach_y)) + 2)):
            for j in range(max(0, int(np.floor(x - reach_x)) - 2), min(width, int(np.ceil(x + reach_x)) + 2)):
                if done[i, j]:
                    continue
                dx, dy = x - j, y - i
                sigma = 0.5 * (c * dx * dx + a * dy * dy) / det - b * dx * dy / det
                alpha = min(0.999, opacity[p] * np.exp(-sigma))
                if sigma < 0 or alpha < 1 / 255:
                    continue
                if left[i, j] * (1 - alpha) <= 1e-4:
                    done[i, j] = True
                    continue
                image[i, j] += alpha * left[i, j] * colour[p]
                left[i, j] *= 1 - alpha
    for i in range(height):
        for j in range(width):
            image[i, j] += left[i, j] * background
    return np.minimum(image, 1)
