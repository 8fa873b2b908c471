"""The hash method beyond its kernels and its step: what it refuses, its batch size and its EMA."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods.hash.config import HashConfig
from nerf_core.methods.hash.method import Hash
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
SMALL = {"samples": "2000", "levels": "4", "log2_rows": "10", "cells": "16", "hidden": "16"}


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("occupied", torch.ones(2, 2, 2, dtype=torch.bool), ValueError),
        ("absorbed", torch.zeros(16, 16, 16, dtype=torch.float64), ValueError),
        ("table_mean", torch.zeros(4, 8, 4), ValueError),
        ("field.table", torch.zeros(4, 8, 4), RuntimeError),
        ("updates", torch.tensor(-1), ValueError),
        ("needed", torch.tensor(float("nan")), ValueError),
        ("needed", torch.tensor(0.0), ValueError),
    ],
)
def test_a_state_that_does_not_fit_is_refused(
    scene: Scene, name: str, value: torch.Tensor, error: type[Exception]
) -> None:
    method = Hash(scene, Hash.configure(scene, "auto", SMALL, CPU), CPU, 0)
    state = method.state()
    assert name in state
    with pytest.raises(error):
        method.load_state(state | {name: value})


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"features": "3"}, "--set features=3: must be 1, 2, 4 or 8"),
        ({"levels": "32", "features": "8", "log2_rows": "24"}, "4,294,967,296 numbers; at most 268,435,456"),
        ({"decay": "1"}, "--set decay=1.0: must lie between 0 and 1"),
    ],
)
def test_constants_that_no_machine_can_use_are_refused(scene: Scene, changes: dict[str, str], text: str) -> None:
    with pytest.raises(UserError) as caught:
        HashConfig.configure(scene, "auto", changes, CPU)
    assert text in str(caught.value)


@pytest.fixture
def make(scene: Scene) -> Callable[..., Trainer]:
    def build(**changes: str) -> Trainer:
        return Trainer(scene, RunSettings(method="hash", changes=SMALL | {"samples": "8192"} | changes, threads=1))

    return build


def full_once(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> None:
    """Let a method run out of memory the first time it is called."""
    calls, real = [], getattr(owner, name)

    def call(*args: object) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise torch.OutOfMemoryError("full")
        real(*args)

    monkeypatch.setattr(owner, name, call)


def test_a_step_without_memory_after_its_update_is_not_repeated(
    make: Callable[..., Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, plain = make(update_every="1"), make(update_every="1")
    method = trainer.method
    assert isinstance(method, Hash)
    cells = method.occupancy.cells
    full_once(monkeypatch, method.occupancy, "update")
    assert trainer.step().note == "out of device memory at step 1: going on in chunks of half the size"
    plain.step()
    assert (method.updates, method.config.samples) == (1, 4096)
    assert method.occupancy.cells is cells
    for own, other in zip(method.parameters(), plain.method.parameters(), strict=True):
        assert torch.equal(own, other)
    assert trainer.step().note == ""
    assert method.occupancy.cells is not cells


def test_a_step_without_memory_for_its_update_is_done_once(
    make: Callable[..., Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, plain = make(), make(samples="4096")
    assert isinstance(trainer.method, Hash)
    full_once(monkeypatch, trainer.method.kernels, "adam")
    assert trainer.step().note != ""
    plain.step()
    own, other = trainer.state(), plain.state()
    assert [name for name in own if not torch.equal(own[name], other[name])] == []


def test_fewer_samples_a_ray_make_more_rays_a_step(scene: Scene) -> None:
    trainer = Trainer(scene, RunSettings(method="hash", changes=SMALL | {"samples": "4000"}))
    method = trainer.method
    assert isinstance(method, Hash)
    before = method.samples_per_ray
    counts = [trainer.step().rays for _ in range(60)]
    assert method.samples_per_ray < before / 2
    assert counts[-1] > 1.5 * counts[0]
    assert method.draw(60).rays == int(max(4000 / method.samples_per_ray, 64))


def test_pictures_show_the_ema_of_every_fourth_steps_weights(scene: Scene) -> None:
    trainer = Trainer(scene, RunSettings(method="hash", changes=SMALL))
    method = trainer.method
    assert isinstance(method, Hash)
    ema = None
    for move in range(1, 44):
        for _ in range(4):
            trainer.step()
        now = [p.detach().double() for p in method.field.parameters()]
        rate = max(0.1, 4 / (3 + move))
        ema = now if ema is None else [m + rate * (n - m) for m, n in zip(ema, now, strict=True)]
    assert ema is not None
    for shown, expected in zip(method.ema_field.parameters(), ema, strict=True):
        torch.testing.assert_close(shown.double(), expected, rtol=1e-4, atol=1e-6)
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    before, frozen = method.render(rays).color, method.frozen()
    restored = Hash(scene, method.config, CPU, 1)
    restored.load_state(method.state())
    with torch.no_grad():
        for p in method.field.parameters():
            p.add_(1.0)
    assert torch.equal(method.render(rays).color, before)
    with torch.no_grad():
        for p in method.ema_field.parameters():
            p.add_(1.0)
    assert not torch.equal(method.render(rays).color, before)
    assert torch.equal(frozen.render(rays).color, before)
    assert torch.equal(restored.render(rays).color, before)
