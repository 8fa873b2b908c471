"""Train one model of one scene, step by step. Nothing here does input or output, or depends on the clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.configs import check_changes, check_preset, constants
from nerf_core.common.device import pick_device, usable_cores
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked, phrase
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Config, Distributed, Draw, Method, Posed
from nerf_core.methods.group import ALONE, Group
from nerf_core.training.batches import Batch, PixelSampler
from nerf_core.training.exposure import SHARE, Exposure
from nerf_core.training.loss_history import HistoryLog
from nerf_core.training.pose_records import PoseCorrections
from nerf_core.training.pose_refinement import Corrections, PoseRefinement
from nerf_core.training.settings import RunSettings

EXPOSURES = "auto", "on", "off"
ARRIVAL_SECONDS = 0.005  # between two looks whether a step's photos are read: a window wants a frame every 16 ms


def nothing() -> None:
    """The default yield callback."""


@dataclass(frozen=True)
class Report:
    """The outcome of one training step.

    step: the number of steps done, with this one.
    loss: the mean squared error of the batch.
    psnr: −10 log₁₀ of the loss, in dB.
    rays: the number of rays in the batch, of all processes together.
    seconds: the duration of the step, without the yield callback.
    note: a message for the user; mostly empty.
    """

    step: int
    loss: float
    psnr: float
    rays: int
    seconds: float
    note: str = ""


class Diverged(UserError):
    """The loss or the weights are not finite any more."""

    status = 1


class Trainer:
    """Owns the method and draws its batches. One thread uses it.

    Everything that decides the weights (configuration, seed, thread count, chunk size, schedule) is fixed here and is
    in `describe()`. So a run is bit-identical on one CPU, whether it is watched or not, resumed or not.

    capture: the scene as it was loaded.
    scene: the same with poses as they are corrected now.
    method: the model with its optimiser.
    method_name: its name in `METHODS`.
    device: where the method really runs.
    reason: why "auto" chose this method; empty if the method was named.
    group: the processes that train the model together.
    steps: the length of the schedule as it was asked for; 0: the method's own.
    total_steps: the length of the schedule; 0: the method has nothing to train, whatever `steps` says.
    step_count: the number of steps done.
    seconds: seconds of training steps, without yield callbacks.
    history: the loss so far. With `exposure`, it is that of the photos as they would be with the mean exposure.
    exposure: the exposures of the training photos; None: all photos are taken as they are.
    refinement: corrects the poses of the training photos; None: they stay as they are.
    """

    def __init__(self, scene: Scene, settings: RunSettings, group: Group = ALONE) -> None:
        """Make a new model of a scene. This also sets torch's number of threads, for the whole process.

        Args:
            scene: the scene.
            settings: method, preset, changes of constants, steps, seed, device and threads. `settings.load` is not
                used.
            group: the processes that train the model together.

        Raises:
            UserError: the device, the method, the preset or a constant does not exist, a constant's value is wrong, the
                scene has no training photos, or the method trains in one process.
        """
        self.device, self.group = pick_device(settings.device), group
        name, self.reason = choose_method(settings.method, self.device)
        told = scene.unsighted() if settings.refine_poses else scene
        config = METHODS.get(name).configure(told, settings.preset, settings.changes, self.device)
        self._build(scene, name, config, settings.steps, settings.seed, settings.threads or self._cores())
        if settings.exposure not in EXPOSURES:
            raise UserError(f"--exposure {shorten(settings.exposure)}: choose from {', '.join(EXPOSURES)}")
        if settings.exposure == "on":
            self._learn_exposure()
        if settings.refine_poses:
            self._refine_poses()

    @classmethod
    def resume(
        cls, scene: Scene, description: Mapping[str, Any], state: Mapping[str, Tensor], device: str = "auto",
        group: Group = ALONE,
    ) -> Trainer:  # fmt: skip
        """Rebuild the trainer of a checkpoint.

        Args:
            scene: the scene that it was trained on; compare `Scene.identity()` before.
            description: that of `describe()`.
            state: that of `state()`.
            device: "cpu", "cuda" or "cuda:N"; "auto" picks one. It may differ from the device before.
            group: the processes that go on together. They may be more or fewer than before.

        Raises:
            UserError: the checkpoint does not fit this version, the device does not exist, or the method trains in one
                process.
        """
        trainer = cls.__new__(cls)
        trainer.device, trainer.reason, trainer.group = pick_device(device), "", group
        config = METHODS.get(description["method"]).restore(description["config"])
        # A larger machine's checkpoint may ask for more threads than there are cores; they would slow each other down.
        threads = min(description["threads"], trainer._cores())
        trainer._build(scene, description["method"], config, description["steps"], description["seed"], threads)
        if description.get("exposure", False):  # checkpoints of earlier versions do not say
            trainer._learn_exposure()
        if description.get("refine_poses", False):
            trainer._refine_poses()
        try:
            trainer.go_to(description, state)
        except torch.OutOfMemoryError:  # a RuntimeError that says nothing about the checkpoint
            raise
        except (KeyError, RuntimeError, ValueError, TypeError, IndexError, OverflowError) as error:
            reason = shorten(" ".join(str(error).split()), 120)
            raise UserError(
                f"the checkpoint does not fit method {description['method']} ({reason}): made by another version"
            ) from None
        return trainer

    def restarted(self) -> Trainer:
        """Return a new trainer of the same run, at step 0."""
        trainer = Trainer.__new__(Trainer)
        trainer.device, trainer.reason, trainer.group = self.device, self.reason, self.group
        trainer._build(self.capture, self.method_name, self.config, self.steps, self.seed, self.threads)
        if self.exposure is not None:
            trainer._learn_exposure()
        if self.refinement is not None:
            trainer._refine_poses()
        return trainer

    def _cores(self) -> int:
        """The cores that this process may use, if the group's processes on this machine share them."""
        return max(1, usable_cores() // self.group.local)

    def _build(self, scene: Scene, name: str, config: Config, steps: int, seed: int, threads: int) -> None:
        torch.set_num_threads(max(threads, 1))  # some methods use the CPU on any device
        self.capture = self.scene = scene
        self.method_name = name
        self.steps, self.seed, self.threads = steps, seed, max(threads, 1)
        self.total_steps: int = config.total_steps and (steps or config.total_steps)
        self.method: Method = METHODS.get(name)(scene, config, self.device, seed)
        if self.group.size > 1:
            must_be_distributed(name)
            assert isinstance(self.method, Distributed)
            self.method.group = self.group
        self.device = self.method.device
        self.batches = PixelSampler(scene, config.train_images, self.device, seed)
        self.history = HistoryLog()
        self.exposure: Exposure | None = None
        self.refinement: PoseRefinement | None = None
        self.step_count = 0
        self.seconds = 0.0

    def _learn_exposure(self) -> None:
        """Learn exposures from the first step on. Raises UserError if the method has no use for them."""
        if isinstance(self.method, Posed) or not self.total_steps:
            raise UserError(f"--exposure on: method {self.method_name} learns no colours: take --exposure off")
        views = self.batches.views
        self.exposure = Exposure(views, np.array([-self.scene.views[i].camera.c2w[:, 2] for i in views]))

    def _refine_poses(self) -> None:
        """Correct poses from now on. Raises UserError if the method or the capture does not allow it."""
        if isinstance(self.method, Posed) or not self.total_steps:
            raise UserError(f"--refine-poses: method {self.method_name} cannot compare poses: choose another")
        if self.scene.photos.filling is not None:
            raise UserError(
                f"--refine-poses: {self.scene.name} has too many photos to compare all at once: leave the option out, "
                "or open a part of them"
            )
        if len(self.batches.views) < 2:
            raise UserError(
                f"--refine-poses: {self.scene.name} trains on one photo, which cannot tell that its pose is wrong: "
                "leave the option out"
            )
        self.refinement = PoseRefinement(self.scene, self.batches.views, self.seed)

    def _pose(self) -> None:
        """Take the corrected poses into the scene and the batches."""
        if self.refinement is not None:
            poses = dict(zip(self.refinement.views, self.refinement.poses, strict=True))
            self.scene = self.capture.reposed(poses)
            self.batches.repose(self.scene)

    @property
    def config(self) -> Config:
        """The method's configuration as it is now: the chunk size may have been halved."""
        return self.method.config

    @property
    def exposures(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Gains and offsets (3,) of the training photos by view; empty if they are not learnt."""
        if self.exposure is None:
            return {}
        rows = zip(self.exposure.gains.numpy(), self.exposure.offsets.numpy(), strict=True)
        return dict(zip(self.exposure.views, rows, strict=True))

    @property
    def corrections(self) -> PoseCorrections | None:
        """By how much the cameras of the training photos were moved; None if poses are not corrected."""
        return None if self.refinement is None else self.refinement.corrections()

    @property
    def advice(self) -> str:
        """What to do about a loss or weights that are not finite, in a few words."""
        rates = [name for name in constants(type(self.config)) if "rate" in name]
        ways = " or ".join(f"--set {name}=…" for name in rates)
        return f"lower the learning rate ({ways})" if ways else "take other constants (--set)"

    def step(self, yield_callback: Callable[[], None] = nothing) -> Report:
        """Do one optimiser step.

        With a large capture, it first waits until the photos of this step are read (`first_photos`). If device memory
        runs out, the step is tried again with chunks of half the size, as often as they can be halved.
        Several processes do not try again, because the others have not run out of theirs.

        Args:
            yield_callback: called between gradient chunks. Its time does not count as training. If it raises, the step
                is abandoned and the state is what it was before. Only the notes on which cells were seen remain; the
                same step takes them again later. Several processes end together between steps: there it must not raise.

        Returns:
            Loss, PSNR and duration of the step.

        Raises:
            Diverged: the loss is not finite.
            PhotosLost: the photos of a large capture cannot be read any more.
            torch.OutOfMemoryError: memory runs out and chunks cannot be smaller.
        """
        waited, yielded = 0.0, False  # yielded: whether the callback runs or has raised

        def timed_yield() -> None:
            nonlocal waited, yielded
            begin, yielded = time.perf_counter(), True
            yield_callback()
            waited, yielded = waited + time.perf_counter() - begin, False

        while not self.batches.arrived(self.step_count):
            yield_callback()
            time.sleep(ARRIVAL_SECONDS)
        start, config = time.perf_counter(), self.config
        while True:
            try:
                with self.transaction():
                    wanted = self.method.draw(self.step_count)
                    corrected = self._corrected(wanted, timed_yield)
                    part = self.group.part(wanted.rays)
                    loss = self._train(self.batches.batch(wanted, part, self.step_count), timed_yield)
                break
            except torch.OutOfMemoryError:
                # smaller chunks do not help the callback, and must be the same in all processes
                if yielded or self.group.size > 1 or not self.method.halve():
                    raise
            torch.cuda.empty_cache()  # not in the handler, where the traceback keeps the tensors alive
        if self.refinement is not None:
            self.refinement.trained(wanted.rays)
            if corrected is not None:
                before = self.refinement.poses
                self.refinement.take(corrected, self.group)
                if (self.refinement.poses != before).any():  # a new scene makes what was computed for the old one void
                    self._pose()
        seconds = time.perf_counter() - start - waited
        self.seconds += seconds
        self.step_count += 1
        if not math.isfinite(loss):
            raise Diverged(f"step {self.step_count}: the loss is {loss}; {self.advice}")
        self.history.add(self.step_count, loss)
        note = ""
        if self.config != config:
            note = phrase(
                "out of device memory at step {step:,}: going on in chunks of half the size", step=self.step_count
            )
        return Report(self.step_count, loss, psnr_of(loss), wanted.rays, seconds, note)

    def _corrected(self, wanted: Draw, yield_callback: Callable[[], None]) -> Corrections | None:
        """Return the poses after a round of corrections if one is due, with the model before the step."""
        refinement = self.refinement
        if refinement is None or not refinement.due(wanted.rays):
            return None
        if self.group.rank:  # the first process does it for all
            return refinement.now()
        return refinement.round(self.method, self._exposed, yield_callback)

    def _exposed(self, photo: int, colors: np.ndarray) -> np.ndarray:
        """Undo the exposure of a photo, a position in `batches.views`: colours (…, 3)."""
        if self.exposure is None:
            return colors
        gain, offset = (v[photo].numpy() for v in (self.exposure.gains, self.exposure.offsets))
        return ((colors - offset) / gain).clip(0, 1)

    def _train(self, batch: Batch, yield_callback: Callable[[], None]) -> float:
        """Let the method learn from a batch, and learn the exposures. Returns the loss."""
        rays, truth, photo = batch
        exposure, steps = self.exposure, self.steps or None
        if exposure is None:
            return self.method.train(rays, truth, self.step_count, steps, yield_callback)
        few, predicted = slice(-(-len(rays) // SHARE)), None
        if exposure.due(self.step_count):  # drawn before the step, which may be abandoned
            with torch.no_grad():
                predicted = self.method.render(rays[few]).color
        target = exposure.corrected(photo, truth)
        loss = self.method.train(rays, target, self.step_count, steps, yield_callback)
        if predicted is not None:
            exposure.learn(photo[few], predicted, truth[few], self.group)
        return loss

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """If the block raises, restore what is random and call what the method's `undo` returned."""
        pixels, generators = self.batches.state(), self.method.generators
        drawn = [generator.get_state() for generator in generators]
        undo = self.method.undo(self.step_count)
        try:
            yield
        except BaseException:
            self.batches.load_state(pixels)
            for generator, state in zip(generators, drawn, strict=True):
                generator.set_state(state)
            undo()
            raise

    def compare(self) -> None:
        """Raise UserError if the processes of the group do not all have the same run in the same state."""
        if self.group.size > 1:
            own = "threads", "seconds"  # they may differ: machines have different cores, and clocks of their own
            self.group.compare({k: v for k, v in self.describe().items() if k not in own}, self.state())

    def frozen_method(self) -> Method:
        """Return a copy of the model for pictures. Further training does not change it."""
        return self.method.frozen()

    def describe(self) -> dict[str, Any]:
        """Return what a checkpoint stores beside the tensors, as JSON values by name.

        These are the configuration, the progress, and what identifies the scene.
        """
        return {
            "method": self.method_name,
            "config": self.config.to_json(),
            "steps": self.steps,
            "seed": self.seed,
            "threads": self.threads,
            "processes": self.group.size,
            "exposure": self.exposure is not None,
            "refine_poses": self.refinement is not None,
            "step": self.step_count,
            "seconds": self.seconds,
            "scene": self.capture.identity(),
            "scene_identity": self.capture.identity_kind,
            "scene_name": self.capture.name,
            "scene_summary": self.capture.summary(),
        }

    def state(self) -> dict[str, Tensor]:
        """Return all tensors that a resumed run needs, by name: weights, optimiser, random state and loss history."""
        history = {name: torch.from_numpy(value) for name, value in self.history.state().items()}
        parts = {"method": self.method.state(), "batches": self.batches.state(), "history": history}
        if self.exposure is not None:
            parts["exposure"] = self.exposure.state()
        if self.refinement is not None:
            parts["poses"] = self.refinement.state()
        return {f"{part}.{key}": value for part, tensors in parts.items() for key, value in tensors.items()}

    def notes(self, description: Mapping[str, Any]) -> tuple[str, ...]:
        """Return warnings about a run that was resumed from a description, a line each."""
        notes = [self.capture.doubt(description)]
        if self.threads != description["threads"] and self.device.type == "cpu":
            notes.append(
                phrase(
                    "begun on {begun} threads, continued on the {threads} there are here: its weights will differ in "
                    "rounding from an uninterrupted run's",
                    begun=description["threads"],
                    threads=self.threads,
                )
            )
        begun = description.get("processes", 1)  # checkpoints of earlier versions do not say
        if begun != self.group.size:
            notes.append(
                phrase(
                    "begun with {begun}, continued with {processes} processes: a step has the rays of all of them, so "
                    "its weights will differ from an uninterrupted run's",
                    begun=begun,
                    processes=self.group.size,
                )
            )
        return tuple(filter(None, notes))

    def go_to(self, description: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
        """Return to the step at which a description and state were taken.

        Args:
            description: that of `describe()`, from a trainer of the same configuration.
            state: that of `state()`.

        Raises:
            KeyError, RuntimeError, ValueError, TypeError, IndexError, OverflowError: the state does not fit the method.
        """
        parts = {
            part: {key.removeprefix(part): v for key, v in state.items() if key.startswith(part)}
            for part in ("method.", "batches.", "history.", "exposure.", "poses.")
        }
        self.method.load_state(parts["method."])
        self.batches.load_state(parts["batches."])
        self.history.load_state({k: v.cpu().numpy() for k, v in parts["history."].items()}, description["step"])
        if self.exposure is not None:
            self.exposure.load_state(parts["exposure."])
        if self.refinement is not None:
            self.refinement.load_state(parts["poses."])
            self._pose()
        self.step_count, self.seconds = description["step"], description["seconds"]


def must_be_distributed(name: str) -> None:
    """Raise UserError if several processes cannot train the method called `name` together."""
    if not getattr(METHODS.get(name), "distributed", False):
        able = [one for one in METHODS.names() if getattr(METHODS.get(one), "distributed", False)]
        raise UserError(f"method {name} trains in one process: torchrun works with {' and '.join(able)}")


def choose_method(asked: str, device: torch.device) -> tuple[str, str]:
    """Choose the method that an option asks for.

    Args:
        asked: a name of `METHODS`; "auto" takes the fast method of the device.
        device: where the method will run.

    Returns:
        The method's name, and the reason for the choice if it was "auto", else empty.
    """
    if asked != "auto":
        return asked, ""
    if device.type == "cpu":
        return "voxels", marked("auto: it is the fast one on a CPU")
    return "hash", marked("auto: it is the fast one on a GPU")


def check_constants(settings: RunSettings) -> None:
    """Raise UserError for a preset or changes that the method of a new run does not take, before a scene is loaded."""
    method, _ = choose_method(settings.method, pick_device(settings.device))
    check_preset(METHODS.get(method).presets, settings.preset, method)
    check_changes(METHODS.get(method).constants, settings.changes, method)


def psnr_of(mse: float) -> float:
    """Return the PSNR of a mean squared error in dB: −10 log₁₀ MSE, at most 100, because 0 has no logarithm."""
    return -10 * math.log10(mse) if mse > 1e-10 else 100.0
