"""Train Flatland in pieces, with everything that can be looked at meanwhile. It can be interrupted at any piece."""

from __future__ import annotations

import json
import math
import time
from bisect import bisect_right
from collections.abc import Generator, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import write_atomically
from nerf_core.common.language import marked, phrase
from nerf_core.lab.flatland.fit import FlatConfig, FlatFit, Pass, Truth, field_picture, truth_of
from nerf_core.lab.flatland.rays import PIXELS
from nerf_core.lab.flatland.view import FlatPass, FlatRay, FlatView
from nerf_core.lab.flatland.world import World
from nerf_core.lab.records import Advance, Curve, Look
from nerf_core.rendering.images import to_bytes

L, DIRECTIONS, COARSE, FINE, CAMERAS, NOISE = "L", "directions", "coarse", "fine", "cameras", "noise"
TURNABLE = {L: "frequencies", DIRECTIONS: "directions", COARSE: "coarse", FINE: "fine", CAMERAS: "cameras",
            NOISE: "noise"}  # fmt: skip  # by knob: the constant of `FlatConfig`
ANEW = (L, DIRECTIONS, CAMERAS, NOISE)  # the knobs that begin anew; the others say only where samples lie
CAMERA, PIXEL = "camera", "pixel"  # the knobs that choose a ray
SCORE_STEPS = 25  # between two measurements of the held-out photos
FIELD_STEPS = 10  # between two pictures of the field for a window
EARLY, EARLY_STEPS = 60, 4  # the first steps, and between two pictures in them
RAY_STEPS = 4  # between two looks at the chosen ray and at two photos: its own, and the next in turn
SIDE, FILM_SIDE = 128, 128  # pixels of the field's pictures
FRAMES = 120  # of the film, at most one a step
TRUE_SAMPLES = 200  # of the world's density along a ray
RATE_SECONDS = 1.0  # over which the steps a second are counted

Pieces = Generator[Advance, None, None]


