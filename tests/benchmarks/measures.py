"""What tables.py measures besides learning: steps, pictures, memory, compiling. Each in a process of its own."""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
import torch
from torch import Tensor

from nerf_core.common.jit.shards import each_shard, split
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.voxel_kernels import Adam
from nerf_core.methods.voxels.method import Voxels
from nerf_core.rendering.images import render_camera
from nerf_core.training.metrics import psnr
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.voxel_grid import VoxelGrid

DIPS = {"lego": 8, "fox": 8, "fern": 8, "can": 8}  # scenes, and by how much their photos are downscaled


def rates(scene: Scene, rounds: int) -> dict[str, Any]:
    """Measure rays per second of the voxel method after 600 steps, in turns with the paper's model in plain float32."""
    from training import PlainNerf, seconds

    trainer = Trainer(scene, RunSettings(method="voxels"))
    while trainer.step_count < 600:
        trainer.step()
    peer, ours, plain = PlainNerf(torch.tensor(scene.background)), [], []
    rays, truth = trainer.batches.draw(trainer.method.draw(0)._replace(rays=256, shrink=1))
    peer.train(rays, truth)
    for _ in range(rounds):
        before = trainer.step_count
        begin = time.perf_counter()
        count = sum(trainer.step().rays for _ in range(40))
        ours.append(count / (time.perf_counter() - begin))
        assert trainer.step_count == before + 40
        plain.append(256 / seconds(lambda: peer.train(rays, truth)))
    return {"ours": ours, "plain": plain, "ratio": [a / b for a, b in zip(ours, plain, strict=True)]}


def dips(folder: Path, steps: int = 2000) -> dict[str, list[float]]:
    """Measure how far held-out PSNR falls below its best so far, in dB, in the first steps of the voxel method.

    Looks at every step after a level begins or cells are dropped, 12 of them, and at every 50th, at up to 6 photos of
    each scene that is there. Returns the deepest fall, the step at which it was, the best PSNR and the last.
    """
    found = {}
    for name, downscale in DIPS.items():
        if not (folder / name).exists():
            continue
        trainer = Trainer(load_scene(folder / name, LoadOptions(downscale=downscale)), RunSettings(method="voxels"))
        views = trainer.scene.held_out()[1]
        views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, 6).round().astype(int))]
        assert isinstance(trainer.method, Voxels)
        since = 0
        deepest, at, best, last = 0.0, 0, 0.0, 0.0
        while trainer.step_count < steps:
            before = trainer.method.level, len(trainer.method.grid.rows)
            trainer.step()
            since = since + 1 if (trainer.method.level, len(trainer.method.grid.rows)) == before else 0
            if since >= 12 and trainer.step_count % 50:
                continue
            last = held_out_psnr(trainer, views)
            best = max(best, last)
            if best - last > deepest:
                deepest, at = best - last, trainer.step_count
        found[name] = [deepest, float(at), best, last]
    return found


def held_out_psnr(trainer: Trainer, views: Sequence[int] = ()) -> float:
    """The mean PSNR of the held-out photos, or of some `views`."""
    scene = trainer.scene
    return statistics.mean(
        psnr(render_camera(trainer.method, scene.views[i].camera, scene)[0], scene.images[i].astype(np.float32) / 65535)
        for i in views or scene.held_out()[1]
    )


def preview(scene: Scene, rounds: int) -> list[float]:
    """Milliseconds to draw 200 × 150 pixels on one thread."""
    torch.set_num_threads(1)
    trainer = Trainer(scene, RunSettings(method="voxels", threads=1))
    while trainer.step_count < 600:
        trainer.step()
    camera = scene.views[scene.held_out()[1][0]].camera.resized(200, 150)
    times = []
    for _ in range(rounds + 1):  # the first warms up
        begin = time.perf_counter()
        trainer.method.render(camera_rays(camera, scene.near, scene.far))
        times.append(1e3 * (time.perf_counter() - begin))
    return times[1:]


