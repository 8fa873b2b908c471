"""The pinned rays of a run: kept open while training goes on, each with its history."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from nerf_core.common.errors import UserError
from nerf_core.common.names import printable
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.live.clock import RefreshClock
from nerf_core.live.messages import MOST_PINS, PIN_NAME_LENGTH, EditPin, Pin, PinRay
from nerf_core.probe import RayProbe, open_ray
from nerf_core.probe.history import HistoryRecorder
from nerf_core.training.trainer import Trainer


@dataclass
class _Kept:
    """The worker's side of a `Pin`."""

    id: int
    name: str
    color: int
    hidden: bool
    camera: Camera
    pixel: tuple[int, int]
    recorder: HistoryRecorder
    ray: RayProbe | None = None
    clock: RefreshClock = field(default_factory=RefreshClock)

    def shown(self) -> Pin:
        return Pin(self.id, self.name, self.color, self.hidden, self.camera, self.pixel, self.ray, self.recorder.view())


class Pins:
    """Owned by the worker thread. At most MOST_PINS, in the order in which they were pinned."""

    def __init__(self) -> None:
        self._pins: list[_Kept] = []
        self._named = 0  # the greatest n of a "ray n"

    def __iter__(self) -> Iterator[Pin]:
        return iter([pin.shown() for pin in self._pins])

    # ---- what is wanted ----------------------------------------------------------------------------------------------

    def add(self, wanted: PinRay, trainer: Trainer) -> None:
        """Keep a ray open. A ray that is pinned already stays as it is.

        Where all places are taken, one of the scene's own pins gives way, if it is still hidden.
        Raises UserError when there is none.
        """
        if any(pin.id == wanted.id for pin in self._pins):
            return
        if len(self._pins) >= MOST_PINS:
            spare = spare_pins(list(self), trainer.scene)
            if not spare:
                raise UserError(f"{MOST_PINS} rays are pinned already: remove one first")
            self.remove(spare[0].id)
        color = next(k for k in range(MOST_PINS) if k not in {pin.color for pin in self._pins})
        recorder = HistoryRecorder(trainer.step_count, trainer.total_steps)
        name = wanted.name or f"ray {self._named + 1}"
        self._pins.append(_Kept(wanted.id, name, color, wanted.hidden, wanted.camera, wanted.pixel, recorder))
        self._note_number(name)

    def add_landmarks(self, scene: Scene, trainer: Trainer) -> None:
        """Pin the scene's landmarks, hidden, so that their histories begin with training."""
        train = scene.split("train")
        if not train:
            return
        camera = scene.views[train[0]].camera
        for name, x, y in scene.landmarks:
            self.add(PinRay(camera, (int(x * camera.width), int(y * camera.height)), name, hidden=True), trainer)

    def edit(self, change: EditPin) -> None:
        """Rename, hide or show a pin. A name is cut to PIN_NAME_LENGTH characters. Unknown ids are ignored."""
        for pin in self._pins:
            if pin.id == change.id:
                pin.name = pin.name if change.name is None else printable(change.name)[:PIN_NAME_LENGTH]
                pin.hidden = pin.hidden if change.hidden is None else change.hidden

    def remove(self, number: int) -> None:
        """Unpin the ray with this id. Unknown ids are ignored."""
        self._pins = [pin for pin in self._pins if pin.id != number]

    def replace(self, pins: Sequence[Pin], trainer: Trainer) -> None:
        """Take the pins of a loaded checkpoint instead. Their histories go on. If it has none, the pins stay."""
        if not pins:
            return
        self._pins = []
        for pin in pins:
            if pin.history is None:
                recorder = HistoryRecorder(trainer.step_count, trainer.total_steps)
            else:
                recorder = HistoryRecorder.of(pin.history, trainer.step_count, trainer.total_steps)
            self._pins.append(_Kept(pin.id, pin.name, pin.color, pin.hidden, pin.camera, pin.pixel, recorder))
            self._note_number(pin.name)

    def _note_number(self, name: str) -> None:
        """No number is given twice, so that a name means one ray for as long as the scene is open."""
        word, _, number = name.partition(" ")
        if word == "ray" and number.isascii() and number.isdigit() and len(number) < 9:
            self._named = max(self._named, int(number))

    def forget(self) -> None:
        """Open every ray anew, because the model was exchanged."""
        for pin in self._pins:
            pin.clock.reset()

    def restart(self, trainer: Trainer) -> None:
        """Begin every history now, because another training begins."""
        self.forget()
        for pin in self._pins:
            pin.recorder = HistoryRecorder(trainer.step_count, trainer.total_steps)

    def rewind(self, step: int) -> None:
        """Forget the records after `step`, to which training went back."""
        self.forget()
        for pin in self._pins:
            pin.recorder.rewind(step)

    # ---- what is done ------------------------------------------------------------------------------------------------

    def record(self, trainer: Trainer) -> bool:
        """Take the records that are due after a training step; return whether there were any."""
        due = [pin for pin in self._pins if pin.recorder.due(trainer.step_count)]
        for pin in due:
            self._open(pin, trainer)
        return bool(due)

    def draw(self, trainer: Trainer, training: bool) -> bool:
        """Open the ray that waited longest, if one is due; return whether one was."""
        for pin in sorted(self._pins, key=lambda pin: pin.clock.ended):
            if pin.clock.due(trainer, training):
                self._open(pin, trainer)
                return True
        return False

    def _open(self, pin: _Kept, trainer: Trainer) -> None:
        pin.clock.begin(trainer)
        begin = time.monotonic()
        try:
            pin.ray = open_ray(trainer.method, trainer.scene, pin.camera, pin.pixel, trainer.step_count)
        except Exception:
            self.remove(pin.id)  # reported once, not twice a second
            raise
        pin.clock.worked(time.monotonic() - begin)
        if pin.recorder.due(trainer.step_count):
            pin.recorder.add(pin.ray)


def spare_pins(pins: Sequence[Pin], scene: Scene) -> list[Pin]:
    """The scene's own pins that are still hidden, the last first: they give way to those that a user wants."""
    names = {name for name, _, _ in scene.landmarks}
    return [pin for pin in reversed(pins) if pin.hidden and pin.name in names]
