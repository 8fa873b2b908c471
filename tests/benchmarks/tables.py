"""Measure the figures of docs/figures.md: how fast each method learns, how long a step, a picture and a frame take.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/tables.py --scenes DIR [--rows lego100-voxels …]

Each run is a process of its own, so that it has its own peak memory. What numba compiles is there before the clock
starts; the time to compile is measured apart. PSNR is measured on held-out photos, and seconds are those of training
alone. Rays per second are measured in turns with the plain float32 step of the paper's model, in one process. A machine
with CUDA has other rows. Writes tables.json and tables.png to --out, and prints medians with the least and the largest.

With --protocol published, a row is measured as papers report a scene: three seeds, all test views that the folder has,
PSNR, SSIM and LPIPS, and the time from the start of the process besides that of training. It says how many views there
were. --seconds replaces the seconds of the rows.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
import torch
from machine import processor
from measures import (
    compile_seconds,
    determinism,
    dips,
    frame,
    growth,
    held_out_psnr,
    official,
    peak_gib,
    preview,
    rates,
    thousand,
)  # fmt: skip
from published import METRICS, learn_and_evaluate

from nerf_core.common.device import describe, pick_device, usable_cores
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.methods.guided.method import GuidedNerf
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


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
    "lego800-voxels": Row("lego", 1, "voxels", 600, (30, 33), marks=6),
    "fern-voxels": Row("fern", 8, "voxels", 120, (22,), marks=10),
    "fox-voxels": Row("fox", 4, "voxels", 120, (22,), marks=8),
    "lego100-hash": Row("lego", 8, "hash", 30, (25, 30)),
    "lego100-guided": Row("lego", 8, "nerf-guided", 120, marks=10),
    "lego100-nerf": Row("lego", 8, "nerf", 300, (20,), marks=6),
}
CUDA_ROWS = {
    "lego800-hash": Row("lego", 1, "hash", 120, (30, 33, 35), marks=9),
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
CPU_MEASURES = ("compile", "dips", "rates", "preview", "growth", "determinism", "thousand")
CUDA_MEASURES = ("frame", "official")
UNITS = {"official": "rays/s"}


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


def one(args: argparse.Namespace) -> dict[str, Any]:
    """Measure what this child process was started for."""
    if args.child == "compile":
        return compile_seconds()
    if args.child == "dips":
        return {"value": dips(args.scenes)}
    if args.child == "thousand":
        return {"value": thousand(args.repeat)}
    if args.child in rows_here():
        row = rows_here()[args.child]
        row = replace(row, seconds=args.seconds or row.seconds)
        scene = load_scene(args.scenes / row.scene, LoadOptions(downscale=row.downscale))
        if args.protocol == "published":
            settings = RunSettings(method=row.method, seed=args.seed, changes=dict(row.changes))
            return learn_and_evaluate(Trainer(scene, settings), row.seconds, args.started, args.lpips_weights)
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
    command += ["--protocol", args.protocol, "--started", str(time.time())]
    command += ["--seconds", str(args.seconds)] if args.seconds else []
    command += ["--lpips-weights", str(args.lpips_weights)] if args.lpips_weights else []
    done = subprocess.run([*command, "--child", name, "--seed", str(seed)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def spread(values: list[float], digits: int = 1) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f} (one run)"
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} – {max(values):.{digits}f})"


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


def report_published(name: str, runs: list[dict[str, Any]]) -> None:
    values = {metric: [run[metric] for run in runs if run[metric] is not None] for metric in METRICS}
    parts = [
        f"{metric.upper()} {spread(found, METRICS[metric]) if found else 'not computed (needs --lpips-weights)'}"
        for metric, found in values.items()
    ]
    for key, words in (
        ("seconds", "s of training"),
        ("wall", "s from the start of the process to the end of training"),
    ):
        parts.append(f"{spread([run[key] for run in runs])} {words}")
    print(f"{name}, {len(runs)} seeds, {runs[0]['protocol']}: {'; '.join(parts)}", flush=True)


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


def parse(rows: dict[str, Row], names: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="folder with lego, fern and fox")
    parser.add_argument("--out", type=Path, default=Path("runs/tables"))
    parser.add_argument("--rows", nargs="*", metavar="ROW", help=f"some of {', '.join(names)}")
    parser.add_argument("--protocol", choices=("figures", "published"), default="figures")
    parser.add_argument("--seconds", type=float, help="of training, instead of those of the rows")
    parser.add_argument("--repeat", type=int, help="runs of each row (figures: 5, one if over 100 s; published: 3)")
    parser.add_argument("--lpips-weights", type=Path, help="as in nerf-core eval")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--started", type=float, default=time.time(), help=argparse.SUPPRESS)
    args = parser.parse_args()
    published = args.protocol == "published"
    if args.rows is None:
        full_size = [name for name, row in rows.items() if row.scene == "lego" and row.downscale == 1]
        args.rows = full_size if published else names
    known = list(rows) if published else names
    if unknown := set(args.rows) - set(known):
        parser.error(f"--rows {' '.join(sorted(unknown))}: choose from {', '.join(known)}")
    if args.seconds is not None and not args.seconds > 0:
        parser.error(f"--seconds {args.seconds}: give a number above 0")
    args.repeat = args.repeat or (3 if published else 5)
    return args


def main() -> None:
    rows, measures = rows_here(), CUDA_MEASURES if torch.cuda.is_available() else CPU_MEASURES
    args = parse(rows, [*measures, *rows, *SCRIPTS])
    if args.child:
        print(json.dumps(one(args)))
        return
    args.out.mkdir(parents=True, exist_ok=True)
    machine = f"{processor()}, {usable_cores()} cores, {describe(pick_device('auto'))}"
    print(f"{machine}, torch {torch.__version__}")
    results: dict[str, Any] = {"machine": machine}
    for name in args.rows:
        if name in rows:
            row = replace(rows[name], seconds=args.seconds or rows[name].seconds)
            if args.protocol == "published":
                results[name] = [child(args, name, seed) for seed in range(args.repeat)]
                report_published(name, results[name])
            else:
                count = args.repeat if row.seconds <= 100 else 1
                results[name] = [child(args, name, seed) for seed in range(count)]
                report(name, row, results[name])
        elif name in SCRIPTS:
            script, *words = SCRIPTS[name]
            done = subprocess.run([sys.executable, HERE / script, *words], capture_output=True, text=True, check=False)
            results[name] = done.stdout.splitlines() if done.returncode == 0 else [f"failed: {done.stderr[-400:]}"]
            print(f"{name}:", *results[name], sep="\n  ", flush=True)
        else:
            results[name] = child(args, name)
            (args.out / "tables.json").write_text(json.dumps(results, indent=1))
            figures = results[name].get("value", results[name])
            if name == "dips":
                for scene, (deepest, at, best, last) in figures.items():
                    print(f"dips: {scene}: {deepest:.2f} dB at step {at:.0f}; best {best:.2f}, last {last:.2f} dB")
                continue
            lists = figures if isinstance(figures, dict) else {UNITS.get(name, "ms"): figures}
            text = {k: spread(v) if isinstance(v, list) else f"{v:.1f}" for k, v in lists.items()}
            print(f"{name}: " + "; ".join(f"{k} {v}" for k, v in text.items()), flush=True)
        (args.out / "tables.json").write_text(json.dumps(results, indent=1))
    curves = {name: results[name] for name in args.rows if name in rows and args.protocol == "figures"}
    if curves:
        plot(curves, machine, args.out / "tables.png")


if __name__ == "__main__":
    main()
