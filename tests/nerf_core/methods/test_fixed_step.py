"""The hash method's step on fixed shapes: what CUDA records is, on a CPU, held to the step that it stands for."""

from __future__ import annotations

import os
from dataclasses import replace
from unittest import mock

import pytest
import torch
from kernel_implementations import PLAIN, fast_packed
from pretended_cuda import FarTensor, Graph, Launches, pretended_cuda

from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.methods.hash import fixed_step
from nerf_core.methods.hash.fixed_step import FixedStep
from nerf_core.methods.hash.method import Hash
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.cells import Cells

CPU = torch.device("cpu")
SMALL = {"samples": "2000", "levels": "4", "log2_rows": "10", "cells": "16", "update_every": "4", "hidden": "16"}


def some(scene: Scene, count: int = 50) -> tuple[Rays, torch.Tensor, torch.Tensor]:
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    truth = torch.from_numpy(scene.images[0].reshape(-1, 3).astype("float32") / 65535)
    generator = torch.Generator().manual_seed(0)
    index = torch.randperm(len(rays), generator=generator)[:count]
    return rays[index], truth[index], torch.rand(count, generator=generator)


each_fast = pytest.mark.parametrize("kernels", fast_packed().values(), ids=fast_packed().keys())


def learnt(scene: Scene, kernels: PackedKernels, steps: int = 12) -> Hash:
    method = Hash(scene, Hash.configure(scene, "auto", SMALL, CPU), CPU, 0)
    for step in range(steps):
        rays, truth, _ = some(scene)
        method.train(rays, truth, step, None, lambda: None)
    method.optimizer.zero_grad(set_to_none=False)
    method.kernels = method.field.kernels = kernels
    return method


def gradients(method: Hash) -> list[torch.Tensor]:
    """Of the table and the networks, which are cleared."""
    found = [method.table_gradient.clone(), *(p.grad.clone() for p in method.field.networks() if p.grad is not None)]
    method.table_gradient.zero_()
    method.optimizer.zero_grad(set_to_none=False)
    return found


def fixed(method: Hash, rays: int, capacity: int) -> FixedStep:
    return FixedStep(
        method.field, method.kernels, method.occupancy.cells, rays, capacity, method.step_cells, method.length,
        method.background, method.table_gradient, lambda: None,
    )  # fmt: skip


def marched(method: Hash, rays: Rays, offsets: torch.Tensor) -> int:
    """Samples in front of, and behind, what ends the light."""
    boxed = method.space.rays(rays)
    return len(PLAIN.march(method.occupancy.cells, boxed, method.step_cells, offsets).t)


@each_fast
def test_its_gradients_are_the_steps_own(scene: Scene, kernels: PackedKernels) -> None:
    method = learnt(scene, kernels)
    rays, truth, offsets = some(scene)
    error, count = method._accumulate(rays, offsets, truth, 2 / truth.numel())
    wanted = gradients(method)
    assert count > 100
    step = fixed(method, len(rays), marched(method, rays, offsets) + 100)
    for _ in range(2):  # what lies in its tensors from a step before has no say in the next
        found = step(method.occupancy.cells, method.space.rays(rays), offsets, truth)
        assert found[0] == pytest.approx(error, rel=1e-3)
        # the plain step leaves out what lies in the dark, where transmittance is under 1e-3
        for mine, theirs in zip(gradients(method), wanted, strict=True):
            torch.testing.assert_close(mine, theirs, atol=2e-3 * float(theirs.abs().max()), rtol=0)


@each_fast
def test_rays_that_find_no_room_have_no_say(scene: Scene, kernels: PackedKernels) -> None:
    method = learnt(scene, kernels)
    rays, truth, offsets = some(scene)
    boxed, cells = method.space.rays(rays), method.occupancy.cells
    row_offsets = method.kernels.march(cells, boxed, method.step_cells, offsets).row_offsets
    whole = 30
    capacity = int(row_offsets[whole]) + 3
    assert int(row_offsets[whole + 1]) > capacity
    error, _ = fixed(method, len(rays), capacity)(cells, boxed, offsets, truth)
    mine = gradients(method)
    some_error, _ = method._accumulate(rays[:whole], offsets[:whole], truth[:whole], 2 / truth.numel())
    assert error == pytest.approx(some_error * len(rays) / whole, rel=1e-3)  # the others as if they were like these
    for one, other in zip(mine, gradients(method), strict=True):
        torch.testing.assert_close(one, other, atol=2e-3 * float(other.abs().max()), rtol=0)


