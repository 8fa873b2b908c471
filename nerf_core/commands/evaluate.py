"""`nerf-core eval`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import MOVED_HELP, restored, tell
from nerf_core.common.console import Display
from nerf_core.common.files import write_atomically
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.common.text import counted
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.metrics import Lpips
from nerf_core.training.run_folder import RunFolder

MOST_ROWS = 12  # of the tables of exposures and of poses


@COMMANDS.register("eval")
@dataclass(frozen=True)
class Eval:
    """Compare a trained run with held-out photos: writes metrics.json, and photo | rendering | error in eval/."""

    order: ClassVar[int] = 1

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help="A run folder.")]
    split: Literal["test", "val", "train"] | None = None
    """By default test, else val, else every 8th photo."""
    views: int | None = None
    """Only so many of them, evenly spread; metrics.json then says that it is a subset."""
    lpips_weights: Path | None = None
    """VGG16 and LPIPS heads in one .safetensors file; without it LPIPS is not computed."""
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    def run(self, signals: Signals) -> int:
        run = RunFolder(self.run_folder)
        trainer = restored(run, self.data, self.device)
        selection = select(trainer.scene, self.split, self.views)
        lpips = None if self.lpips_weights is None else Lpips(self.lpips_weights, trainer.device)
        count = len(selection.views)
        signals.be_polite()
        with Display("evaluating") as display:

            def progress(done: int, fraction: float) -> None:
                signals.check()
                display.show(fraction, f"{done} of {count} images")

            metrics = evaluate(trainer, selection, lpips=lpips, pictures=run.path / "eval", progress=progress)
        file = run.path / "metrics.json"
        write_atomically(file, json.dumps(metrics, indent=2, allow_nan=False) + "\n")
        _print_metrics(metrics, count)
        _print_exposures(metrics.get("exposure", []))
        if trainer.corrections is not None:
            _print_poses(metrics["poses"], trainer.corrections.summary())
        tell([trainer.method.stage] if trainer.method.stage else [])
        say(f"wrote {file} and {run.path / 'eval'}")
        return 0


def _print_metrics(metrics: dict[str, Any], count: int) -> None:
    mean = metrics["mean"]
    lpips = "not computed (needs --lpips-weights)" if mean["lpips"] is None else f"{mean['lpips']:.4f}"
    of = counted(count, f"{metrics['split']} image") + (f" ({metrics['subset']})" if "subset" in metrics else "")
    say(f"{of} at step {metrics['step']:,}: PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.4f}, LPIPS {lpips}")
    if mean.get("psnr_matched") is not None:
        right = f"{mean['psnr_matched']:.2f} dB"
        say(f"exposure of each photo fitted to its left half, measured on its right half: PSNR {right}")
    if mean.get("psnr_posed") is not None and metrics["split"] == "train":
        say(f"corrected pose of each photo, measured on its right half: PSNR {mean['psnr_posed']:.2f} dB")
    elif mean.get("psnr_posed") is not None:
        say(f"pose of each photo fitted to its left half, measured on its right half: PSNR {mean['psnr_posed']:.2f} dB")


def _print_poses(poses: list[dict[str, Any]], summary: str) -> None:
    """Print how far the cameras of training photos moved; of many, only those that moved farthest."""
    say(f"poses of training photos: {summary}")
    rows = sorted((row for row in poses if row["degrees"] or row["percent"]), key=lambda row: -row["degrees"])
    if not rows:
        return
    say("cameras that moved, the largest turn first (metrics.json has all):")
    say("    turned   shifted (of the radius)   photo")
    for row in rows[:MOST_ROWS]:
        say(f"  {row['degrees']:7.3f}°   {row['percent']:7.3f} %                 {row['name']}")


def _print_exposures(exposures: list[dict[str, Any]]) -> None:
    """Print the gains and offsets of the training photos, of many only the darkest and the brightest."""
    if not exposures:
        return
    rows = sorted(exposures, key=lambda row: sum(row["gain"]))
    shown = rows if len(rows) <= MOST_ROWS else [*rows[: MOST_ROWS // 2], None, *rows[-MOST_ROWS // 2 :]]
    say(f"exposure of {counted(len(rows), 'training photo')}, from dark to bright (metrics.json has all):")
    say("      gain                     offset                  photo")
    for row in shown:
        if row is None:
            say("         …")
            continue
        numbers = "  ".join(f"{v:7.3f}" for v in row["gain"]), "  ".join(f"{v:+7.3f}" for v in row["offset"])
        say("  ".join([*numbers, row["name"]]))
