"""Mitsuba 3 (https://mitsuba-renderer.org, on PyPI): a grid of density and spherical harmonics, learnt by its AD.

Mitsuba has no trainer of radiance fields. This is the model that its documentation suggests for one, an emissive volume
on a regular grid, written here with its textures and its automatic differentiation. The file is also the script that
its Python runs: it must not import nerf_core.
"""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

NAME, UNIT, FIRST = "Mitsuba 3", "iterations", 20
OPTION, HELP = "mitsuba", "the python of an environment with mitsuba (pip install mitsuba; it needs LLVM's library)"

RAYS, SAMPLES = 8192, 64  # an iteration
GRIDS = (16, 32, 64, 96)  # cells a side, an equal share of the iterations each
RATE = 0.05  # of Adam
DENSITY = 10  # in the ball's radius, of a cell's value 1
Rays = tuple[np.ndarray, np.ndarray]
Y0, Y1 = 0.28209479177387814, 0.4886025119029199  # spherical harmonics of degree 0 and 1


def missing(given: str) -> str:
    python = shutil.which(given or "python3")
    code = "import mitsuba as m; m.set_variant('llvm_ad_rgb'); import drjit; drjit.eval(drjit.llvm.Float(1) + 1)"
    if python and not subprocess.run([python, "-c", code], capture_output=True, check=False).returncode:
        return ""
    return "pip install mitsuba in an environment, and LLVM's library, then --mitsuba PYTHON"


def command(photos: Path, folder: Path, amount: float, given: str) -> list[str]:
    """Train for `amount` iterations, which all grids share."""
    return [given or "python3", __file__, "train", str(photos), str(folder), str(max(8, round(amount)))]


def render(photos: Path, folder: Path, given: str) -> list[np.ndarray]:
    """Draw the held-out views, float (H, W, 3) in [0, 1], in the order of test_filenames."""
    subprocess.run([given or "python3", __file__, "render", str(photos), str(folder), "0"], check=True)
    with np.load(folder / "pictures.npz") as pictures:
        return [pictures[str(i)] for i in range(len(pictures.files))]


class Grid:
    """A cube of cells with a density and 3 × 4 coefficients, in contracted space where the capture is a place.

    Inside the ball around the content, space is as it is; outside, x → (2 − 1/|x|) x/|x| (Barron et al. 2022,
    mip-NeRF 360, Eq. 10). The ball's radius is 1.
    """

    def __init__(self, whole: dict[str, Any], data: np.ndarray) -> None:
        self.mi, self.dr = importlib.import_module("mitsuba"), importlib.import_module("drjit")
        self.whole, self.extent = whole, 1.0 if whole["synthetic"] else 2.0
        places = np.array([frame["transform_matrix"] for frame in whole["frames"]])[:, :3]
        axes = np.eye(3) - places[:, :, 2:3] * places[:, None, :, 2]
        self.center = np.linalg.solve(axes.sum(0), np.einsum("nij,nj->i", axes, places[:, :, 3]))  # nearest to all axes
        away = float(np.linalg.norm(places[:, :, 3] - self.center, axis=1).mean())
        self.radius = (whole["far"] - whole["near"]) / 2 if whole["synthetic"] else away
        self.near, self.far = whole["near"], whole["far"]
        self.put(data)

    def put(self, data: np.ndarray) -> None:
        """Take the values of all cells, (N, N, N, 13)."""
        tensor = self.mi.TensorXf(np.ascontiguousarray(data, np.float32))
        self.texture = self.mi.Texture3f(tensor, wrap_mode=self.dr.WrapMode.Clamp)

    def color(self, rays: Rays, jitter: np.ndarray, samples: int) -> Any:
        """Composite `samples` along each of R rays, as a Color3f.

        All samples are one wide array: a loop that is unrolled takes LLVM minutes to compile. jitter: (R,) in [0, 1).
        """
        mi, dr = self.mi, self.dr
        ends = np.linspace(0, 1, samples + 1)
        edges = self.near + (self.far - self.near) * ends
        if not self.whole["synthetic"]:
            edges = 1 / (1 / self.near + (1 / self.far - 1 / self.near) * ends)
        count = len(jitter)
        steps = np.diff(edges)
        along = mi.Float(np.ravel(edges[:-1] + steps * jitter[:, None]).astype(np.float32))
        origins, directions = (np.repeat(v, samples, 0).astype(np.float32).T for v in rays)
        at = mi.Point3f((origins - self.center[:, None]) / self.radius) + mi.Vector3f(directions / self.radius) * along
        if not self.whole["synthetic"]:
            length = dr.maximum(dr.norm(at), 1e-6)
            at = dr.select(length > 1, at * ((2 - 1 / length) / length), at)
        values = self.texture.eval(at / (2 * self.extent) + 0.5)
        inside = dr.all((at > -self.extent) & (at < self.extent))
        depth = mi.Float(np.tile(steps, count).astype(np.float32)) * (DENSITY / self.radius)
        depth *= dr.select(inside, dr.maximum(values[0], 0), 0)
        left = dr.exp(-dr.block_prefix_sum(depth, samples, exclusive=True))
        weight = left * (1 - dr.exp(-depth))
        toward = dr.normalize(mi.Vector3f(directions))
        harmonics = (Y0, -Y1 * toward.y, Y1 * toward.z, -Y1 * toward.x)
        channels = []
        for c, behind in enumerate(self.whole["background"]):
            value = dr.clip(sum(values[1 + 4 * c + k] * harmonics[k] for k in range(4)) + 0.5, 0, 1)
            channels.append(dr.block_sum(weight * (value - behind), samples) + behind)
        return mi.Color3f(*channels)


