"""The stages of one ray through the paper's method."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.language import marked, phrase
from nerf_core.geometry.rays import Rays
from nerf_core.methods.mlp.explain import code_stage, towards
from nerf_core.methods.nerf.model import NerfModel
from nerf_core.methods.stages import Marks, Stage, Stems, Transfer, absorption_stage, field_stage
from nerf_core.volume.sampling import cumulative, inverse_transform


def explain(model: NerfModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: samples, encoding, coarse network and compositing; resampling and the fine network."""
    passes = model.trace(rays).passes
    p, world = model.parametrise(rays.to(model.device)), partial(_world_t, model, rays.to(model.device))
    u = model.coarse_u(p)
    edges = torch.cat([u[:, :1], (u[:, 1:] + u[:, :-1]) / 2, u[:, -1:]], 1)
    spacing = (
        "1/t" if model.disparity and model.ndc is None else "t" if model.ndc is None else phrase("disparity (NDC)")
    )
    stages = [
        Stage(
            marked("Stratified samples"),
            phrase(
                "{count} depths, evenly spaced in {spacing}. In training each is drawn at random from its bin, so that "
                "in time every depth is sampled; for a picture they stay where they are here.",
                count=u.shape[1],
                spacing=spacing,
            ),
            (Marks(world(u), world(edges)),),
        ),
        code_stage(model, rays, passes[0]),
        field_stage(
            passes[0],
            phrase(
                "The coarse network gives every sample a density and the colour that it emits {towards}.",
                towards=towards(model),
            ),
        ),
        absorption_stage(passes[0]),
    ]  # fmt: skip
    if len(passes) > 1:
        middle, weights = (u[:, 1:] + u[:, :-1]) / 2, passes[0].weights[:, 1:-1]
        count, cdf = model.config.fine_samples, cumulative(weights)[0].cpu().numpy()
        draws = inverse_transform(middle, weights, count, None)
        levels = np.linspace(0, 1, count, dtype=np.float32)
        stages += [
            Stage(
                marked("Resampling"),
                phrase(
                    "The coarse weights, normalised to a PDF, place {count} more samples. Evenly spaced levels (random "
                    "in training) go through the inverse of its CDF; most fall where the CDF is steep.",
                    count=count,
                ),
                (
                    Stems(marked("PDF, a bin's share"), world((middle[:, 1:] + middle[:, :-1]) / 2), np.diff(cdf)),
                    Transfer(world(middle), cdf, levels, world(draws)),
                ),
            ),
            field_stage(
                passes[1],
                marked("The fine network evaluates all samples, old and new."),
                marked("Fine density, colour"),
            ),
            absorption_stage(passes[1], marked("Fine α, T and w")),
        ]
    return tuple(stages)


def _world_t(model: NerfModel, rays: Rays, u: Tensor) -> np.ndarray:
    """Return the world distances (S,) of the first ray's parameters u (R, S)."""
    t = u if model.ndc is None else model.ndc.world_t(rays.origins, rays.directions, u)
    return t[0].cpu().numpy()
