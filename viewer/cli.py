"""The `nerf-viewer` command."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import tyro

from nerf_core.common.command_line import parse
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import languages, use_language
from nerf_core.common.output import complain, forgiving_output, say, unprinted
from nerf_core.common.signals import Interrupted, Signals
from nerf_core.training.options import TrainOptions
from nerf_core.training.settings import RunSettings

WORKER_THREAD = "nerf-worker"  # as in `nerf_core.live.worker`, whose import would delay --help by a second


def _modes(default: str) -> str:
    """The hint after the help of --mode. The modes are imported when it is made, so that only --help waits for them."""
    from nerf_core.rendering.modes import mode_names

    return f"(default: {default}; one of {', '.join(mode_names())})"


def _languages(_: str) -> str:
    """The hint after the help of --language."""
    return f"(default: the one chosen last in the View menu, else en; one of {', '.join(languages())})"


@dataclass(frozen=True)
class ViewerOptions:
    """Watch a neural radiance field learn, fly through it, and open any pixel.

    If any file is asked for, the window writes it and closes. With --headless, or without a display, the same happens
    offscreen. The exit status is 0 only if everything was written.
    --version prints the version.
    """

    train: TrainOptions
    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DATA]")] = None
    """Folder of photos with or without poses, a video, or a transforms.json; without it the demo scene, or an offer to
    continue."""
    headless: bool = False
    """Draw offscreen (EGL): the same loop, panels and messages without a window."""
    size: str = "1440x900"
    """Size of the window in pixels."""
    scale: float | None = None
    """Size of text and panels offscreen, 1 by default; a window takes its screen's."""
    click: list[tuple[str, str]] = field(default_factory=list)
    """Click into the viewport at X Y after training: in pixels, or with a decimal point in fractions. Repeatable."""
    pin: list[tuple[str, str]] = field(default_factory=list)
    """Pin the ray at X Y of the viewport before training: its history is kept from the first step on. Repeatable,
    up to eight times."""
    camera: str = ""
    """Look from where this photo was taken (its name, as test/r_3.png, or its end), or from the camera in a .json file,
    as an opened ray's has."""
    mode: Annotated[str, tyro.conf.arg(metavar="NAME", help_behavior_hint=_modes)] = "colour"
    """What the picture shows of each pixel."""
    screenshot: Path | None = None
    """Write the whole interface as a PNG."""
    render: Path | None = None
    """Write the viewport's picture alone at full resolution, in its --mode: .png, or .npy (float32 before rounding)."""
    inspect: list[Path] = field(default_factory=list)
    """Write all arrays of the clicked ray, its point's radiance, its verdict and the photos' evidence: .json, .npz;
    its samples: .csv; a figure: .png, .svg. Repeatable."""
    axis: Literal["auto", "t", "contracted"] = "auto"
    """A ray is shown over world distance t, or, in a scene without bounds, over contracted distance."""
    orbit: Path | None = None
    """Write an orbit video (MP4)."""
    load: Path | None = None
    """Start from this checkpoint."""
    save: Path | None = None
    """Write a checkpoint when training is done or interrupted."""
    language: Annotated[str, tyro.conf.arg(metavar="CODE", help_behavior_hint=_languages)] = ""
    """The language of the window."""
    tour: Annotated[str | None, tyro.conf.arg(metavar="[FOLDER]")] = None
    """Begin the tour "How a NeRF works", or one of your own: a folder of Markdown files (docs/tours.md)."""
    presenter: bool = False
    """Large type and strong contrast, for a lecture hall (F5)."""
    doctor: bool = False
    """Print what was found (Python, torch, device, GL, display, video) and what to do about what is missing."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    0: success. 1: the doctor found something missing, or the connection to the screen was lost. 2: an error that the
    user can mend, or the doctor's report could not be written. 129, 130, 143: after a signal.
    """
    with forgiving_output() as output, Signals() as signals:
        try:
            status = run(parse(ViewerOptions, "nerf-viewer", _with_tour(arguments)), signals)
            text = unprinted(output)
            if not text:
                return status
            status = status if signals.polite else 2
        except UserError as error:
            status, text = 2, str(error)
        except Interrupted as error:
            status, text = error.status, f"interrupted ({error})"
        complain(f"nerf-viewer: {text}")
        return status


