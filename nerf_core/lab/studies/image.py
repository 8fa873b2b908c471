"""`nerf-core lab image`: the lecture's (x, y) → (r, g, b), with four encodings side by side."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from nerf_core.common.colormaps import colored
from nerf_core.common.configs import constant
from nerf_core.common.device import pick_device
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import write_atomically
from nerf_core.common.language import marked, phrase
from nerf_core.datasets.images import UnreadableError, measure, read_photo
from nerf_core.lab.image_figure import Learned, draw_figure
from nerf_core.lab.image_fit import MAPPINGS, ImageConfig, ImageFit
from nerf_core.lab.records import Advance, Curve, Knob, Look, Report, Result, Row, Table
from nerf_core.lab.sample_photo import sample_photo
from nerf_core.lab.spectrum import map_range, spectrum
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, checked
from nerf_core.lab.tables import spread
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.video import write_png

LOOKS = 40  # pictures of each network over the whole study: one costs as much as some steps
STATE = "networks.safetensors"
# Tancik et al. 2020, table 1, "2D natural": the mean test PSNR over their 16 photos
PUBLISHED = {"none": 19.32, "basic": 21.72, "positional": 24.95, "gaussian": 25.57}
L, SIGMA = "L", "σ"  # the knobs
SAMPLE_SIDE = 512  # the drawn photo is that of this size, averaged
Curves = tuple[list[float], ...]
TURNS = {L: "positional", SIGMA: "gaussian"}


class _Progress:
    """How far four networks are, for whoever watches and for a file.

    curves: by encoding, the steps at which its PSNR was taken, and the PSNR over the learnt and the held-out pixels, in
        dB.
    """

    def __init__(self, fit: ImageFit, steps: int) -> None:
        self._fit, self._steps = fit, steps
        self._range = map_range(spectrum(fit.photo))
        self.curves: dict[str, Curves] = {name: ([], [], []) for name in MAPPINGS}

    def advance(self, text: str, looks: tuple[Look, ...] = ()) -> Advance:
        done = sum(self._fit.steps.values()) / (len(MAPPINGS) * self._steps)
        curves = tuple(Curve(name, np.array(x), np.array(y)) for name, (x, _, y) in self.curves.items())
        return Advance(done, text, looks, curves)

    def first_looks(self) -> tuple[Look, ...]:
        """Return the photo and what every network draws now, and behind them their spectra: this order stays."""
        pictures = {"photo": self._fit.photo} | {name: self._fit.picture(name) for name in MAPPINGS}
        looks = tuple(Look(name, to_bytes(picture)) for name, picture in pictures.items())
        return looks + tuple(self.spectrum(name, picture) for name, picture in pictures.items())

    def look(self, name: str) -> tuple[Look, ...]:
        """Draw and measure what a network has learnt, and its spectrum."""
        picture = self._fit.picture(name)
        train, test = self._fit.psnr(name, picture)
        for values, new in zip(self.curves[name], (self._fit.steps[name], train, test), strict=True):
            values.append(new)
        return Look(name, to_bytes(picture), phrase("{psnr:.1f} dB", psnr=test)), self.spectrum(name, picture)

    def spectrum(self, name: str, picture: np.ndarray) -> Look:
        """Return the logarithmic spectrum of a picture (H, W, 3), in the range of the photo's."""
        return Look(phrase("spectrum of {name}", name=phrase(name)), to_bytes(colored(spectrum(picture), *self._range)))

    def begin_again(self, name: str, value: float) -> None:
        """Begin a network again with another L or σ."""
        self._fit.replace(name, value)
        self.curves[name] = ([], [], [])

    def store(self, file: Path) -> None:
        """Write networks, optimisers and curves. Raises UserError."""
        about = {"curves": json.dumps(self.curves)}
        write_atomically(file, save({key: v.contiguous() for key, v in self._fit.state().items()}, about))

    def resume(self, file: Path) -> None:
        """Go on from a file that `store` wrote. Raises UserError if it is none."""
        try:
            with safe_open(file, "pt") as held:
                self._fit.load_state({key: held.get_tensor(key) for key in held.keys()})  # noqa: SIM118  no dictionary
                curves = json.loads(held.metadata()["curves"])
            self.curves = {
                name: (list(curves[name][0]), list(curves[name][1]), list(curves[name][2])) for name in MAPPINGS
            }
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            reason = shorten(" ".join(str(error).split()), 100)
            raise UserError(f"{file}: cannot be continued ({reason}): delete it, to begin again") from None


