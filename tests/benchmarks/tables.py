"""Measure the figures of docs/figures.md: how fast each method learns, how long a step, a picture and a frame take.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/tables.py --scenes DIR [--rows lego100-voxels …]

Each run is a process of its own, so that it has its own peak memory. What numba compiles is there before the clock
starts; the time to compile is measured apart. PSNR is measured on held-out photos, and seconds are those of training
alone. Rays per second are measured in turns with the plain float32 step of the paper's model, in one process. A machine
with CUDA has other rows. Writes tables.json and tables.png to --out, and prints medians with the least and the largest.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
import torch
from torch import Tensor

from nerf_core.common.device import describe, pick_device, usable_cores
from nerf_core.common.jit.shards import each_shard, split
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.voxel_kernels import Adam
from nerf_core.methods.guided.method import GuidedNerf
from nerf_core.methods.voxels.method import Voxels
from nerf_core.rendering.images import render_camera
from nerf_core.training.metrics import psnr
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.voxel_grid import VoxelGrid


@dataclass(frozen=True)
class Row:
    """One line of the table: PSNR after `seconds`, and when it passed `levels` (dB). marks: evaluations at most."""

    scene: str
    downscale: int
    method: str
    seconds: float
    levels: tuple[float, ...] = ()
    marks: int = 24
    changes: tuple[tuple[str, str], ...] = ()


ROWS = {
    "lego100-voxels": Row("lego", 8, "voxels", 20, (30, 33)),
    "lego200-voxels": Row("lego", 4, "voxels", 60, (30, 32)),
    "lego800-voxels": Row("lego", 1, "voxels", 600, (30, 31), marks=6),
    "fern-voxels": Row("fern", 8, "voxels", 120, (22,), marks=10),
    "fox-voxels": Row("fox", 4, "voxels", 120, (22,), marks=8),
    "lego100-hash": Row("lego", 8, "hash", 30, (25, 30)),
    "lego100-guided": Row("lego", 8, "nerf-guided", 120, marks=10),
    "lego100-nerf": Row("lego", 8, "nerf", 300, (20,), marks=6),
}
CUDA_ROWS = {
    "lego800-hash": Row("lego", 1, "hash", 120, (30, 33, 35)),
    "lego100-hash": Row("lego", 8, "hash", 30, (25, 30)),
    "lego100-guided": Row("lego", 8, "nerf-guided", 120, marks=10),
}
HERE = Path(__file__).parent
SCRIPTS = {  # what they print becomes a row unchanged
    "training": ("training.py",),
    "demo-truth": ("demo_truth.py",),
    "startup": ("startup.py",),
    "window": ("window.py",),
    "window-nerf": ("window.py", "--method", "nerf"),
}
CPU_MEASURES = ("compile", "rates", "preview", "growth", "determinism", "thousand")
CUDA_MEASURES = ("frame", "official")
UNITS = {"official": "rays/s"}


def held_out_psnr(trainer: Trainer) -> float:
    scene = trainer.scene
    return statistics.mean(
        psnr(render_camera(trainer.method, scene.views[i].camera, scene)[0], scene.images[i].astype(np.float32) / 65535)
        for i in scene.held_out()[1]
    )


def learn(scene: Scene, row: Row, seed: int) -> dict[str, Any]:
    """Train a model, and return its PSNR over seconds of training. Time to evaluate is not counted."""
    trainer = Trainer(scene, RunSettings(method=row.method, seed=seed, changes=dict(row.changes)))
    marks = list(np.geomspace(min(1.0, row.seconds / 20), row.seconds, row.marks))
    curve = []
    while marks:
        trainer.step()
        if trainer.seconds >= marks[0]:
            while marks and trainer.seconds >= marks[0]:
                marks.pop(0)
            curve.append((trainer.seconds, held_out_psnr(trainer)))
    found = {"curve": curve, "steps": trainer.step_count, "peak_gib": peak_gib()}
    if isinstance(trainer.method, GuidedNerf):
        found["samples_a_ray"] = trainer.method.samples_per_ray
    return found


def passed(curve: list[tuple[float, float]], level: float) -> float | None:
    """Return when the curve first passes `level` in seconds, linearly interpolated, or None if it never does."""
    before = (0.0, 0.0)
    for t, value in curve:
        if value >= level:
            share = (level - before[1]) / (value - before[1])
            return before[0] + share * (t - before[0])
        before = (t, value)
    return None


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
                part = split(grid.bricks, self.shards, s)
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


def one(args: argparse.Namespace) -> dict[str, Any]:
    """Measure what this child process was started for."""
    if args.child == "compile":
        return compile_seconds()
    if args.child == "thousand":
        return {"value": thousand(args.repeat)}
    if args.child in rows_here():
        row = rows_here()[args.child]
        scene = load_scene(args.scenes / row.scene, LoadOptions(downscale=row.downscale))
        return learn(scene, row, args.seed)
    measures: dict[str, Callable[[Scene, int], Any]] = {
        "rates": rates, "preview": preview, "growth": growth, "determinism": determinism, "frame": frame,
        "official": official,
    }  # fmt: skip
    scene = load_scene(args.scenes / "lego", LoadOptions(downscale=1 if args.child in CUDA_MEASURES else 8))
    return {"value": measures[args.child](scene, args.repeat)}


def rows_here() -> dict[str, Row]:
    return CUDA_ROWS if torch.cuda.is_available() else ROWS


def child(args: argparse.Namespace, name: str, seed: int = 0) -> dict[str, Any]:
    command = [sys.executable, __file__, "--scenes", str(args.scenes), "--repeat", str(args.repeat)]
    done = subprocess.run([*command, "--child", name, "--seed", str(seed)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def spread(values: list[float], digits: int = 1) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f} (one run)"
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} – {max(values):.{digits}f})"


def processor() -> str:
    """Return the processor's name, which the standard library does not know on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def report(name: str, row: Row, runs: list[dict[str, Any]]) -> None:
    parts = [f"{spread([run['curve'][-1][1] for run in runs], 2)} dB after {row.seconds:.0f} s"]
    for level in row.levels:
        times = [passed(run["curve"], level) for run in runs]
        reached = [t for t in times if t is not None]
        missed = f", {len(times) - len(reached)} never" if len(reached) < len(times) else ""
        parts.append(f"{level:.0f} dB: {spread(reached) if reached else '–'} s{missed}")
    if "samples_a_ray" in runs[0]:
        parts.append(f"{spread([run['samples_a_ray'] for run in runs])} samples a ray in the end")
    print(f"{name}: {'; '.join(parts)}; peak {max(run['peak_gib'] for run in runs):.1f} GiB", flush=True)


