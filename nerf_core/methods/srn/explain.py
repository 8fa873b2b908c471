"""The stages of one ray through a Scene Representation Network."""

from __future__ import annotations

from nerf_core.geometry.rays import Rays
from nerf_core.methods.srn.model import SrnModel
from nerf_core.methods.stages import Stage


def explain(model: SrnModel, rays: Rays) -> tuple[Stage, ...]:
    return ()
