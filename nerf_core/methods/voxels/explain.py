"""The stages of one ray through the voxel grid."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.language import listed, marked, phrase
from nerf_core.common.text import number
from nerf_core.geometry.rays import Rays
from nerf_core.methods.stages import (
    BarCode,
    Colors,
    Stage,
    absorption_stage,
    field_stage,
    nothing_stage,
    skipped_stage,
)
from nerf_core.methods.voxels.model import VoxelModel
from nerf_core.volume.voxel_grid import DENSITY, GLOSS, colors_of, view_basis


@torch.no_grad()
def explain(model: VoxelModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: skipped space, blending, colour, density, compositing."""
    samples = model.trace(rays).passes[0]
    count = 0 if samples.count is None else int(samples.count[0])
    skipped = skipped_stage(samples, model.grid, model.config.step)
    if not count:
        return skipped, nothing_stage()
    strongest = int(samples.weights[0].argmax())
    point = rays.origins + samples.t[:, strongest, None] * rays.directions
    cell, within = model.grid.cells_of(model.space.points(point))
    corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
    doublings, own, inside = model.grid.own(cell, within)
    weights = torch.where(corners == 1, inside, 1 - inside).prod(-1).numpy()
    index = model.grid.row_of(own + corners, doublings.expand(len(corners)))
    raw = torch.where(index >= 0, model.ema_rows[index.clamp(min=0), DENSITY], 0).numpy()
    row, d = model.ema_grid.interpolate(cell, within)[0], rays.directions
    basis = view_basis(d)[0].numpy()
    lobe = float((row[GLOSS] * d[0]).sum())
    coefficients = row[:DENSITY].view(3, 4).numpy()
    sign = "−" if model.config.bias < 0 else "+"
    softplus = "softplus(", number(float(row[DENSITY])), f" {sign} ", number(abs(model.config.bias)), ")"
    return (
        skipped,
        Stage(
            marked("Grid"),
            marked(
                "The heaviest sample lies in a cell whose 8 corners each hold a raw density s, coefficients of "
                "colour, and gloss. Corners count more the nearer the sample is to them."
            ),
            (BarCode((marked("blend"), "s"), (weights, raw), max(1.0, float(np.abs(raw).max()))),),
            ((marked("cell"), ", ".join(str(v) for v in cell[0].tolist())),
             (marked("density"), listed(softplus, ""))),
        ),
        Stage(
            marked("Colour"),
            marked(
                "Spherical harmonics of the direction, Y₀ and three Y₁, times the blended coefficients of a channel, "
                "and gloss, which is the same for all three. A sigmoid makes that a colour. Y₀ alone would be matt. "
                "The others let it change with the view, and gloss makes highlights."
            ),
            (BarCode(("Y(d)", marked("red"), marked("green"), marked("blue")), (basis, *coefficients),
                     float(np.abs(coefficients).max())),
             Colors((marked("towards this camera"),), colors_of(row, d).numpy())),
            ((marked("gloss"), f"(g · d)² = {number(lobe**2)}"),),
        ),
        field_stage(
            samples, phrase("The grid is looked up like this at all {count} samples; there is no network.", count=count)
        ),
        absorption_stage(samples),
    )  # fmt: skip