@each_fast
def test_it_follows_the_occupancy(scene: Scene, kernels: PackedKernels) -> None:
    method = learnt(scene, kernels)
    rays, truth, offsets = some(scene)
    step = fixed(method, len(rays), marched(method, rays, offsets) + 100)
    _, before = step(method.occupancy.cells, method.space.rays(rays), offsets, truth)
    fewer = method.occupancy.cells.occupied.clone()
    fewer[:8] = False
    cells = Cells.of(method.space.low, method.occupancy.cells.voxel, fewer, False)
    _, after = step(cells, method.space.rays(rays), offsets, truth)
    assert 0 < after < before


@pytest.mark.skipif(
    "triton" not in fast_packed(), reason="only Triton's kernels take fixed steps; test_triton.py runs this"
)
def test_with_triton_the_method_takes_fixed_steps_and_learns(scene: Scene) -> None:
    method = learnt(scene, fast_packed()["triton"], 0)
    method.config = replace(method.config, samples=600)
    count = method.draw(0).rays
    assert count & (count - 1) == 0
    rays, truth, _ = some(scene, count)
    losses = [method.train(rays, truth, step, None, lambda: None) for step in range(4)]
    assert method.fixed is not None
    assert len(method.fixed.rays) == count
    assert losses[-1] < 0.9 * losses[0]
    saved = {name: value.clone() for name, value in method.state().items()}
    method.load_state(saved)
    assert method.fixed is None  # what it recorded wrote to moments that are the optimiser's no more
    assert method.train(rays, truth, 4, None, lambda: None) < losses[0]


def test_out_of_memory_a_step_asks_for_half(scene: Scene) -> None:
    small = Hash(scene, Hash.configure(scene, "auto", SMALL, CPU), CPU, 0)
    assert not small.halve()  # 2,000 samples are few enough
    large = Hash(scene, Hash.configure(scene, "auto", SMALL | {"samples": "16384"}, CPU), CPU, 0)
    asked = large.draw(0).rays
    assert large.halve()
    assert large.draw(0).rays == asked // 2
    assert large.config.samples == 8192


def on_a_pretended_gpu(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, eager: int
) -> tuple[list[float], dict[str, torch.Tensor], int]:
    """Losses, state and number of recordings of four steps, of which the first `eager` are not recorded."""
    from nerf_core.kernels import triton_loops, triton_packed

    recordings: list[Graph] = []

    class Counted(Graph):
        def __init__(self) -> None:
            super().__init__()
            recordings.append(self)

    monkeypatch.setattr(triton_packed, "loops", Launches(triton_loops))
    monkeypatch.setattr(fixed_step, "EAGER", eager)
    with pretended_cuda(), mock.patch.object(torch.cuda, "CUDAGraph", Counted):
        changes = SMALL | {
            "samples": "300",
            "levels": "2",
            "log2_rows": "6",
            "cells": "8",
            "update_every": "2",
            "empty": "0.9",
        }
        trainer = Trainer(scene, RunSettings(method="hash", device="cuda", changes=changes))
        losses = [trainer.step().loss for _ in range(4)]
        triton_packed._resolutions.cache_clear()  # of tensors that lie on what was pretended
        state = {name: v.here if isinstance(v, FarTensor) else v for name, v in trainer.state().items()}
    return losses, {name: v.clone() for name, v in state.items()}, len(recordings)


@pytest.mark.skipif(os.environ.get("TRITON_INTERPRET") != "1", reason="test_triton.py runs it, interpreted")
def test_recorded_triton_kernels_do_what_they_did_step_by_step(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    losses, state, recordings = on_a_pretended_gpu(scene, monkeypatch, 1)
    wanted_losses, wanted, none = on_a_pretended_gpu(scene, monkeypatch, 1000)
    assert recordings
    assert not none
    assert losses == wanted_losses
    assert [name for name in wanted if not torch.equal(state[name], wanted[name])] == []
