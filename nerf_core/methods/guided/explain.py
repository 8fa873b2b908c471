"""The stages of one ray through the guided method."""

from __future__ import annotations

import numpy as np

from nerf_core.geometry.rays import Rays, Trace
from nerf_core.methods.guided.config import GuidedConfig
from nerf_core.methods.mlp.model import MlpModel
from nerf_core.methods.stages import Marks, Stage, Stems, absorption_stage, field_stage, nothing_stage
from nerf_core.methods.voxels.explain import explain as explain_voxels
from nerf_core.methods.voxels.model import VoxelModel


class GuidedStages(MlpModel):
    """`Explainable` for the guided method."""

    config: GuidedConfig
    guide: VoxelModel

    @property
    def _ready(self) -> bool:
        raise NotImplementedError

    def trace(self, rays: Rays) -> Trace:
        raise NotImplementedError

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        if not self._ready:
            return explain_voxels(self.guide, rays)
        guide, fine = self.trace(rays).passes
        t, weights = (v[0].cpu().numpy() for v in (guide.t, guide.weights))
        count = 0 if fine.count is None else int(fine.count[0])
        found = (
            Stage(
                "The guide",
                "A voxel grid was trained first: the proposal grid. Its weights say where the ray meets something.",
                (Stems("proposal w", t, weights),),
            ),
            Stage(
                "Placed samples",
                f"Samples that weigh more than {self.config.least:g} are kept, {count} of {len(t)}. Only these go to "
                "the network; the paper's method would evaluate it at 256.",
                (Marks(fine.t[0, :count].cpu().numpy(), np.zeros(0, np.float32)),),
            ),
        )
        if not count:
            return (*found, nothing_stage())
        return (
            *found,
            self.code_stage(rays, fine),
            field_stage(fine, f"The paper's network gives each of them a density and a colour {self.towards}."),
            absorption_stage(fine),
        )
