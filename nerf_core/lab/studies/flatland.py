"""`nerf-core lab flatland`: a world of two dimensions, learnt from one-dimensional photos in a minute or two."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from nerf_core.common.configs import constant, constants
from nerf_core.common.language import marked, phrase
from nerf_core.lab.flatland.course import CAMERA, FILM_SIDE, PIXEL, TURNABLE, Course
from nerf_core.lab.flatland.figure import draw_figure
from nerf_core.lab.flatland.film import write_film
from nerf_core.lab.flatland.fit import FlatConfig, field_picture
from nerf_core.lab.flatland.rays import PIXELS
from nerf_core.lab.records import Advance, Knob, Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, checked, chosen
from nerf_core.lab.tables import cell, failures
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.video import write_png

STATE, FILM = "course.safetensors", "flatland.mp4"
# What each row changes. Without fine samples there are as many network calls a ray: N_c + (N_c + N_f).
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "complete": (marked("as the options say"), {}),
    "bare": (marked("L = 0: no positional encoding"), {"frequencies": 0}),
    "high": (marked("L = 8: frequencies higher than the photos'"), {"frequencies": 8}),
    "matte": (marked("no directions"), {"directions": 0}),
    "uniform": (marked("no hierarchy, as many network calls"), {"fine": 0}),
    "few": (marked("6 cameras"), {"cameras": 6}),
    "many": (marked("32 cameras"), {"cameras": 32}),
    "noisy": (marked("noise of 0.1 in the photos"), {"noise": 0.1}),
}
LEVELS = (20, 25)  # dB whose step the report tells
THREADS = 1  # products this small are faster on one than on two, and other work has the other


@STUDIES.register("flatland")
@dataclass(frozen=True)
class Flatland(FlatConfig):
    """A world of two dimensions and its one-dimensional photos: the whole field can be seen while it is learnt."""

    title: ClassVar[str] = marked("Flatland")
    summary: ClassVar[str] = marked(
        "A flat world, photographed by a ring of cameras with one line of pixels each, and learnt as the paper learns "
        "a scene. Few cameras let floaters in, noise in the photos makes haze."
    )
    order: ClassVar[int] = 5
    of_scene: ClassVar[bool] = False
    of_photo: ClassVar[bool] = False

    rows: str = constant(
        "complete", phrase("what is learnt: {rows}, with commas between, or all", rows=", ".join(ROWS))
    )

    def __post_init__(self) -> None:
        checked(self)
        chosen(self.rows, ROWS, "--rows")

    def _config(self, row: str) -> FlatConfig:
        config = FlatConfig(**{name: getattr(self, name) for name in constants(FlatConfig)})
        config = replace(config, **ROWS[row][1])
        return replace(config, coarse=min(2 * config.coarse + self.fine, 128)) if row == "uniform" else config

    def knobs(self) -> tuple[Knob, ...]:
        turnable = []
        for knob, name in TURNABLE.items():
            _, about = constants(FlatConfig)[name]
            turnable.append(Knob(knob, about.least, about.most, getattr(self, name)))
        chooser = Knob(CAMERA, 0, 2 * constants(FlatConfig)["cameras"][1].most, 0, True)
        return (*turnable, chooser, Knob(PIXEL, 0, PIXELS - 1, PIXELS // 2, True))

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        return tuple(Row(name, ROWS[name][0], {"row": name}) for name in chosen(self.rows, ROWS, "--rows"))

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        return (yield from _on_threads(self._work(row, bench), subject.threads or THREADS))

    def _work(self, row: Row, bench: Bench) -> Work:
        config, file = self._config(row.key), bench.run / STATE
        course = Course(config, bench.turned, bench.watched)
        try:
            if file.exists():
                yield from course.resume(file)
                turned = course.knobs()
                for knob, name in TURNABLE.items():  # what was turned before is not what the options say
                    if turned[knob] != getattr(config, name):
                        bench.turned.setdefault(knob, turned[knob])
            yield from course.pieces()
        except GeneratorExit:  # cancelled between two pieces
            course.store(file)
            raise
        return (yield from _measured(course, bench))

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        done = {key: result for key, result in results.items() if "failed" not in result}
        lines = []
        for key, one in done.items():
            samples = f"({one['coarse']}, {one['fine'] or '–'})"
            lines.append((ROWS[key][0], f"{one['frequencies']}", samples, f"{one['cameras']}", f"{one['noise']:g}",
                          cell(one["psnr"], 2), cell(one["train"], 2),
                          *(_step_of(one["curve"], level) for level in LEVELS)))  # fmt: skip
        columns = ("row", "L", "(N_c, N_f)", "cameras", "noise", "PSNR dB, held out", "training",
                   *(f"step of {level} dB" for level in LEVELS))  # fmt: skip
        notes = [
            phrase("{steps:,} steps each, on the CPU.", steps=self.steps),
            marked("Held-out photos are of cameras in the middle between two of training."),
            marked("PSNR is against the exact photos, which have no noise."),
            *(phrase("Film: {file}.", file=f"pictures/{key}/{FILM}") for key in done),
            *failures(results, {key: ROWS[key][0] for key in ROWS}),
        ]  # fmt: skip
        table = Table(marked("Flatland"), columns, tuple(lines), tuple(notes))
        if not (figures and done):
            return Report((table,))
        return Report((table,), {"flatland": draw_figure(done, pictures)})


def _step_of(curve: list[list[float]], level: float) -> str:
    """Return the first measured step at which a curve (steps, PSNR) is at a level; a dash for none."""
    found = [step for step, psnr in zip(*curve, strict=True) if psnr >= level]
    return f"{found[0]:,.0f}" if found else "–"


def _measured(course: Course, bench: Bench) -> Work:
    """Measure all photos, and write the pictures and the film."""
    fit, config, held_out = course.fit, course.config, course.held_out()
    assert fit is not None
    ended = Advance(1.0, marked("measuring"))
    errors = []
    for camera in range(held_out.stop):
        errors.append(course.error(camera))
        yield ended
    eye, world = fit.truth.rays.origins[held_out[0] * PIXELS], fit.world
    true_field = to_bytes(field_picture(world.radiance, eye, FILM_SIDE, world.background))
    true_photo = to_bytes(fit.truth.colors[fit.pixels(held_out[0])].numpy())
    write_png(bench.pictures / "field.png", course.frames[-1])
    write_png(bench.pictures / "truth.png", true_field)
    yield ended
    labels = [course.label(k) for k in range(len(course.frames))]
    for _ in write_film(bench.pictures / FILM, course.frames, course.photos, (true_field, true_photo), labels):
        yield Advance(1.0, marked("writing the film"))
    shown = {
        name: getattr(config, name) for name in ("frequencies", "directions", "coarse", "fine", "cameras", "noise")
    }
    return shown | {
        "psnr": _db(errors[held_out.start :]), "train": _db(errors[: held_out.start]), "curve": list(course.scores),
    }  # fmt: skip


def _db(errors: list[float]) -> float:
    return float(-10 * np.log10(max(np.mean(errors), 1e-10)))


def _on_threads(work: Work, count: int) -> Generator[Advance, None, Result]:
    """Do work on so many threads of torch; others keep theirs between its pieces."""
    try:
        while True:
            before = torch.get_num_threads()
            torch.set_num_threads(count)
            try:
                piece = next(work)
            except StopIteration as end:
                return end.value
            finally:
                torch.set_num_threads(before)
            yield piece
    finally:
        work.close()