class Course:
    """The training of one `FlatFit`, begun anew when a knob asks for it.

    config: the constants now. fit: the networks; None until the photos are taken.
    scores: the steps at which the held-out photos were measured, and their PSNR in dB.
    before: the same of what was learnt before a knob began anew.
    frames: of the film so far, (FILM_SIDE, FILM_SIDE, 3) uint8; and the photo of the held-out camera, (PIXELS, 3).
    """

    def __init__(self, config: FlatConfig, turned: Mapping[str, float], watched: bool) -> None:
        """Prepare it; `pieces` does the work.

        Args:
            config: the constants at first.
            turned: knobs that were turned, by name; it is read at every step.
            watched: whether a window shows it.
        """
        self.config, self.fit = config, None
        self.scores: tuple[list[int], list[float]] = ([], [])
        self.before: tuple[list[int], list[float]] = ([], [])
        self.frames: list[np.ndarray] = []
        self.photos: list[np.ndarray] = []
        self._turned, self._watched, self._world = turned, watched, World()
        self._obeyed: dict[str, float] = {}
        self._began = time.perf_counter(), 0  # for the rate: when, and at which step
        self._rate = 0.0
        self._learnt = self._photographs = self._field = self._truth = np.zeros((1, 1, 3), np.uint8)
        self._undrawn: list[int] = []  # cameras whose photo was not drawn yet
        self._ray: FlatRay | None = None
        self._looked = (-1, -1)

    # ---- pieces -----------------------------------------------------------------------------------------------------

    def pieces(self) -> Pieces:
        """Train to the end. What is owed at a step is decided by the step alone, so that it can go on from a file."""
        if self.fit is None:
            yield from self._begin(None)
        while True:
            yield from self._obey()
            fit = self._need()
            if self._frames_due() > len(self.frames):
                self._film()
                yield self._advance()
            scored = fit.steps in self.scores[0][-1:]
            if not scored and (fit.steps % SCORE_STEPS == 0 or fit.steps == self.config.steps):
                yield from self._score()
                continue  # a knob may have been turned meanwhile
            if fit.steps >= self.config.steps:
                return
            fit.step()
            self._count()
            yield self._advance()
            yield from self._look()

    def _begin(self, truth: Truth | None) -> Pieces:
        """Make networks that know nothing. truth: the photos, if they need not be taken."""
        if truth is None:
            truth = yield from self._photographed()
        yield self._learn(FlatFit(self._world, truth, self.config))
        yield from self._look()

    def _photographed(self) -> Generator[Advance, None, Truth]:
        for truth in truth_of(self._world, self.config.cameras):
            if truth is not None:
                return truth
            yield Advance(0.0, marked("taking the photos"))
        raise AssertionError("the photos come last")

    def _learn(self, fit: FlatFit) -> Advance:
        """Take networks, and return what can be seen of them."""
        self.fit = fit
        self._learnt = np.zeros((len(fit.truth.rays) // PIXELS, PIXELS, 3), np.uint8)
        self._began, self._rate, self._looked = (time.perf_counter(), fit.steps), 0.0, (-1, -1)
        photos = fit.truth.colors.clone()
        photos[: len(fit.photos)] = fit.photos
        self._photographs = to_bytes(photos.view(-1, PIXELS, 3).numpy())
        self._undrawn = list(range(len(self._learnt)))
        return replace(self._advance(), knobs=self.knobs())

    def _obey(self) -> Pieces:
        """Do what knobs ask for that were turned since the last call."""
        fresh = {k: v for k, v in self._turned.items() if self._obeyed.get(k) != v}
        self._obeyed = dict(self._turned)
        wanted = {TURNABLE[k]: v if k == NOISE else round(v) for k, v in fresh.items() if k in TURNABLE}
        changes = {name: value for name, value in wanted.items() if value != getattr(self.config, name)}
        if not changes:
            return
        self.config = replace(self.config, **changes)
        if any(TURNABLE[knob] in changes for knob in ANEW):
            self.before = self.scores
            self.scores, self.frames, self.photos = ([], []), [], []
            truth = None if "cameras" in changes else self._need().truth
            self.fit = None  # so that networks of other constants are not stored
            yield from self._begin(truth)
        else:
            self._need().config = self.config

    def _need(self) -> FlatFit:
        assert self.fit is not None  # `_begin` made it
        return self.fit

    def knobs(self) -> dict[str, float]:
        """Return the values of the knobs that say what is learnt, by name."""
        return {knob: float(getattr(self.config, name)) for knob, name in TURNABLE.items()}

    # ---- what is measured -------------------------------------------------------------------------------------------

    def _score(self) -> Pieces:
        """Measure the held-out photos, one a piece."""
        fit, errors = self._need(), list[float]()
        for camera in self.held_out():
            errors.append(self.error(camera))
            yield self._advance()
        self.scores[0].append(fit.steps)
        self.scores[1].append(float(-10 * np.log10(max(np.mean(errors), 1e-10))))

    def held_out(self) -> range:
        """Return the numbers of the held-out cameras."""
        training = len(self._need().truth.training)
        return range(training, training + len(self._need().truth.held_out))

    def error(self, camera: int) -> float:
        """Return the mean squared error of a camera's photo against the exact one."""
        fit, drawn = self._need(), self._draw(camera)
        return float(np.square(drawn - fit.truth.colors[fit.pixels(camera)].numpy()).mean())

    def _frames_due(self) -> int:
        """Return how many frames the film has at this step. They lie closer at first, when most happens."""
        return 1 + int(self._last_frame() * (self._need().steps / self.config.steps) ** 0.5)

    def _last_frame(self) -> int:
        return min(FRAMES, self.config.steps)

    def _film(self) -> None:
        fit, camera = self._need(), self.held_out()[0]
        field, photo = to_bytes(fit.field(FILM_SIDE, camera)), to_bytes(fit.photo(camera))
        while len(self.frames) < self._frames_due():
            self.frames.append(field)
            self.photos.append(photo)

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def _count(self) -> None:
        now, (then, step) = time.perf_counter(), self._began
        if now - then > RATE_SECONDS or not self._rate:
            self._rate = (self._need().steps - step) / (now - then)
            self._began = now, self._need().steps

    def _advance(self, looks: tuple[Look, ...] = ()) -> Advance:
        fit = self._need()
        text = phrase("step {step:,} of {steps:,}", step=fit.steps, steps=self.config.steps)
        done = fit.steps / self.config.steps
        return Advance(done, text, looks, self._curves(), flat=self._view() if self._watched else None)

    def _curves(self) -> tuple[Curve, ...]:
        curves = (Curve(marked("held-out photos"), *map(np.array, self.scores)),)
        return (*curves, Curve(marked("before"), *map(np.array, self.before))) if self.before[0] else curves

    def _look(self) -> Pieces:
        """Draw what is due for a window: the chosen ray and photos, then the field."""
        if not self._watched:
            return
        fit, cameras = self._need(), len(self._learnt)
        wanted = min(round(self._turned.get(CAMERA, 0)), cameras - 1), round(self._turned.get(PIXEL, PIXELS // 2))
        moved, around = wanted != self._looked, wanted[0] != self._looked[0]
        self._looked = wanted
        due = moved or fit.steps % RAY_STEPS == 0
        if due:
            self._ray = ray_of(fit, *wanted)
            self._draw(wanted[0])
        if self._undrawn:
            self._draw(self._undrawn.pop())
        elif due:
            self._draw(fit.steps // RAY_STEPS % cameras)
        if due:
            yield self._advance()
        if around:
            eye = fit.truth.rays.origins[wanted[0] * PIXELS]
            self._truth = to_bytes(field_picture(self._world.radiance, eye, SIDE, self._world.background))
        if around or fit.steps % (EARLY_STEPS if fit.steps < EARLY else FIELD_STEPS) == 0:
            self._field = to_bytes(fit.field(SIDE, wanted[0]))
            yield self._advance(self._pictures())

    def _draw(self, camera: int) -> np.ndarray:
        """Draw a camera's photo, (PIXELS, 3) float32, and show it."""
        drawn = self._need().photo(camera)
        self._learnt = self._learnt.copy()  # what was published stays
        self._learnt[camera] = to_bytes(drawn)
        return drawn

    def _pictures(self) -> tuple[Look, ...]:
        return Look(marked("learnt field"), self._field, self.score()), Look(marked("true field"), self._truth)

    def label(self, frame: int) -> str:
        """Return the step and the PSNR of a frame of the film, in words."""
        step = math.ceil(self.config.steps * (frame / self._last_frame()) ** 2)
        steps, psnr = self.scores
        return f"step {step:,}, {psnr[bisect_right(steps, step) - 1]:.1f} dB"

    def score(self) -> str:
        """Return the newest PSNR in words; empty: none yet."""
        return phrase("{psnr:.1f} dB", psnr=self.scores[1][-1]) if self.scores[1] else ""

    def _view(self) -> FlatView:
        fit = self._need()
        psnr = self.scores[1][-1] if self.scores[1] else float("nan")
        return FlatView(
            fit.truth.rays.origins[::PIXELS].numpy(), len(fit.truth.training),
            self._photographs, self._learnt, self._field, self._truth,
            fit.steps, psnr, self._rate, self._ray,
        )  # fmt: skip

    # ---- files ------------------------------------------------------------------------------------------------------

    def store(self, file: Path) -> None:
        """Write networks, optimiser, curves and the film so far. Raises UserError. Without networks, write nothing."""
        if self.fit is None:
            return
        about = {"config": asdict(self.config), "scores": self.scores, "before": self.before}
        state = {key: value.contiguous() for key, value in self.fit.state().items()}
        film = {"frames": np.array(self.frames, np.uint8), "photos": np.array(self.photos, np.uint8)}
        state |= {f"film.{key}": torch.from_numpy(value) for key, value in film.items()}
        write_atomically(file, save(state, {"course": json.dumps(about)}))

    def resume(self, file: Path) -> Iterator[Advance]:
        """Go on from a file that `store` wrote. Raises UserError if it is none."""
        try:
            with safe_open(file, "pt") as held:
                state = {key: held.get_tensor(key) for key in held.keys()}  # noqa: SIM118  no dictionary
                about = json.loads(held.metadata()["course"])
            config = FlatConfig(**about["config"])
            self.config = config
            fit = FlatFit(self._world, (yield from self._photographed()), config)
            fit.load_state(state)
            scores, before = about["scores"], about["before"]
            self.scores, self.before = (scores[0], scores[1]), (before[0], before[1])
            self.frames, self.photos = list(state["film.frames"].numpy()), list(state["film.photos"].numpy())
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            reason = shorten(" ".join(str(error).split()), 100)
            raise UserError(f"{file}: cannot be continued ({reason}): delete it, to begin again") from None
        yield self._learn(fit)
        yield from self._look()


def ray_of(fit: FlatFit, camera: int, pixel: int) -> FlatRay:
    """Return a ray with the samples of its passes, evenly spaced ones, as photos are drawn."""
    index = camera * PIXELS + min(max(pixel, 0), PIXELS - 1)
    rays = fit.truth.rays[slice(index, index + 1)]
    with torch.no_grad():
        passes = fit.passes(rays)
    near, far = float(rays.near), float(rays.far)
    t = torch.linspace(near, far, TRUE_SAMPLES)[None]
    return FlatRay(
        camera, index % PIXELS, rays.origins[0].numpy(), rays.directions[0].numpy(), near, far,
        tuple(_seen(name, one) for name, one in zip(fit.networks, passes, strict=False)),
        fit.truth.colors[index].numpy(), t[0].numpy(), fit.world.density(rays.points(t)).numpy(),
    )  # fmt: skip


def _seen(name: str, one: Pass) -> FlatPass:
    return FlatPass(name, *(value[0].numpy() for value in one))