def plot(results: dict[str, list[dict[str, Any]]], machine: str, file: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5), dpi=120)
    for i, (name, runs) in enumerate(results.items()):
        for k, run in enumerate(runs):
            t, value = zip(*run["curve"], strict=True)
            axes.plot(t, value, color=f"C{i}", alpha=1 if k == 0 else 0.35, label=name if k == 0 else None)
    axes.set(xscale="log", xlabel="seconds of training", ylabel="PSNR on held-out photos, dB", title=machine)
    marks = [1, 3, 10, 30, 100, 300, 600]
    axes.set_xticks(marks, [str(mark) for mark in marks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(file)


def main() -> None:
    rows, measures = rows_here(), CUDA_MEASURES if torch.cuda.is_available() else CPU_MEASURES
    names = [*measures, *rows, *SCRIPTS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="folder with lego, fern and fox")
    parser.add_argument("--out", type=Path, default=Path("runs/tables"))
    parser.add_argument("--rows", nargs="*", default=names, metavar="ROW", help=f"some of {', '.join(names)}")
    parser.add_argument("--repeat", type=int, default=5, help="runs of each row (one run if it is over 100 s)")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(one(args)))
        return
    if unknown := set(args.rows) - set(names):
        parser.error(f"--rows {' '.join(sorted(unknown))}: choose from {', '.join(names)}")
    args.out.mkdir(parents=True, exist_ok=True)
    machine = f"{processor()}, {usable_cores()} cores, {describe(pick_device('auto'))}"
    print(f"{machine}, torch {torch.__version__}")
    results: dict[str, Any] = {"machine": machine}
    for name in args.rows:
        if name in rows:
            count = args.repeat if rows[name].seconds <= 100 else 1
            results[name] = [child(args, name, seed) for seed in range(count)]
            report(name, rows[name], results[name])
        elif name in SCRIPTS:
            script, *words = SCRIPTS[name]
            done = subprocess.run([sys.executable, HERE / script, *words], capture_output=True, text=True, check=False)
            results[name] = done.stdout.splitlines() if done.returncode == 0 else [f"failed: {done.stderr[-400:]}"]
            print(f"{name}:", *results[name], sep="\n  ", flush=True)
        else:
            results[name] = child(args, name)
            figures = results[name].get("value", results[name])
            lists = figures if isinstance(figures, dict) else {UNITS.get(name, "ms"): figures}
            text = {k: spread(v) if isinstance(v, list) else f"{v:.1f}" for k, v in lists.items()}
            print(f"{name}: " + "; ".join(f"{k} {v}" for k, v in text.items()), flush=True)
        (args.out / "tables.json").write_text(json.dumps(results, indent=1))
    curves = {name: results[name] for name in args.rows if name in rows}
    if curves:
        plot(curves, machine, args.out / "tables.png")


if __name__ == "__main__":
    main()
