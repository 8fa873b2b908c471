"""The stages of one ray through the paper's method."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays, Trace
from nerf_core.methods.mlp.model import MlpModel, Parametrised
from nerf_core.methods.stages import Marks, Stage, Stems, Transfer, absorption_stage, field_stage
from nerf_core.volume.sampling import cumulative, inverse_transform


class NerfStages(MlpModel):
    """`Explainable` for the paper's method."""

    disparity: bool

    def trace(self, rays: Rays) -> Trace:
        raise NotImplementedError

    def _coarse_u(self, p: Parametrised, random: bool) -> Tensor:
        raise NotImplementedError

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        passes = self.trace(rays).passes
        p, world = self.parametrise(rays.to(self.device)), partial(self._world_t, rays.to(self.device))
        u = self._coarse_u(p, random=False)
        edges = torch.cat([u[:, :1], (u[:, 1:] + u[:, :-1]) / 2, u[:, -1:]], 1)
        spacing = "1/t" if self.disparity and self.ndc is None else "t" if self.ndc is None else "disparity (NDC)"
        stages = [
            Stage(
                "Stratified samples",
                f"{u.shape[1]} depths, evenly spaced in {spacing}. In training each is drawn at random from its bin, "
                "so that in time every depth is sampled; for a picture they stay where they are here.",
                (Marks(world(u), world(edges)),),
            ),
            self.code_stage(rays, passes[0]),
            field_stage(passes[0], "The coarse network gives every sample a density and the colour that it "
                          f"emits {self.towards}."),
            absorption_stage(passes[0]),
        ]  # fmt: skip
        if len(passes) > 1:
            middle, weights = (u[:, 1:] + u[:, :-1]) / 2, passes[0].weights[:, 1:-1]
            count, cdf = self.config.fine_samples, cumulative(weights)[0].cpu().numpy()
            draws = inverse_transform(middle, weights, count, None)
            levels = np.linspace(0, 1, count, dtype=np.float32)
            stages += [
                Stage(
                    "Resampling",
                    f"The coarse weights, normalised to a PDF, place {count} more samples. Evenly spaced levels "
                    "(random in training) go through the inverse of its CDF; most fall where the CDF is steep.",
                    (
                        Stems("PDF, a bin's share", world((middle[:, 1:] + middle[:, :-1]) / 2), np.diff(cdf)),
                        Transfer(world(middle), cdf, levels, world(draws)),
                    ),
                ),
                field_stage(passes[1], "The fine network evaluates all samples, old and new.", "Fine density, colour"),
                absorption_stage(passes[1], "Fine α, T and w"),
            ]
        return tuple(stages)

    def _world_t(self, rays: Rays, u: Tensor) -> np.ndarray:
        t = u if self.ndc is None else self.ndc.world_t(rays.origins, rays.directions, u)
        return t[0].cpu().numpy()