def growth(scene: Scene, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of a voxel step on copies of the scene with 10, 100 and 1,000 training photos."""
    found: dict[str, list[float]] = {}
    for count in (10, 100, 1000):
        some = [scene.split("train")[i % len(scene.split("train"))] for i in range(count)]
        views = tuple(scene.views[i] for i in some)
        many = replace(scene, views=views, photos=scene.photos.at(some), splits={"train": tuple(range(count))})
        trainer = Trainer(many, RunSettings(method="voxels"))
        while trainer.step_count < 400:
            trainer.step()
        found[str(count)] = [1e3 * statistics.mean(trainer.step().seconds for _ in range(20)) for _ in range(rounds)]
    return found


def frame(scene: Scene, rounds: int) -> list[float]:
    """Milliseconds to draw a photo of 800 × 800 pixels with the hash method, after 1,000 steps."""
    trainer = Trainer(scene, RunSettings(method="hash"))
    while trainer.step_count < 1000:
        trainer.step()
    camera = scene.views[scene.held_out()[1][0]].camera.resized(800, 800)
    rays, times = camera_rays(camera, scene.near, scene.far).to(trainer.device), []
    for _ in range(rounds + 1):
        begin = time.perf_counter()
        trainer.method.render(rays).color.cpu()
        times.append(1e3 * (time.perf_counter() - begin))
    return times[1:]


def official(scene: Scene, rounds: int) -> list[float]:
    """Training rays a second of the paper's official configuration."""
    trainer = Trainer(scene, RunSettings(method="nerf", preset="complete"))
    for _ in range(20):
        trainer.step()
    return [1 / statistics.mean(r.seconds / r.rays for r in (trainer.step() for _ in range(20))) for _ in range(rounds)]


def thousand(rounds: int) -> dict[str, list[float]]:
    """Measure 1,000 photos of 4 megapixels with the default memory limit for photos: seconds to open them,
    milliseconds of a voxel step, peak memory (GiB)."""
    from PIL import Image

    count, width, height = 1000, 2464, 1632
    scene = load_scene(None, LoadOptions())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for i in range(8):  # different photos; the others are hard links to these
            photo = Image.fromarray((scene.images[i] >> 8).astype(np.uint8)).resize((width, height))
            photo.save(folder / f"{i}.jpg", quality=92)
        frames = []
        for i in range(count):
            os.link(folder / f"{i % 8}.jpg", folder / f"photo{i:04}.jpg")
            pose = np.vstack([scene.views[i % 8].camera.c2w, [0, 0, 0, 1]])
            frames.append({"file_path": f"photo{i:04}.jpg", "transform_matrix": pose.tolist()})
        camera = scene.views[0].camera.resized(width, height)
        lens = {
            "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": width, "h": height,
        }  # fmt: skip
        (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
        begin = time.perf_counter()
        opened = load_scene(folder, LoadOptions())
        seconds = time.perf_counter() - begin
    print(*opened.notes, f"{len(opened.images)} of {opened.images[0].shape}", file=sys.stderr)
    trainer = Trainer(opened, RunSettings(method="voxels"))
    while trainer.step_count < 400:
        trainer.step()
    steps = [1e3 * statistics.mean(trainer.step().seconds for _ in range(20)) for _ in range(rounds)]
    return {"seconds_to_open": [seconds], "ms_a_step": steps, "peak_gib": [peak_gib()]}


def peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def determinism(scene: Scene, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of a voxel step if each shard has its own gradients, and if all shards add to one array."""
    from nerf_core.kernels import numba_voxels as loops
    from nerf_core.kernels.cpu_voxels import CpuVoxels

    class Racing(CpuVoxels):
        """Adds the gradients of all shards to one array. Where two shards add at once, an addition is lost."""

        def _fit(self, grid: VoxelGrid) -> None:
            new = self._grid is None or self._grid.rows is not grid.rows
            super()._fit(grid)
            if new:
                for name in ("_gradient", "_touched"):
                    setattr(
                        self,
                        name,
                        np.lib.stride_tricks.as_strided(one := getattr(self, name), strides=(0, one.itemsize)),
                    )

        def update(self, grid: VoxelGrid, moments: Tensor, ema: Tensor, adam: Adam) -> None:
            rows, slots, means = (v.numpy().ravel() for v in (grid.rows, moments, ema))
            numbers = [np.float32(v) for v in adam]

            def work(s: int) -> None:
                part = split(self._touched.shape[1], self.shards, s)
                loops.adam(*part, rows, slots, means, self._gradient[:1], self._touched[:1], *numbers)

            each_shard(self.shards, work)

    trainers = {}
    for name in ("private", "racing"):
        trainers[name] = trainer = Trainer(scene, RunSettings(method="voxels"))
        assert isinstance(trainer.method, Voxels)
        if name == "racing":
            trainer.method.kernels = Racing(torch.get_num_threads())
        while trainer.step_count < 600:
            trainer.step()
    times: dict[str, list[float]] = {name: [] for name in trainers}
    for _ in range(rounds):
        for name, trainer in trainers.items():
            times[name].append(1e3 * statistics.mean(trainer.step().seconds for _ in range(40)))
    return times


def compile_seconds() -> dict[str, float]:
    """Seconds to compile the loops with an empty cache, and to load them from a full one."""
    code = (
        "import time, nerf_core, torch; from nerf_core.kernels.choice import packed_kernels, voxel_kernels\n"
        "cpu = torch.device('cpu'); begin = time.perf_counter(); voxel_kernels(cpu); middle = time.perf_counter()\n"
        "packed_kernels(cpu); print(middle - begin, time.perf_counter() - middle)"
    )
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        times = [
            [
                float(v)
                for v in subprocess.check_output([sys.executable, "-c", code], env=environment, text=True).split()
            ]
            for _ in range(2)
        ]
    names = (("voxels_cold", "hash_cold"), ("voxels_warm", "hash_warm"))
    return {
        name: float(value)
        for pair, row in zip(names, times, strict=True)
        for name, value in zip(pair, row, strict=True)
    }
