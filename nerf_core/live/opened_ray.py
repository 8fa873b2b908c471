"""The ray under the lens: opened again and again while training goes on, a piece of work at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import fields, replace

from nerf_core.live.clock import RefreshClock
from nerf_core.live.messages import Inspect, Pin
from nerf_core.probe import Opened, TrainingViews, open_pixel
from nerf_core.probe.opened import pieces
from nerf_core.training.trainer import Trainer


class OpenedRay:
    """Does one piece at a time: a ray, its verdict, its radiance, its walk. Owned by the worker thread.

    Attributes:
        asked: the request for the ray; None: no ray is open.
        opened: the newest of each piece. While training goes on, the others may be some steps newer than the ray.
        opened_step: the training step of the ray; −1 until verdict, radiance and walk are of the same look.
        answered: the `Inspect.look` for which all pieces are there; 0: none yet.
    """

    def __init__(self) -> None:
        self.opened: Opened | None = None
        self.opened_step = -1
        self.answered = 0
        self.asked: Inspect | None = None
        self._pieces: Iterator[None] | None = None
        self._training_views: TrainingViews | None = None
        self._clock = RefreshClock()
        self._one_step = False  # whether all of what is opened is of one step

    def inspect(self, command: Inspect | None) -> None:
        """Open this ray; None: close the one that is open."""
        if command is None or command.id != self.id:
            self.opened = None
        self.asked, self.answered = command, 0
        self._begin_anew()

    def forget(self) -> None:
        """Open the ray anew, because the model was exchanged. Nothing of the old model stays."""
        self.opened = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._pieces, self.opened_step, self._one_step = None, -1, False
        self._clock.reset()

    @property
    def id(self) -> int:
        """Return the ray's id; 0: no ray is open."""
        return self.asked.id if self.asked is not None else 0

    @property
    def urgent(self) -> bool:
        """Whether somebody waits for a ray that is not whole yet."""
        return self.asked is not None and not self.answered

    def draw(self, trainer: Trainer, training: bool) -> bool:
        """Do one piece; return whether there was any. A look that was begun is finished, however old it becomes."""
        if self._pieces is None and self.asked is not None and self._clock.due(trainer, training):
            self._clock.begin(trainer)
            self._pieces = self._look(self.asked, trainer)
        if self._pieces is None:
            return False
        begin = time.monotonic()
        if next(self._pieces, True):
            self._pieces = None
        self._clock.worked(time.monotonic() - begin)
        return True

    def _look(self, asked: Inspect, trainer: Trainer) -> Iterator[None]:
        """Open the ray a piece at a time. Training may go on between two pieces."""
        step, self.opened_step = trainer.step_count, -1
        if self._training_views is None or self._training_views.scene is not trainer.scene:
            self._training_views = TrainingViews(trainer.scene)
        self._training_views.exposures = trainer.exposures
        opened = None
        try:
            for opened in pieces(
                trainer.method, self._training_views, asked.camera, asked.pixel, step, asked.point_t, asked.around
            ):
                self.opened = opened if self.opened is None else _with_older(opened, self.opened)
                yield
        except Exception:
            self.asked = self._pieces = None  # a ray that cannot be opened is reported once, not twice a second
            raise
        self.opened = opened  # what the ray no longer has, a radiance say, goes with the end of the look
        self.opened_step, self.answered, self._one_step = step, asked.look, trainer.step_count == step

    # ---- files -------------------------------------------------------------------------------------------------------

    def whole(self, trainer: Trainer, pins: list[Pin]) -> list[Opened]:
        """Return the ray under the lens, then `pins`; a ray that is both comes once.

        In a file each ray is of one step. A ray with missing pieces, or with pieces of several steps, is opened whole.
        """
        asked = self.asked
        rays = {} if asked is None else {asked.id: self._whole(asked, trainer)}
        for pin in pins:
            found = rays[pin.id] if pin.id in rays else self._whole(pin.inspect(), trainer)
            rays[pin.id] = replace(found, name=pin.name, history=pin.history)
        return list(rays.values())

    def _whole(self, ray: Inspect, trainer: Trainer) -> Opened:
        whole = self.answered and self._one_step and self.opened_step >= 0
        if ray is self.asked and self.opened is not None and whole:
            return self.opened
        return open_pixel(
            trainer.method, trainer.scene, ray.camera, ray.pixel, trainer.step_count, ray.point_t, ray.around,
            trainer.exposures,
        )  # fmt: skip


def _with_older(new: Opened, old: Opened) -> Opened:
    """Fill the pieces that are still missing in `new` from `old`, so that panels do not flicker."""
    return Opened(*(getattr(new, f.name) or getattr(old, f.name) for f in fields(Opened)))