@cache
def _drawn(size: int) -> np.ndarray:
    """Draw the photo once: it takes seconds."""
    return sample_photo(size)


def photo_of(path: Path | None, size: int) -> np.ndarray:
    """Read a photo (H, W, 3) float32 in [0, 1], averaged so that its longest side has `size` pixels at most.

    None: the photo that the program draws. Raises UserError if the file is no photo.
    """
    if path is None:
        return _drawn(max(size, SAMPLE_SIDE))
    try:
        header = measure(path)
        wide, high = (header.width, header.height) if header.orientation < 5 else (header.height, header.width)
        scale = max(1, -(-max(wide, high) // size))
        return read_photo(path, (wide // scale, high // scale), (1.0, 1.0, 1.0), True).astype(np.float32) / 65535
    except UnreadableError as error:
        raise UserError(f"{error}: choose a photo") from None


@STUDIES.register("image")
@dataclass(frozen=True)
class Image:
    """(x, y) → (r, g, b): a photo learnt by four networks that differ only in how the coordinates are encoded."""

    title: ClassVar[str] = marked("Encoding an image")
    summary: ClassVar[str] = marked(
        "A network that gets bare coordinates learns a blur; one that gets their Fourier features learns the photo."
    )
    order: ClassVar[int] = 4
    of_scene: ClassVar[bool] = False

    size: int = constant(
        128, marked("longest side of the photo in pixels; a larger one is averaged"), least=16, most=2048
    )
    steps: int = constant(500, marked("optimiser steps of each network"), least=1, most=10**7)
    frequencies: int = constant(
        0, marked("number L of frequencies of the positional encoding; 0: as the size suits"), most=16
    )
    sigma: float = constant(
        0.0, marked("deviation σ of the Gaussian frequencies in cycles per picture; 0: as the size suits"), most=1000.0
    )
    seeds: int = constant(1, marked("how many seeds the networks are trained with"), least=1, most=100)

    def __post_init__(self) -> None:
        checked(self)

    def knobs(self) -> tuple[Knob, ...]:
        config = self._config()
        return Knob(L, 1, 12, config.frequencies), Knob(SIGMA, 0.5, 64, config.sigma)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        if subject.data is not None:
            photo_of(subject.data, self.size)  # raises UserError for what is no photo
        return tuple(
            Row(f"seed-{seed}", phrase("seed {seed}", seed=seed), {"seed": seed}) for seed in range(self.seeds)
        )

    def _fit(self, subject: Subject, seed: int) -> ImageFit:
        return ImageFit(photo_of(subject.data, self.size), self._config(), seed, pick_device(subject.device))

    def _config(self) -> ImageConfig:
        given = {"frequencies": self.frequencies, "sigma": self.sigma}
        chosen = {name: value for name, value in given.items() if value}
        return ImageConfig.suiting(self.size, steps=self.steps, **chosen)

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        fit, file = self._fit(subject, row.values["seed"]), bench.run / STATE
        progress = _Progress(fit, self.steps)
        if file.exists():
            progress.resume(file)
        every, turned = max(1, self.steps // LOOKS), dict[str, float]()
        try:
            knobs = {L: float(fit.config.frequencies), SIGMA: fit.config.sigma}
            yield replace(progress.advance(marked("begins"), progress.first_looks()), knobs=knobs)
            while min(fit.steps.values()) < self.steps:
                for knob, value in bench.turned.items():
                    if turned.get(knob) != value:
                        turned[knob] = value
                        progress.begin_again(TURNS[knob], round(value) if knob == L else value)
                for name in MAPPINGS:
                    if fit.steps[name] < self.steps:
                        fit.step(name)
                        due = fit.steps[name] % every == 0 or fit.steps[name] == self.steps
                        text = phrase("step {step:,} of {steps:,}", step=min(fit.steps.values()), steps=self.steps)
                        yield progress.advance(text, progress.look(name) if due else ())
        except GeneratorExit:  # cancelled between two steps
            progress.store(file)
            raise
        measured = {}
        for name in MAPPINGS:
            picture = fit.picture(name)
            train, test = fit.psnr(name, picture)
            write_png(bench.pictures / f"{name}.png", to_bytes(picture))
            steps, learnt, held_out = progress.curves[name]
            measured[name] = {"train": train, "test": test, "parameters": fit.parameters(name),
                              "steps": steps, "learnt": learnt, "held_out": held_out}  # fmt: skip
            yield progress.advance(phrase("measured {name}", name=name))
        write_png(bench.pictures / "photo.png", to_bytes(fit.photo))
        height, width = fit.photo.shape[:2]
        return {"encodings": measured, "L": fit.config.frequencies, "sigma": fit.config.sigma,
                "pixels": height * width}  # fmt: skip

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        done = {key: result for key, result in results.items() if "failed" not in result}
        lines = []
        for name in MAPPINGS if done else ():
            own = [result["encodings"][name] for result in done.values()]
            lines.append((name, f"{own[0]['parameters']:,}", spread([one["train"] for one in own], 2),
                          spread([one["test"] for one in own], 2), f"{PUBLISHED[name]:.2f}"))  # fmt: skip
        columns = (
            marked("encoding"), marked("parameters"), marked("PSNR of training pixels, dB"), marked("of test pixels"),
            marked("published, test pixels"),
        )  # fmt: skip
        notes: tuple[str, ...] = ()
        if done:
            first = next(iter(done.values()))
            ratio = first["encodings"]["none"]["parameters"] / first["pixels"]
            notes = (
                phrase(
                    "Training pixels have an even row and an even column, test pixels an odd row and an odd column. "
                    "L = {L}, σ = {sigma:g}.",
                    L=first["L"],
                    sigma=first["sigma"],
                ),
                marked("The Gaussian encoding has 512 inputs, and so the larger first layer."),
                phrase(
                    "The network of bare coordinates has {ratio:.1f} parameters for each pixel, and still learns a "
                    "blur.",
                    ratio=ratio,
                ),
                marked(
                    "The published means are over 16 photos of 512 × 512, after 2,000 steps over all training pixels."
                ),
            )
        table = Table(phrase("An image, {steps:,} steps each", steps=self.steps), columns, tuple(lines), notes)
        if not (figures and done):
            return Report((table,))
        key, first = next(iter(done.items()))
        return Report((table,), {"image": _figure(pictures / key, first)})


def _figure(pictures: Path, result: Result) -> bytes:
    """Draw the figure of one row from its pictures."""
    remarks = {"none": "(x, y) alone", "basic": "one wave an axis", "positional": f"L = {result['L']}",
               "gaussian": f"σ = {result['sigma']:g} cycles"}  # fmt: skip
    learned = []
    for name, one in result["encodings"].items():
        curves = (np.array(one[key]) for key in ("steps", "learnt", "held_out"))
        learned.append(Learned(name, remarks[name], _picture(pictures / f"{name}.png"), *curves))
    return draw_figure(_picture(pictures / "photo.png"), learned)


def _picture(file: Path) -> np.ndarray:
    """Read a picture of the study, (H, W, 3) float32 in [0, 1]. Raises UserError."""
    try:
        return photo_of(file, 10**6)
    except FileNotFoundError:
        raise UserError(f"{file}: is missing: delete the folder `rows` beside it, to do the rows again") from None
