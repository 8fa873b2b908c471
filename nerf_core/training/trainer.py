"""One scene, one model, one step at a time: no input or output, no threads, no clock that decides anything."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nerf_core.common.device import pick_device, usable_cores
from nerf_core.common.errors import UserError, shorten
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Config, Method
from nerf_core.training.batches import PixelSampler
from nerf_core.training.loss_history import HistoryLog
from nerf_core.training.settings import RunSettings


def nothing() -> None:
    """The default yield callback."""


@dataclass(frozen=True)
class Report:
    """What a step did. loss: mean squared error of the batch; psnr: −10 log₁₀ of it, in dB; seconds: its duration.

    note: what the user should know of it; mostly nothing.
    """

    step: int
    loss: float
    psnr: float
    rays: int
    seconds: float
    note: str = ""


class Diverged(UserError):
    """The loss stopped being a number."""


class Trainer:
    """Owns the method and draws its batches.

    Everything that decides the weights (configuration, seed, thread count, chunk size, schedule) is fixed here and
    travels in `describe()`; a run is then bit-identical on one CPU, watched or not, saved and resumed or not.
    """

    def __init__(self, scene: Scene, settings: RunSettings) -> None:
        self.device = pick_device(settings.device)
        name, self.reason = choose_method(settings.method, self.device)
        config = METHODS.get(name).configure(scene, settings.preset, settings.changes, self.device)
        self._build(scene, name, config, settings.steps, settings.seed, settings.threads or usable_cores())

    @classmethod
    def resume(
        cls, scene: Scene, description: Mapping[str, Any], state: Mapping[str, Tensor], device: str = "auto"
    ) -> Trainer:
        """The trainer that `describe()` and `state()` came from. Raises UserError when it cannot be rebuilt here."""
        trainer = cls.__new__(cls)
        trainer.device, trainer.reason = pick_device(device), ""
        config = METHODS.get(description["method"]).restore(description["config"])
        # more threads than cores, as a checkpoint of a larger machine asks for, would spin against each other
        threads = min(description["threads"], usable_cores())
        trainer._build(scene, description["method"], config, description["steps"], description["seed"], threads)
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
        """The same run from its beginning."""
        trainer = Trainer.__new__(Trainer)
        trainer.device, trainer.reason = self.device, self.reason
        trainer._build(self.scene, self.method_name, self.config, self.steps, self.seed, self.threads)
        return trainer

    def _build(self, scene: Scene, name: str, config: Config, steps: int, seed: int, threads: int) -> None:
        torch.set_num_threads(max(threads, 1))  # some methods use the CPU on any device
        self.scene, self.method_name = scene, name
        self.steps, self.seed, self.threads = steps, seed, max(threads, 1)
        self.total_steps: int = steps or config.total_steps
        self.method: Method = METHODS.get(name)(scene, config, self.device, seed)
        self.device = self.method.device
        self.batches = PixelSampler(scene, config.train_images, self.device, seed)
        self.history = HistoryLog()
        self.step_count = 0
        self.seconds = 0.0

    @property
    def config(self) -> Config:
        """The method's configuration, as it now is."""
        return self.method.config

    def step(self, yield_callback: Callable[[], None] = nothing) -> Report:
        """One optimiser step. `yield_callback` runs between gradient chunks; its time is not counted as training.

        What `yield_callback` raises abandons the step: the state is what it was before. The notes on which cells were
        seen are an exception, since the same step takes them again later.
        Out of device memory, the step is tried again in chunks of half the size, as often as they can be halved.
        Raises Diverged when the loss is not finite, torch.OutOfMemoryError when chunks cannot be smaller.
        """
        waited, yielded = 0.0, False  # yielded: the callback is running, or has raised

        def timed_yield() -> None:
            nonlocal waited, yielded
            begin, yielded = time.perf_counter(), True
            yield_callback()
            waited, yielded = waited + time.perf_counter() - begin, False

        start, config = time.perf_counter(), self.config
        while True:
            try:
                with self.transaction():
                    rays, truth = self.batches.draw(self.method.draw(self.step_count))
                    loss = self.method.train(rays, truth, self.step_count, self.steps or None, timed_yield)
                break
            except torch.OutOfMemoryError:
                if yielded or not self.method.halve():  # smaller chunks do not help the callback
                    raise
            torch.cuda.empty_cache()  # outside the handler: its traceback holds the tensors that did not fit
        seconds = time.perf_counter() - start - waited
        self.seconds += seconds
        self.step_count += 1
        if not math.isfinite(loss):
            raise Diverged(
                f"step {self.step_count}: the loss is {loss}; lower the learning rate (--set learning_rate=…)"
            )
        self.history.add(self.step_count, loss)
        note = ""
        if self.config != config:
            note = f"out of device memory at step {self.step_count:,}: going on in chunks of half the size"
        return Report(self.step_count, loss, psnr_of(loss), len(rays), seconds, note)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """If the block raises, restore the random generators and call what the method's `undo` returned."""
        generators = self.batches.generator, *self.method.generators
        drawn = [generator.get_state() for generator in generators]
        undo = self.method.undo(self.step_count)
        try:
            yield
        except BaseException:
            for generator, state in zip(generators, drawn, strict=True):
                generator.set_state(state)
            undo()
            raise

    def frozen_method(self) -> Method:
        """The model as it is now, with weights of its own: training on does not change it."""
        return self.method.frozen()

    def describe(self) -> dict[str, Any]:
        """What a checkpoint stores beside the tensors, as JSON values."""
        return {
            "method": self.method_name,
            "config": self.config.to_json(),
            "steps": self.steps,
            "seed": self.seed,
            "threads": self.threads,
            "step": self.step_count,
            "seconds": self.seconds,
            "scene": self.scene.identity(),
            "scene_name": self.scene.name,
            "scene_summary": self.scene.summary(),
        }

    def state(self) -> dict[str, Tensor]:
        """All tensors that a resumed run needs, by name."""
        history = {name: torch.from_numpy(value) for name, value in self.history.state().items()}
        parts = {"method": self.method.state(), "batches": self.batches.state(), "history": history}
        return {f"{part}.{key}": value for part, tensors in parts.items() for key, value in tensors.items()}

    def notes(self, description: Mapping[str, Any]) -> tuple[str, ...]:
        """Warnings about a run that was resumed from `describe()`."""
        if self.threads == description["threads"] or self.device.type != "cpu":
            return ()
        return (
            f"begun on {description['threads']} threads, continued on the {self.threads} there are here: "
            "its weights will differ in rounding from an uninterrupted run's",
        )

    def go_to(self, description: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
        """Return to the step at which `describe()` and `state()` were taken."""
        parts = {
            part: {key.removeprefix(part): v for key, v in state.items() if key.startswith(part)}
            for part in ("method.", "batches.", "history.")
        }
        self.method.load_state(parts["method."])
        self.batches.load_state(parts["batches."])
        self.history.load_state({k: v.cpu().numpy() for k, v in parts["history."].items()}, description["step"])
        self.step_count, self.seconds = description["step"], description["seconds"]


def choose_method(asked: str, device: torch.device) -> tuple[str, str]:
    """The name in METHODS of what an option asks for; "auto" takes what is fast on the device, and says why."""
    if asked != "auto":
        return asked, ""
    if device.type == "cpu":
        return "voxels", "auto: it is the fast one on a CPU"
    return "hash", "auto: it is the fast one on a GPU"


def psnr_of(mse: float) -> float:
    """20 log₁₀(1/√MSE) in dB; 100 stands for a perfect picture, whose logarithm has no value."""
    return -10 * math.log10(mse) if mse > 1e-10 else 100.0
