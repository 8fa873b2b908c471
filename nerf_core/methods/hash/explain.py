"""The hash method's stages of one ray."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.rays import Rays, Trace
from nerf_core.methods.hash.field import HashField
from nerf_core.methods.stages import BarCode, Stage, absorption_stage, field_stage, nothing_stage, skipped_stage
from nerf_core.volume.encodings import spherical_harmonics
from nerf_core.volume.occupancy import Occupancy


class HashStages:
    """`Explainable` for the hash method; the attributes are the method's."""

    device: torch.device
    occupancy: Occupancy
    step_cells: float
    shown: HashField

    def trace(self, rays: Rays) -> Trace:
        raise NotImplementedError

    def _unit(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    @torch.no_grad()
    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        samples = self.trace(rays).passes[0]
        skipped = skipped_stage(samples, self.occupancy.cells, self.step_cells)
        if samples.count is not None and not int(samples.count[0]):
            return skipped, nothing_stage()
        strongest = int(samples.weights[0].argmax())
        rays = rays.to(self.device)
        point = rays.origins + samples.t[:, strongest, None] * rays.directions
        features = self.shown.encode(self._unit(point))
        _, geometry = self.shown.geometry(features)
        resolutions = self.shown.levels.resolutions
        levels = features[0].view(len(resolutions), -1).cpu().numpy()
        vector, harmonics = geometry[0].cpu().numpy(), spherical_harmonics(rays.directions)[0].cpu().numpy()
        peak = max(float(np.abs(vector).max()), float(np.abs(harmonics).max()))
        return (
            skipped,
            Stage(
                "Hash grid",
                f"{len(levels)} grids, each finer than the last, hold {levels.shape[1]} numbers a corner; the finer "
                "ones share their rows by a hash. The heaviest sample's are blended within its cell on each level.",
                (BarCode(tuple(f"{r}³" for r in resolutions), tuple(levels), float(np.abs(levels).max())),),
            ),
            Stage(
                "Networks",
                "A small network turns them into 16 numbers, of which the first is the density's logarithm; a second "
                "one turns those and the direction's spherical harmonics into colour.",
                (BarCode(("geometry", "Y(d)"), (vector, harmonics), peak),),
            ),
            field_stage(samples, "The same at every sample that the occupancy grid let through."),
            absorption_stage(samples),
        )
