"""The `nerf-core` command: train, eval, render, probe."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nerf_core.common.command_line import parse
from nerf_core.common.console import Display, duration
from nerf_core.common.device import describe, pick_device
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import write_atomically
from nerf_core.common.signals import Interrupted, Signals
from nerf_core.datasets import load_scene
from nerf_core.geometry.camera_files import picked_camera
from nerf_core.geometry.paths import PATHS
from nerf_core.kernels import choice as kernels
from nerf_core.live.messages import ExportPath
from nerf_core.rendering.export.film import FilmJob
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.loop import Progress, train_run
from nerf_core.training.metrics import Lpips
from nerf_core.training.options import TrainOptions, run_name
from nerf_core.training.run_folder import RunFolder, must_agree
from nerf_core.training.trainer import Diverged, Trainer, choose_method

DATA_HELP = "Folder of the capture (or its .json file); none: the demo scene."
MOVED_HELP = "Where the capture is now, if it moved."


@dataclass(frozen=True)
class Train:
    """Train a scene into a run folder. Ctrl-C or SIGTERM saves and ends; --resume then continues."""

    training: TrainOptions
    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="DATA", help=DATA_HELP)] = None
    out: Path | None = None
    """The run folder; by default runs/SCENE-METHOD."""
    resume: bool = False
    """Continue the run in --out with its own data, options and schedule; --steps and --seconds still say when it
    ends, counted from its beginning."""
    save_every: float = 60.0
    """Seconds of training between checkpoints; the newest two are kept."""

    def run(self, signals: Signals) -> int:
        settings = self.training.settings()
        if not self.save_every > 0:
            raise UserError(f"--save-every {self.save_every}: give a number above 0")
        method, _ = choose_method(settings.method, pick_device(settings.device))
        run = RunFolder(self.out or Path("runs") / run_name(self.data, method))
        if self.resume:
            must_agree(settings, run)
        began = time.monotonic()
        with run.claimed():
            if self.resume:
                trainer = _restored(run, self.data, settings.device)
                run.rewind(trainer.step_count)
                print(f"continuing {run.path} at step {trainer.step_count:,}")
            else:
                run.must_be_new()
                with _loading() as progress:
                    scene = load_scene(self.data, settings.load, progress)
                _tell(scene.notes)
                trainer = Trainer(scene, settings)
                _tell([note for note in (kernels.note(trainer.device),) if note])
                run.begin(self.data, settings, trainer)
            return self._train(run, trainer, signals, time.monotonic() - began)

    def _train(self, run: RunFolder, trainer: Trainer, signals: Signals, loading: float) -> int:
        goal = self.training.goal(trainer.total_steps)
        if goal.reached(trainer):
            print(f"nothing to do: {_summary(trainer)}; --steps and --seconds count from the beginning of the run")
            return 0
        signals.be_polite()
        views = len(trainer.scene.split("train"))
        print(
            f"training {trainer.method_name}{f' ({trainer.reason})' if trainer.reason else ''} on {trainer.scene.name} "
            f"({views} photos), {describe(trainer.device)}",
            flush=True,
        )
        with Display("training") as display:

            def show(p: Progress) -> None:
                text = f"step {p.step:,}, {p.rays_per_second:,.0f} rays/s, {p.psnr:.2f} dB"
                text += f"; {trainer.method.stage}" if trainer.method.stage else ""
                display.show(p.fraction, text, p.seconds_left)

            finished = train_run(
                run, trainer, goal, save_every=self.save_every, show=show, warn=_warn,
                stop=lambda: signals.received is not None,
            )  # fmt: skip
        ending = "finished" if finished else "stopped"
        print(f"{ending}: {_summary(trainer)}; loading took {duration(loading)}; saved {run.checkpoints()[-1]}")
        return 0 if finished else 128 + (signals.received or 0)


@dataclass(frozen=True)
class Eval:
    """Compare a trained run with held-out photos: writes metrics.json and eval/ (rendering | photo)."""

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
        trainer = _restored(run, self.data, self.device)
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
        _tell([trainer.method.stage] if trainer.method.stage else [])
        print(f"wrote {file} and {run.path / 'eval'}")
        return 0


@dataclass(frozen=True)
class Render:
    """Render a camera path of a trained run to an MP4."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help="A run folder.")]
    out: Path
    """The .mp4 file."""
    path: Literal["orbit", "spiral", "test"] = "orbit"
    """Around the scene, a spiral before it, or through the held-out views."""
    frames: int | None = None
    """Number of frames; by default 60 (orbit), 120 (spiral), all (test)."""
    fps: float = 30.0
    """Frames a second."""
    width: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    height: int | None = None
    """Of the video in pixels; by default that of the training photos."""
    elevation: float | None = None
    """Of an orbit, degrees above the horizon; by default 25."""
    radius: float | None = None
    """Of an orbit, in scene units; by default the cameras' own distance."""
    png_frames: bool = False
    """Also write every frame as a PNG, beside the video."""
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    def run(self, signals: Signals) -> int:
        for name, most in (("frames", 100_000), ("width", 16_384), ("height", 16_384)):
            if not 1 <= (getattr(self, name) or 1) <= most:
                raise UserError(f"--{name} {shorten(getattr(self, name))}: give a whole number from 1 to {most:,}")
        if self.out.suffix.lower() != ".mp4":
            raise UserError(f"--out {self.out}: only MP4 is written: name a .mp4 file")
        around = {"elevation_degrees": self.elevation, "radius": self.radius}
        chosen: dict[str, Any] = {name: value for name, value in around.items() if value is not None}
        if chosen and self.path != "orbit":
            raise UserError(f"--elevation and --radius belong to --path orbit, not to {self.path}: leave them out")
        trainer = _restored(RunFolder(self.run_folder), self.data, self.device)
        cameras = PATHS[self.path](trainer.scene, self.frames, self.width, self.height, **chosen)
        signals.be_polite()
        job = FilmJob(trainer.method, trainer.scene, ExportPath(cameras, self.fps, self.out, self.png_frames))
        try:
            with Display("rendering") as display:
                while job.advance():
                    signals.check()
                    p = job.progress
                    display.show(p.done / p.total, f"{len(cameras)} frames", p.seconds_left)
        finally:
            job.abort()  # of a finished video: does nothing
        print(f"wrote {self.out}: {len(cameras)} frames")
        return 0


