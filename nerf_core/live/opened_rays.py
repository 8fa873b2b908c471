"""The rays that are kept open for the window while training goes on: the one under the lens, and those pinned."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from nerf_core.live.messages import Inspect, Pin, Pinned
from nerf_core.probe import Opened, RayHistory, RayProbe, Witnesses, open_pixel, open_ray
from nerf_core.probe.history import HistoryRecorder
from nerf_core.probe.opened import pieces
from nerf_core.training.trainer import Trainer

REFRESH_SECONDS = {"cpu": 0.4, "cuda": 0.09}  # between two looks at a ray while training goes on: 2 and 10 a second
PART = 0.15  # of the time at most: where a look takes longer, it comes more rarely


@dataclass
class _Clock:
    """When something is to be looked at anew."""

    step: int = -1
    ended: float = -1e9
    took: float = 0.0

    def due(self, trainer: Trainer, training: bool) -> bool:
        if self.step == trainer.step_count or not training:
            return self.step != trainer.step_count
        every = max(REFRESH_SECONDS.get(trainer.device.type, 0.4), self.took / PART)
        return time.monotonic() - self.ended > every

    def begin(self, trainer: Trainer) -> None:
        self.step, self.took = trainer.step_count, 0.0

    def worked(self, seconds: float) -> None:
        self.took += seconds
        self.ended = time.monotonic()

    def reset(self) -> None:
        self.step, self.ended = -1, -1e9


@dataclass
class _Pin:
    command: Pin
    recorder: HistoryRecorder
    ray: RayProbe | None = None
    clock: _Clock = field(default_factory=_Clock)


class OpenedRays:
    """Does one piece at a time: a ray, its verdict, its radiance, its walk. Owned by the worker thread.

    `opened` has the newest of each of one ray; `opened_step` is the step at which its ray was opened, −1 while the rest
    is not there or older. While training goes on, the rest may be some steps younger: panels do not wait for that.
    """

    def __init__(self) -> None:
        self._pins: dict[int, _Pin] = {}
        self._known: list[tuple[Inspect, RayHistory]] = []
        self._witnesses: Witnesses | None = None
        self._clock = _Clock()
        self.inspect(None)

    # ---- what is wanted ----------------------------------------------------------------------------------------------

    def inspect(self, command: Inspect | None) -> None:
        """Open this ray; None: none."""
        same = command is not None and self._asked is not None and _same_ray(command, self._asked)
        self._asked = command
        self._pieces: Iterator[None] | None = None
        self._clock.reset()
        self._pure = False  # whether all of what is opened is of one step
        self._waiting = command is not None
        if not same:
            self.opened: Opened | None = None
        self.opened_step = -1

    _asked: Inspect | None = None

    @property
    def urgent(self) -> bool:
        """Whether somebody waits for a ray that was asked for and is not whole yet."""
        return self._asked is not None and self._waiting

    def pin(self, command: Pin, trainer: Trainer) -> None:
        ray = Inspect(command.camera, command.pixel)
        k = next((k for k, (known, _) in enumerate(self._known) if _looks_alike(ray, known)), None)
        if k is None:
            recorder = HistoryRecorder(trainer.step_count, trainer.total_steps)
        else:
            recorder = HistoryRecorder.of(self._known.pop(k)[1], trainer.step_count, trainer.total_steps)
        self._pins[command.id] = _Pin(command, recorder)

    def unpin(self, number: int) -> None:
        self._pins.pop(number, None)

    def forget(self) -> None:
        """The model was exchanged: what is open is to be opened anew, histories begin again."""
        self._pieces, self.opened_step = None, -1
        self._clock.reset()
        for pin in self._pins.values():
            pin.clock.reset()

    def restart(self, trainer: Trainer) -> None:
        """Another model, or another course of training: its history begins now."""
        self.forget()
        self._known = []
        for pin in self._pins.values():
            pin.recorder = HistoryRecorder(trainer.step_count, trainer.total_steps)

    def rewind(self, step: int) -> None:
        self.forget()
        for pin in self._pins.values():
            pin.recorder.rewind(step)

    def know(self, rays: Sequence[tuple[Inspect, RayHistory]]) -> None:
        """These rays of the model were watched before: when each is pinned next, its history goes on."""
        self._known = list(rays)

    def histories(self) -> list[tuple[Inspect, RayHistory]]:
        """The pinned rays that have one."""
        pins = [(pin.command, pin.recorder.view()) for pin in self._pins.values()]
        return [(Inspect(pin.camera, pin.pixel), history) for pin, history in pins if history is not None]

    def pinned(self) -> tuple[Pinned, ...]:
        return tuple(Pinned(number, pin.ray, pin.recorder.view()) for number, pin in self._pins.items())

    def whole(self, trainer: Trainer, names: Mapping[int, str]) -> list[Opened]:
        """The ray under the lens, then the pinned ones that have names; one that is both comes once. What is not whole
        yet, or of several steps, is opened whole now: a file is of one step a ray."""
        pins = [(self._pins[number], name) for number, name in names.items() if number in self._pins]
        found = [] if self._asked is None else [self._whole(self._asked, trainer)]
        rays = [] if self._asked is None else [self._asked]
        for pin, name in pins:
            ray, history = Inspect(pin.command.camera, pin.command.pixel), pin.recorder.view()
            k = next((k for k, other in enumerate(rays) if _looks_alike(ray, other)), len(rays))
            if k == len(rays):
                rays.append(ray)
                found.append(self._whole(ray, trainer))
            found[k] = replace(found[k], name=name, history=history)
        return found

    def _whole(self, ray: Inspect, trainer: Trainer) -> Opened:
        if ray is self._asked and self.opened is not None and self.opened_step >= 0 and self._pure:
            return self.opened
        return open_pixel(
            trainer.method, trainer.scene, ray.camera, ray.pixel, trainer.step_count, ray.point_t, ray.around
        )

    # ---- what is done ------------------------------------------------------------------------------------------------

    def record(self, trainer: Trainer) -> bool:
        """After a training step: take the records that are due. Whether there were any."""
        due = [pin for pin in self._pins.values() if pin.recorder.due(trainer.step_count)]
        for pin in due:
            self._open(pin, trainer)
        return bool(due)

    def draw(self, trainer: Trainer, training: bool) -> bool:
        """One piece; whether there was any to do. What was begun is finished, however old it becomes meanwhile."""
        if self._pieces is None and self._asked is not None and self._clock.due(trainer, training):
            self._clock.begin(trainer)
            self._pieces = self._look(self._asked, trainer)
        if self._pieces is not None:
            begin = time.monotonic()
            if next(self._pieces, True):
                self._pieces = None
            self._clock.worked(time.monotonic() - begin)
            return True
        for pin in sorted(self._pins.values(), key=lambda pin: pin.clock.ended):
            if pin.clock.due(trainer, training):
                self._open(pin, trainer)
                return True
        return False

    def _open(self, pin: _Pin, trainer: Trainer) -> None:
        pin.clock.begin(trainer)
        begin = time.monotonic()
        try:
            pin.ray = open_ray(trainer.method, trainer.scene, pin.command.camera, pin.command.pixel, trainer.step_count)
        except Exception:
            del self._pins[pin.command.id]  # reported once, not twice a second
            raise
        pin.clock.worked(time.monotonic() - begin)
        if pin.recorder.due(trainer.step_count):
            pin.recorder.add(pin.ray)

    def _look(self, asked: Inspect, trainer: Trainer) -> Iterator[None]:
        """The ray and all that is known of it, a piece at a time; training may go on between two of them."""
        step, self.opened_step = trainer.step_count, -1
        if self._witnesses is None or self._witnesses.scene is not trainer.scene:
            self._witnesses = Witnesses(trainer.scene)
        try:
            for opened in pieces(
                trainer.method, self._witnesses, asked.camera, asked.pixel, step, asked.point_t, asked.around
            ):
                self.opened = opened if self.opened is None else _with_older(opened, self.opened)
                yield
        except Exception:
            self._asked = self._pieces = None  # a ray that cannot be opened is reported once, not twice a second
            raise
        self.opened_step, self._waiting, self._pure = step, False, trainer.step_count == step


def _with_older(new: Opened, old: Opened) -> Opened:
    """What of the same ray is not known anew yet stays as it was: panels do not blink."""
    return Opened(*(getattr(new, f.name) or getattr(old, f.name) for f in fields(Opened)))


def _looks_alike(a: Inspect, b: Inspect) -> bool:
    """Whether they are one ray, be it that each came with a camera object of its own."""
    alike = a.camera.intrinsics() == b.camera.intrinsics() and np.array_equal(a.camera.c2w, b.camera.c2w)
    return alike and a.pixel == b.pixel


def _same_ray(a: Inspect, b: Inspect) -> bool:
    return a.camera is b.camera and a.pixel == b.pixel
