"""The parts of a group's step add up to the step of one process with the whole batch. Threads stand for processes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import pytest
import torch
from kernel_implementations import fast_packed
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS
from nerf_core.methods.group import Group
from nerf_core.methods.hash.method import Hash
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

STEPS, SIZE = 8, 3
NERF = {
    "rays": 20, "coarse_samples": 8, "fine_samples": 8, "depth": 2, "width": 16, "chunk_rays": 16,
    "precision": "float32",
}  # fmt: skip
HASH = {"samples": 5000, "levels": 4, "log2_rows": 10, "cells": 16, "hidden": 16, "update_every": 3}
CASES = {
    "nerf": ("nerf", NERF, "rays"),
    "nerf with noise": ("nerf", NERF | {"density_noise": 1.0}, "rays"),
    "nerf without a fine network": ("nerf", NERF | {"fine_samples": 0, "density_noise": 1.0}, "rays"),
    "hash": ("hash", HASH, "samples"),
    "hash in fixed shapes": ("hash", HASH, "samples"),
}


class Thread(Group):
    """A process of a group whose members are threads of this one."""

    def __init__(self, rank: int, size: int, barrier: threading.Barrier, given: list[list[Tensor]]) -> None:
        self.rank, self.size, self._barrier, self._given = rank, size, barrier, given

    def add(self, tensors: Sequence[Tensor]) -> None:
        self._given[self.rank] = [tensor.clone() for tensor in tensors]
        self._barrier.wait()
        for i, tensor in enumerate(tensors):
            tensor.copy_(torch.stack([parts[i] for parts in self._given]).sum(0))
        self._barrier.wait()


def in_threads(work: Callable[[Group], None], size: int) -> None:
    """Call `work` with each member of a group, each in a thread of its own."""
    barrier, given, errors = threading.Barrier(size, timeout=100), [list[Tensor]()] * size, list[BaseException]()

    def run(rank: int) -> None:
        try:
            work(Thread(rank, size, barrier, given))
        except BaseException as error:
            errors.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(size)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def trainer_of(scene: Scene, case: str, processes: int = 1, group: Group | None = None) -> Trainer:
    """A trainer whose batch is that of so many processes."""
    method, changes, batch = CASES[case]
    changes = {name: str(value * processes if name == batch else value) for name, value in changes.items()}
    settings = RunSettings(method=method, preset="auto", changes=changes, steps=100, device="cpu", threads=1)
    trainer = Trainer(scene, settings, group) if group else Trainer(scene, settings)
    if case == "hash in fixed shapes":
        assert isinstance(trainer.method, Hash)
        kernels = copy(next(iter(fast_packed().values())))
        kernels.fixed_shapes = True  # as on CUDA
        trainer.method.kernels = trainer.method.field.kernels = kernels
    return trainer


@pytest.mark.parametrize("case", CASES)
def test_a_group_learns_like_one_process_with_the_batch_of_all(case: str, scene: Scene) -> None:
    size = 2 if "fixed" in case else SIZE  # fixed shapes have powers of two
    alone = trainer_of(scene, case, size)
    reports = [alone.step() for _ in range(STEPS)]
    members: dict[int, tuple[Trainer, list[float], list[int]]] = {}

    def work(group: Group) -> None:
        trainer = trainer_of(scene, case, 1, group)
        done = [trainer.step() for _ in range(STEPS)]
        members[group.rank] = trainer, [r.loss for r in done], [r.rays for r in done]

    in_threads(work, size)
    first = members[0][0].state()
    for trainer, losses, rays in members.values():
        assert rays == [report.rays for report in reports]
        assert losses == pytest.approx([report.loss for report in reports], rel=1e-5)
        state = trainer.state()
        assert [name for name in first if not torch.equal(first[name], state[name])] == []
    assert members[0][0].describe()["processes"] == size
    assert torch.equal(first["method.generator"], alone.state()["method.generator"])


def test_a_group_that_runs_out_of_memory_does_not_try_again(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = trainer_of(scene, "nerf", 1, Thread(0, 2, threading.Barrier(2), [[], []]))

    def full(*_: object) -> float:
        raise torch.OutOfMemoryError("full")

    monkeypatch.setattr(trainer.method, "train", full)
    before = trainer.config
    with pytest.raises(torch.OutOfMemoryError):
        trainer.step()
    assert trainer.config == before  # the chunks of the others would be larger


def test_only_methods_that_say_so_train_in_a_group(scene: Scene) -> None:
    able = {name for name in METHODS.names() if getattr(METHODS.get(name), "distributed", False)}
    assert able == {"hash", "nerf"}
    settings = RunSettings(method="voxels", device="cpu", threads=1)
    with pytest.raises(UserError, match=r"^method voxels trains in one process: torchrun works with hash and nerf$"):
        Trainer(scene, settings, Thread(0, 2, threading.Barrier(2), [[], []]))
    assert Trainer(scene, replace(settings, method="nerf"), Group()).group.size == 1


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_the_parts_of_a_batch_are_all_of_it(size: int) -> None:
    for count in (7, 8, 64):
        parts = [Thread(rank, size, threading.Barrier(size), []).part(count) for rank in range(size)]
        assert [ray for part in parts for ray in part] == list(range(count))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
