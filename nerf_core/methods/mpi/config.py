"""The constants of the multiplane images, and which captures they are for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from nerf_core.common.configs import changed, check_ranges, constant, restored
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.forward_facing import mean_camera, turned_away
from nerf_core.geometry.scene import Scene


@dataclass(frozen=True)
class MpiConfig:
    """Which multiplane images (MPIs) there are, how a plane sweep fills them, and how gradient descent refines them."""

    references: int = constant(
        6, marked("reference views: each has a multiplane image (MPI) of its own"), least=1, most=32
    )
    planes: int = constant(32, marked("planes of an MPI, evenly spaced in disparity"), least=2, most=128)
    shared: int = constant(4, marked("neighbouring planes that share one picture of colours"), least=1, most=256)
    resolution: int = constant(
        512,
        marked("most texels along the longer side of a photo: an MPI of a larger photo is shrunk"),
        least=8,
        most=4096,
    )
    margin: float = constant(0.05, marked("planes reach beyond their photo by this share of its side"), most=1)
    blended: int = constant(4, marked("nearest MPIs that are blended in a pixel"), least=1, most=64)
    falloff: float = constant(
        1.0, marked("how fast a blending weight falls with the distance of its view; 1: as in LLFF")
    )
    sweep_views: int = constant(5, marked("photos that the plane sweep of a new MPI compares"), least=2, most=64)
    sweep_window: int = constant(9, marked("side of the window in which it compares them, in texels"), least=1, most=99)
    sweep_softness: float = constant(
        0.005,
        marked("difference of colours by which one depth must fit better than another to be preferred e-fold"),
        least=1e-6,
    )
    rays: int = constant(16384, marked("rays per step"), least=1, most=2**22)
    rate_alpha: float = constant(0.01, marked("Adam's learning rate of opacity"))
    rate_color: float = constant(0.01, marked("Adam's learning rate of colour"))
    decay: float = constant(0.1, marked("what both rates fall to over the run, exponentially"), share="(0, 1]")
    smooth: float = constant(
        0.02, marked("weight of the planes' smoothness in opacity, against the squared error of a ray")
    )
    keep: float = constant(0.9, marked("Adam's beta1"), share="[0, 1)")
    keep_square: float = constant(0.99, marked("Adam's beta2"), share="[0, 1)")
    total_steps: int = constant(
        6000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> MpiConfig:
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method mpi has none but auto; change constants with --set")
        config = changed(MpiConfig(), changes, "mpi")
        obstacle = not_forward_facing(scene, config.train_images)
        if obstacle:
            raise UserError(
                f"method mpi needs a forward-facing capture: {obstacle}; take another method, such as --method voxels"
            )
        return config

    @staticmethod
    def restore(config: Mapping[str, Any]) -> MpiConfig:
        return restored(MpiConfig, config, "mpi")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def not_forward_facing(scene: Scene, train_images: int = 0) -> str:
    """Return why a scene is not forward-facing; empty if it is.

    It is if every ray of the training photos points to −z of their mean camera: the rule by which a capture can be
    trained in NDC. It is tested on the cameras, because NDC can be switched off.
    """
    cameras = [scene.views[i].camera for i in scene.trained(train_images)]
    if not cameras:
        raise UserError(f"{scene.name}: no training photos: every photo is held out")
    mean = mean_camera(np.stack([camera.c2w for camera in cameras]))
    if mean is None:
        return f"the {len(cameras)} training cameras have no mean direction of view"
    turned = turned_away(cameras, mean[:, 2])
    return f"{turned} of {len(cameras)} training cameras look away from their mean direction of view" if turned else ""
