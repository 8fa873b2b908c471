"""What the worker draws of a run: the preview of the newest view, the opened ray and the pinned ones."""

from __future__ import annotations

import itertools
import time

import torch

from nerf_core.geometry.view_rays import view_rays
from nerf_core.live.messages import Inspect, Pin, Preview, ViewRequest
from nerf_core.live.opened_ray import OpenedRay
from nerf_core.live.pins import Pins
from nerf_core.live.refinement import Refinement, first_stride
from nerf_core.methods import Method, aimed, caption, traced
from nerf_core.rendering.modes import COLOR, shaded
from nerf_core.training.trainer import Trainer

MOVING_SECONDS = 0.05  # the most that the first pixels of a moving camera may take: three frames
RESTING_SECONDS = 0.3  # the same of a camera at rest
WHOLE_SECONDS = 0.04  # a level that takes no longer is drawn between two steps: copying the weights takes as long
GUESSED_RATE = 4000.0  # rays a second, until a tile has been timed

_fresh = itertools.count(1).__next__  # numbers of models are unique within a process


class Artist:
    """Draws a piece at a time and remembers what is half done. Owned by the worker thread."""

    def __init__(self) -> None:
        self.ray, self.pins = OpenedRay(), Pins()
        self._picture: Refinement | None = None
        self._number = _fresh()  # of the model; pictures carry it
        self._model: Method | None = None  # what draws the level under way, and
        self._model_step = 0
        self._whole = False  # the level under way is to be done before the next step
        self._copy: Method | None = None
        self._copy_step = -1
        self._ready: Preview | None = None  # the newest picture that may be shown, and
        self._shown: Preview | None = None  # the one that was handed out last
        self._moving = False
        self._rates: dict[tuple[str, str], float] = {}  # by quality and mode
        self._least: dict[tuple[str, str], float] = {}  # what the rates are at least, until they are measured
        self._level = 0, 0.0  # cells of the level under way that are drawn, and the seconds they took

    def forget_pictures(self) -> None:
        """Draw everything anew, because the model was exchanged."""
        self._picture = self._model = self._copy = self._ready = self._shown = None
        self._number = _fresh()
        self._rates.clear()  # of another method: a fast one's would give a slow one a first level of many seconds
        self._least.clear()
        self.ray.forget()
        self.pins.forget()

    def open_rays(self) -> list[Pin | Inspect]:
        """Return the pinned rays, then the one under the lens if there is one."""
        return [*self.pins, *filter(None, [self.ray.asked])]

    @property
    def fresh(self) -> bool:
        """Whether `preview` would return another picture than the last time."""
        return self._ready is not self._shown or (self._picture is not None and self._picture.fresh)

    def preview(self, previous: Preview | None) -> Preview | None:
        """Return the newest picture to show: the previous one until the first level of a new camera is complete."""
        picture = self._picture
        if picture is not None and picture.fresh and picture.first_level_done and picture.coherent():
            self._ready = picture.image()
        self._shown = self._ready
        return previous if self._ready is None else self._ready

    def rays_per_second(self, quality: str) -> float:
        """Return the measured speed of colour pictures of a quality, "fine" or "coarse"; 0: not measured yet."""
        return self._rates.get((quality, COLOR), 0.0)

    def urgent(self, view: ViewRequest | None) -> bool:
        """Whether drawing comes before training: `view` lacks a picture, or a level between two steps is half drawn."""
        picture = self._picture
        if view is None:
            return False
        if picture is None or picture.stamp != view.stamp or not picture.first_level_done:
            return True
        return self._whole and not picture.begins and not picture.level_done

    def draw_rays(self, trainer: Trainer, view: ViewRequest | None, training: bool) -> bool:
        """Do one piece of the opened ray or of a pinned one; return whether there was any.

        The first pixels of a new view come before all rays but one that somebody waits for.
        """
        if self.urgent(view) and not self.ray.urgent:
            return False
        return self.ray.draw(trainer, training) or self.pins.draw(trainer, training)

    def draw_view(self, trainer: Trainer, view: ViewRequest, training: bool) -> bool:
        """Draw one piece of the picture; return whether there was any. training: whether more steps are to come.

        Raises UserError for a mode that the method cannot draw.
        """
        picture = self._current(view, trainer.method)
        if not training and self._model_step != trainer.step_count and not picture.begins:
            picture.begin_again()  # what is under way shows a model of before the pause
        if not picture.advance(trainer.step_count, training, time.monotonic()):
            return False
        if picture.begins or self._model is None:
            self._model_step = trainer.step_count
            # A new view's first level is done before the next step, and so is any that is soon done.
            seconds = picture.cells_left / self._speed(picture.quality, picture.mode)
            self._whole = not picture.first_level_done or seconds < WHOLE_SECONDS
            self._model = trainer.method if self._whole else self._frozen(trainer)
            self._level = 0, 0.0
        begin = time.perf_counter()
        cells = picture.take(self._model.tile)
        rays = view_rays(trainer.scene, picture.camera, picture.pixels(cells))
        model = aimed(self._model, picture.camera)
        if picture.mode == COLOR:
            drawn = model.render(rays, picture.quality)
            color = drawn.color.cpu().numpy()
        else:
            trace = traced(model, rays)
            drawn, color = trace.rendering, shaded(model, rays, trace, picture.mode)
        z = drawn.depth.cpu()
        if not picture.camera.lens.wide:  # distance along the ray → depth along the optical axis, −z of the camera
            z = z * (rays.directions @ -torch.from_numpy(picture.camera.c2w[:, 2]).float())
        picture.write(cells, color, z.numpy(), self._model_step)
        if picture.level_done and picture.coherent():  # the next piece may be of the next level, with other weights
            self._ready = picture.image()
        self._note_rate(picture, len(cells), time.perf_counter() - begin)
        if picture.level_done and training:  # the next level has newer weights, and a copy of a fine grid takes 70 MB
            self._model = self._copy = None
        return True

    def _note_rate(self, picture: Refinement, cells: int, seconds: float) -> None:
        """Measure rays per second over whole levels: the rim of a picture is emptier, and faster, than its middle.

        A level of less than a tile is padded to one, so the rate is at least what it tells. That counts until there is
        a larger one: otherwise a camera that never rests would never have more than its first few pixels.
        """
        assert self._model is not None
        self._level = self._level[0] + cells, self._level[1] + seconds
        kind = picture.quality, picture.mode
        known = self._rates.get(kind)
        rate = self._level[0] / max(self._level[1], 1e-6)
        if self._level[0] >= self._model.tile:
            if picture.level_done or known is None:
                self._rates[kind] = rate if known is None else 0.5 * known + 0.5 * rate
        elif picture.level_done and rate > GUESSED_RATE:
            self._least[kind] = max(rate, self._least.get(kind, 0.0))

    def _speed(self, quality: str, mode: str) -> float:
        """Return the rays per second to expect of a picture. The coarse quality is no slower than the fine one."""
        if (quality, mode) in self._rates:
            return self._rates[quality, mode]
        known = self._rates.get(("fine", mode)), self._least.get((quality, mode))
        return max(filter(None, known), default=GUESSED_RATE)

    def _frozen(self, trainer: Trainer) -> Method:
        """Return a copy of the current model, which does not change while training goes on."""
        if self._copy is None or self._copy_step != trainer.step_count:
            self._copy = self._model = None  # two copies of a fine grid would take 70 MB more
            self._copy, self._copy_step = trainer.frozen_method(), trainer.step_count
        return self._copy

    def _current(self, view: ViewRequest, method: Method) -> Refinement:
        """Return the picture to work on: that of the newest view.

        The first level of a moving camera is finished before: otherwise a camera that never rests would show no new
        pixel. Where another network draws the picture by now, everything begins again.
        """
        picture, born = self._picture, method.born
        finish = picture is not None and self._moving and not picture.first_level_done
        if picture is not None and picture.born != born:
            picture = None
            self._number = _fresh()
            self._rates.clear()
            self._least.clear()
        if picture is None or (picture.stamp != view.stamp and not finish):
            quality = "coarse" if view.moving else "fine"
            affordable = self._speed(quality, view.mode) * (MOVING_SECONDS if view.moving else RESTING_SECONDS)
            stride = first_stride(view.camera.width, view.camera.height, affordable)
            picture = self._picture = Refinement(
                view.camera, view.stamp, stride, quality, view.mode, born, self._number, caption(method, view.camera)
            )
            self._moving = view.moving
        return picture
