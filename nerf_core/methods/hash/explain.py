"""The stages of one ray through the hash grid."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.language import marked, phrase
from nerf_core.geometry.rays import Rays
from nerf_core.methods.hash.model import HashModel
from nerf_core.methods.stages import BarCode, Stage, absorption_stage, field_stage, nothing_stage, skipped_stage
from nerf_core.volume.encodings import spherical_harmonics


@torch.no_grad()
def explain(model: HashModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: skipped space, hash grid, networks, density and colour, compositing."""
    samples = model.trace(rays).passes[0]
    skipped = skipped_stage(samples, model.occupancy.cells, model.step_cells)
    if samples.count is not None and not int(samples.count[0]):
        return skipped, nothing_stage()
    strongest = int(samples.weights[0].argmax())
    rays = rays.to(model.device)
    point = rays.origins + samples.t[:, strongest, None] * rays.directions
    features = model.ema_field.encode(model.unit_points(point))
    _, geometry = model.ema_field.geometry(features)
    resolutions = model.ema_field.levels.resolutions
    levels = features[0].view(len(resolutions), -1).cpu().numpy()
    vector, harmonics = geometry[0].cpu().numpy(), spherical_harmonics(rays.directions)[0].cpu().numpy()
    peak = max(float(np.abs(vector).max()), float(np.abs(harmonics).max()))
    return (
        skipped,
        Stage(
            marked("Hash grid"),
            phrase(
                "{count} grids, each finer than the one before, hold {numbers} numbers per corner; the finer ones "
                "share rows through a hash. Each level is blended within the heaviest sample's cell.",
                count=len(levels),
                numbers=levels.shape[1],
            ),
            (BarCode(tuple(f"{r}³" for r in resolutions), tuple(levels), float(np.abs(levels).max())),),
        ),
        Stage(
            marked("Networks"),
            marked(
                "A small network turns them into 16 numbers; the first is the logarithm of the density. A second "
                "network turns these and the spherical harmonics of the direction into colour."
            ),
            (BarCode((marked("geometry"), "Y(d)"), (vector, harmonics), peak),),
        ),
        field_stage(samples, marked("The same is done at every sample in an occupied cell.")),
        absorption_stage(samples),
    )
