"""Every method on CUDA: on the GPU, or, where there is none, under the rules of a pretended one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from desk import PATIENCE, Desk, view_of
from fitting_scenes import fitting
from pretended_cuda import Graph, Rules, pretended_cuda, recorded

from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.implementations.on_triton import PackedOnTriton
from nerf_core.live.messages import ExportRays, Inspect, LoadCheckpoint, PinRay, SaveCheckpoint, StopInspecting, Train
from nerf_core.live.worker import Worker
from nerf_core.methods import METHODS, Radiant, Traceable
from nerf_core.probe import open_pixel
from nerf_core.rendering.modes import MODES, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

NETWORK = {"rays": "64", "depth": "2", "width": "16", "learning_rate": "0.003"}
SMALLER = {"chunk_rays": "512", "coarse_samples": "6", "fine_samples": "6", "depth": "2", "width": "16"}
SMALL = {
    "hash": {"samples": "2000", "levels": "4", "log2_rows": "10", "cells": "16", "hidden": "16", "pixels": "4"},
    "nerf": NETWORK | {"chunk_rays": "512", "coarse_samples": "8", "fine_samples": "8"},
    "mpi": {"references": "2", "planes": "8", "rays": "512"},
    "nerf-guided": NETWORK | {"guide_steps": "5", "precision": "bfloat16"},
    "srn": {"rays": "64", "march_steps": "4", "width": "32", "learning_rate": "0.003"},
    "rgba-grid": {"side": "16", "coarsest": "8", "level_steps": "4", "rays": "256", "update_every": "4"},
    # every step sees all pixels, so that its loss tells what has been learnt
    "neural-volumes": {
        "rays": "1280",
        "template": "8",
        "width": "16",
        "warps": "2",
        "warp_cells": "4",
        "learning_rate": "0.01",
    },
}


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if torch.cuda.is_available():
        yield
        return
    work = Worker._work

    def under_its_rules(worker: Worker) -> None:
        with Rules():
            work(worker)

    monkeypatch.setattr(Worker, "_work", under_its_rules)
    monkeypatch.setattr(PackedOnTriton, "obstacle", lambda: "pretended")  # test_fixed_step.py has the interpreted ones
    with pretended_cuda():
        yield


@pytest.fixture
def scene(request: pytest.FixtureRequest, scene: Scene, facing: Scene) -> Scene:
    """The ball seen from all around, or from one side for a method that refuses that."""
    return fitting(request, scene, facing)


@pytest.mark.thorough(30)
@pytest.mark.parametrize("name", METHODS.names())
def test_it_learns_draws_explains_and_goes_on_from_a_checkpoint(cuda: None, scene: Scene, name: str) -> None:
    trainer = Trainer(scene, RunSettings(method=name, device="cuda", changes=SMALL.get(name, {})))
    losses = [trainer.step().loss for _ in range(24)]
    if trainer.total_steps:
        assert np.mean(losses[-8:]) < np.mean(losses[:8])
    else:  # nothing is learnt
        assert max(losses) < 1e-12
    camera, model = scene.views[0].camera, trainer.frozen_method()
    if isinstance(model, Traceable):
        opened = open_pixel(model, scene, camera, (camera.width // 2, camera.height // 2), trainer.step_count)
        np.testing.assert_allclose(opened.ray.color, opened.ray.rendered_color, atol=1e-5)
        assert opened.verdict is not None
        assert opened.walk
    if isinstance(model, Traceable) and isinstance(model, Radiant):
        rays = camera_rays(camera, scene.near, scene.far)[:8]
        assert all(shaded(model, rays, model.trace(rays), mode).shape == (8, 3) for mode in MODES.names())

    for device in ("cuda", "cpu", "cuda"):  # from what a file holds
        state = {key: value.cpu() for key, value in trainer.state().items()}
        trainer = Trainer.resume(scene, trainer.describe(), state, device)
        assert trainer.step().loss < 2 * np.mean(losses[-8:])


def test_a_window_gets_pictures_rays_and_files(cuda: None, tiny: RunSettings, capture: Path, tmp_path: Path) -> None:
    desk = Desk(replace(tiny, device="cuda", changes=tiny.changes | SMALLER), capture)
    try:
        scene = desk.worker.snapshot().scene
        assert scene is not None
        camera = scene.views[0].camera
        desk.worker.request_view(view_of(scene, 1))
        desk.send(Inspect(camera, (8, 8)), PinRay(camera, (3, 9), id=1), Train(6))
        shown = desk.until(lambda s: s.step == 6 and s.opened_step == 6 and s.pins[0].ray is not None)
        assert shown.device == torch.cuda.get_device_name(0)
        desk.until(lambda s: s.preview is not None and s.preview.step == 6)
        desk.send(SaveCheckpoint(tmp_path / "run.safetensors"), ExportRays(tmp_path / "rays.npz"))
        desk.until(lambda _: (tmp_path / "rays.npz").exists())
        desk.send(Train(1), LoadCheckpoint(tmp_path / "run.safetensors"))
        desk.until_told("loaded run.safetensors: step 6")
        desk.send(StopInspecting())
        desk.until(lambda s: s.step == 6 and s.opened is None and s.status != "training")
        desk.trained(1)
        assert not [notice for notice in desk.heard if notice.level == "error"]
    finally:
        assert desk.worker.stop(PATIENCE)


def test_the_pretended_device_refuses_what_cuda_refuses() -> None:
    with pretended_cuda():
        far, near = torch.ones(3, device="cuda"), torch.ones(3)
        assert (far + 1).device.type == "cuda"
        assert (far.cpu() + near).tolist() == [2, 2, 2]
        for mixed in (lambda: far + near, lambda: near * far, lambda: torch.cat([far, near])):
            with pytest.raises(RuntimeError, match="same device"):
                mixed()
        for convert in (far.numpy, lambda: np.asarray(far)):
            with pytest.raises(TypeError, match="numpy"):
                convert()
        for copy in (far.to("cuda", copy=True), near.to("cpu", copy=True)):
            copy.zero_()
        assert far.tolist() == near.tolist() == [1, 1, 1]
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, device="cuda", generator=torch.Generator())
        for waits in (
            lambda: float(far[0]),
            lambda: far[far > 0],
            far.nonzero,
            far.cpu,
            lambda: near.to("cuda"),
            far.unique,
        ):
            with pytest.raises(RuntimeError, match="capturing"), recorded(Graph()):
                waits()


def test_a_pretended_graph_sees_what_its_tensors_hold_by_then() -> None:
    with pretended_cuda():
        given, total, share = torch.ones(3, device="cuda"), torch.zeros((), device="cuda"), 2.0
        graph = Graph()
        with recorded(graph):
            total.copy_((given * share).sum())
        graph.replay()
        assert float(total) == 6
        given.fill_(2)
        share = 5.0  # a number of Python's was recorded as it was
        graph.replay()
        assert float(total) == 12