@contextmanager
def _loading() -> Iterator[Callable[[int, int], None]]:
    with Display("loading") as display:
        yield lambda done, total: display.show(done / total, f"{done} of {total} photos")


def _restored(run: RunFolder, data: Path | None, device: str) -> Trainer:
    with _loading() as progress:
        trainer, notes = run.restore(data, device, progress)
    _tell(notes)
    return trainer


def _tell(notes: Sequence[str]) -> None:
    for note in notes:
        print(f"note: {note}")


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr, flush=True)


def _summary(trainer: Trainer) -> str:
    text = f"step {trainer.step_count:,} after {duration(trainer.seconds)} of training"
    return f"{text} ({trainer.method.stage})" if trainer.method.stage else text


def _print_metrics(metrics: dict[str, Any], count: int) -> None:
    mean = metrics["mean"]
    lpips = "not computed (needs --lpips-weights)" if mean["lpips"] is None else f"{mean['lpips']:.4f}"
    of = f"{count} {metrics['split']} images" + (f" ({metrics['subset']})" if "subset" in metrics else "")
    print(f"{of} at step {metrics['step']:,}: PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.4f}, LPIPS {lpips}")


@dataclass(frozen=True)
class Probe:
    """Open a pixel of a run: where its colour comes from, what is wrong with it, what the photos know of it."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run folder that `nerf-core train` wrote."""
    camera: str
    """A photo of the capture by its name (test/r_3.png) or its end, or a .json file with a camera, as an opened ray's
    has."""
    pixel: tuple[int, int]
    """Column and row, counted from the top left, in the camera's picture."""
    write: list[Path] = field(default_factory=list)
    """A file to write: .json or .npz with everything, .csv with the samples, .png or .svg with a figure. Repeatable."""
    t: float | None = None
    """Where on the ray its radiance is looked at; by default on the surface."""
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """cpu, cuda, or auto."""

    def run(self, signals: Signals) -> int:
        from nerf_core.probe import open_pixel, write_inspection
        from nerf_core.probe.report import check_format

        for file in self.write:
            check_format(file)
        with _loading() as progress:
            trainer, notes = RunFolder(self.run_folder).restore(self.data, self.device, progress)
        _tell(notes)
        camera = picked_camera(trainer.scene, self.camera)
        try:
            opened = open_pixel(trainer.method, trainer.scene, camera, self.pixel, trainer.step_count, self.t)
        except UserError as error:  # it begins with the name of what is wrong: pixel, t
            raise UserError(f"--{error}") from None
        ray, verdict = opened.ray, opened.verdict
        assert verdict is not None
        print(f"{verdict.kind}: {'; '.join(verdict.reasons)}")
        depth = "none" if ray.depth_median is None else f"{ray.depth_median:.4g}"
        color = ", ".join(f"{v:.3f}" for v in ray.color)
        print(f"colour {color}; opacity {ray.opacity:.3f}; median depth {depth}; step {ray.step:,}")
        for file in self.write:
            write_inspection([opened], file)
            print(f"wrote {file}")
        return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit status: 0; 1 when training diverged; 2 for what the user can mend; 130 and 143 after signals."""
    commands = (
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Eval, tyro.conf.subcommand("eval")]
        | Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Probe, tyro.conf.subcommand("probe")]
    )
    with Signals() as signals:
        try:
            return parse(commands, "nerf-core", arguments).run(signals)
        except Diverged as error:
            status, text = 1, str(error)
        except UserError as error:
            status, text = 2, str(error)
        except Interrupted as error:
            status, text = error.status, f"interrupted ({error})"
    print(f"nerf-core: {text}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
