"""Every method where there is a GPU: what other tests show on a CPU must at least run there, and learn."""

from __future__ import annotations

import pytest
import torch

from nerf_core.methods import METHODS
from nerf_core.probe import open_radiance, open_ray
from nerf_core.scene import Scene
from nerf_core.settings import RunSettings
from nerf_core.trainer import Trainer

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")


@pytest.mark.parametrize("name", METHODS.names())
def test_it_learns_draws_and_goes_on_from_a_checkpoint(scene: Scene, name: str) -> None:
    trainer = Trainer(scene, RunSettings(method=name, device="cuda"))
    losses = [trainer.step().loss for _ in range(60)]
    assert sum(losses[-10:]) < sum(losses[:10])
    camera = scene.views[0].camera
    ray = open_ray(trainer.method, scene, camera, (camera.width // 2, camera.height // 2), trainer.step_count)
    assert ray.color == pytest.approx(ray.rendered_color, abs=1e-3)
    assert open_radiance(trainer.method, scene, ray, camera.c2w[:, 1]).rgb.shape[1] == 3
    state = {key: value.clone() for key, value in trainer.state().items()}
    again = Trainer.resume(scene, trainer.describe(), state, "cuda")
    assert again.step().loss < 2 * sum(losses[-10:]) / 10