def _with_tour(arguments: Sequence[str] | None) -> list[str]:
    """The arguments, with an empty folder after a `--tour` that has none: it is the program's own tour."""
    found = list(sys.argv[1:] if arguments is None else arguments)
    for k, argument in enumerate(found):
        if argument == "--tour" and (k + 1 == len(found) or found[k + 1].startswith("-")):
            found.insert(k + 1, "")
            break
    return found


def _folder(text: str) -> Path | None:
    """The folder of a tour, whose steps are read once, so that an error is told before a window opens."""
    if not text:
        return None
    from .tour.steps import read_tour

    read_tour(folder := Path(text))
    return folder


def run(options: ViewerOptions, signals: Signals) -> int:
    """Do what the options say. Returns the exit status; raises UserError."""
    if options.doctor:
        from .session.doctor import examine

        return 0 if examine(say) else 1
    from .window import DisplayError, load_libraries, open_offscreen, open_window

    load_libraries()  # before anything imports imgui, so that missing system packages are named
    from .model.state import TourWish
    from .session import session as sessions

    if options.language:
        use_language(options.language)  # or it is refused
    size, settings = sessions.parse_size(options.size), options.train.settings()
    scale = 1.0 if options.scale is None else options.scale
    if not 0.5 <= scale <= 4:
        raise UserError(f"--scale {scale:g}: give a number from 0.5 to 4")
    wishes = sessions.Wishes(
        load=options.load, steps=options.train.steps, seconds=options.train.seconds, save=options.save,
        camera=options.camera, mode=options.mode, pins=tuple(options.pin), clicks=tuple(options.click),
        inspect=tuple(options.inspect), axis=options.axis, render=options.render, orbit=options.orbit,
        screenshot=options.screenshot, tour=None if options.tour is None else TourWish("begin", _folder(options.tour)),
    )  # fmt: skip
    wishes.check()
    if options.load is not None:
        _agrees(options.load, settings)
    elif (
        settings.changes or settings.preset != "auto"
    ):  # before anything slow; only then does the window wait for torch
        from nerf_core.training.trainer import check_constants

        check_constants(settings)
    try:
        window = open_offscreen(size, scale) if options.headless else open_window("nerf-viewer", size)
    except DisplayError as error:
        say(str(error))
        say("working offscreen")
        window = open_offscreen(size, scale)
    if not window.has_display and wishes.tour is not None:
        window.close()
        raise UserError("--tour: a tour is for a reader: it needs a window, and there is none here")
    if not window.has_display:
        wishes = sessions.unattended(wishes)
    elif options.scale is not None:
        window.close()
        raise UserError(f"--scale {scale:g}: a window takes its screen's scale; this goes with --headless")
    session = sessions.Session(window, settings, signals, say, options.language)
    session.app.state.presenter = options.presenter
    try:
        return session.run(options.data, wishes)
    finally:
        session.close()


def _agrees(file: Path, settings: RunSettings) -> None:
    """Raise UserError if the options name another method or other constants than the checkpoint has."""
    from nerf_core.training.checkpoint import describe

    description = describe(file)
    method, own = description["method"], description["config"]
    if settings.method not in ("auto", method):
        asked = shorten(settings.method)
        raise UserError(f"--method {asked}: {file} holds a model of method {shorten(method)}: leave one of them out")
    if settings.preset != "auto":
        raise UserError(f"--preset {shorten(settings.preset)}: the constants of {file} are fixed: leave it out")
    for name, text in settings.changes.items():
        value: Any = own
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if not _same(text, value):
            asked = f"{shorten(name)}={shorten(text)}"
            raise UserError(f"--set {asked}: the constants of {file} are fixed, here {shorten(value)}: leave it out")


def _same(text: str, value: Any) -> bool:
    try:
        return float(text) == float(value)
    except (TypeError, ValueError):
        return text.lower() == str(value).lower()


def command() -> NoReturn:
    """Run `main` and end the process."""
    status = main()
    if any(thread.name == WORKER_THREAD for thread in threading.enumerate()):
        # The worker did not end in time, for example because it is in the middle of a huge step. A normal exit would
        # tear down the interpreter while torch still runs in it, and torch would abort.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    command()