def train(photos: Path, folder: Path, iterations: int) -> None:
    """Learn the grid from random rays of all training photos, and write it to grid.npz."""
    mi, dr = start()
    whole = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
    frames = {frame["file_path"]: frame for frame in whole["frames"]}
    views = [frames[name] for name in whole["train_filenames"]]
    image = importlib.import_module("PIL.Image")
    pictures = [np.asarray(image.open(photos / name), np.float32) / 255 for name in whole["train_filenames"]]
    random = np.random.default_rng(0)
    data = np.zeros((GRIDS[0],) * 3 + (13,), np.float32)
    data[..., 0] = 0.01
    grid = Grid(whole, data)
    for level, size in enumerate(GRIDS):
        if level:
            grid.put(finer(np.array(grid.texture.tensor()), size))
        optimiser = mi.ad.Adam(lr=RATE, mask_updates=True)
        optimiser["grid"] = grid.texture.tensor()
        for _ in range(iterations // len(GRIDS)):
            grid.texture.set_tensor(optimiser["grid"])
            chosen = random.integers(len(views), size=RAYS)
            drawn, truth = batch(views, pictures, chosen, random)
            shown = grid.color(drawn, random.random(RAYS), SAMPLES)
            loss = dr.mean(dr.square(shown - mi.Color3f(truth.T)), axis=None)
            dr.backward(loss)
            optimiser.step()
        grid.texture.set_tensor(optimiser["grid"])
    np.savez(folder / "grid.npz", grid=np.array(dr.detach(grid.texture.tensor())))


def batch(
    views: list[dict[str, Any]], pictures: list[np.ndarray], chosen: np.ndarray, random: np.random.Generator
) -> tuple[Rays, np.ndarray]:
    """Draw a random pixel of each chosen view. Returns rays and colours, float32 (R, 3)."""
    parts = []
    for k in np.unique(chosen):
        count, view = int((chosen == k).sum()), views[k]
        x, y = random.integers(view["w"], size=count), random.integers(view["h"], size=count)
        parts.append((*rays(view, x, y), pictures[k][y, x]))
    origins, directions, truth = (np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True))
    return (origins, directions), truth


def rays(view: dict[str, Any], x: np.ndarray, y: np.ndarray) -> Rays:
    """Return origins and directions (R, 3) through pixels. A direction's length is 1 along the optical axis."""
    pose = np.array(view["transform_matrix"])
    plane = [(x + 0.5 - view["cx"]) / view["fl_x"], -(y + 0.5 - view["cy"]) / view["fl_y"], -np.ones(len(x))]
    directions = np.stack(plane, -1) @ pose[:3, :3].T
    return np.broadcast_to(pose[:3, 3], directions.shape), directions


def finer(data: np.ndarray, size: int) -> np.ndarray:
    """Resample (N, N, N, C) to `size` cells a side, linearly along one axis after the other."""
    for axis in range(3):
        old = data.shape[axis]
        at = np.clip((np.arange(size) + 0.5) * old / size - 0.5, 0, old - 1)
        low = np.minimum(at.astype(int), old - 2)
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(4)])
        data = np.take(data, low, axis) * (1 - share) + np.take(data, low + 1, axis) * share
    return data


def draw(photos: Path, folder: Path) -> None:
    """Write the held-out views to pictures.npz."""
    start()
    whole = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
    frames = {frame["file_path"]: frame for frame in whole["frames"]}
    grid = Grid(whole, np.load(folder / "grid.npz")["grid"])
    found = {}
    for i, name in enumerate(whole["test_filenames"]):
        view = frames[name]
        y, x = np.divmod(np.arange(view["w"] * view["h"]), view["w"])
        rows = [
            np.array(
                grid.color(
                    rays(view, x[k : k + RAYS], y[k : k + RAYS]), np.full(len(x[k : k + RAYS]), 0.5), 2 * SAMPLES
                )
            ).T
            for k in range(0, len(x), RAYS)
        ]
        found[str(i)] = np.concatenate(rows).reshape(view["h"], view["w"], 3)
    np.savez(folder / "pictures.npz", **found)


def start() -> tuple[Any, Any]:
    """Load Mitsuba for automatic differentiation on the CPU."""
    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba, importlib.import_module("drjit")


if __name__ == "__main__":
    task, photos_folder, run_folder, count = sys.argv[1:]
    if task == "train":
        train(Path(photos_folder), Path(run_folder), int(count))
    else:
        draw(Path(photos_folder), Path(run_folder))
