"""The stages of one ray through the RGBα grid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.language import figure, marked, phrase
from nerf_core.common.text import number, triple
from nerf_core.geometry.rays import Rays, Samples
from nerf_core.methods.rgba_grid.model import GridModel
from nerf_core.methods.rgba_grid.volume import ALPHA, RGB, RgbaVolume
from nerf_core.methods.stages import (
    BarCode,
    Colors,
    Pictures,
    Stage,
    Stems,
    absorption_stage,
    nothing_stage,
    skipped_stage,
)

LARGEST = 128  # most vertices along a side of a drawn slice: more would not show in the panel
CORNERS = torch.cartesian_prod(*[torch.arange(2)] * 3)


@torch.no_grad()
def explain(model: GridModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: skipped space, slices and the cell at the heaviest sample, opacities, compositing."""
    rays = rays[:1].to(model.device)
    samples = model.trace(rays).passes[0]
    skipped = skipped_stage(samples, model.cells, model.config.step)
    if samples.count is None or not int(samples.count[0]):
        return skipped, nothing_stage()
    strongest = int(samples.weights[0].argmax())
    point = rays.origins + samples.t[:, strongest, None] * rays.directions
    place = model.volume.unit(point)[0].cpu() * (model.volume.side - 1)
    crossed = float(model.volume.cells_crossed(model.volume.space.rays(rays), model.config.step)[0])
    return (
        skipped,
        _slices(model.volume, place),
        _cell(model.volume, place),
        _opacities(samples, crossed),
        absorption_stage(samples),
    )


def _slices(volume: RgbaVolume, place: Tensor) -> Stage:
    """The three slices of vertices nearest to a place (3,), which is counted in vertices."""
    n, nearest = volume.side, place.round().long().tolist()
    stride = -(-n // LARGEST)
    images, marks, names = [], [], []
    for axis in range(3):
        across, up = [a for a in range(3) if a != axis]
        rgba = torch.sigmoid(volume.logits.select(axis, nearest[axis])[::stride, ::stride]).cpu().numpy()
        image = (rgba * 255 + 0.5).astype(np.uint8).transpose(1, 0, 2)[::-1]  # the second axis points up
        images.append(np.ascontiguousarray(image))
        marks.append((float(place[across]) / stride + 0.5, image.shape[0] - 0.5 - float(place[up]) / stride))
        names.append(f"{'xyz'[axis]} = {nearest[axis]}")
    share = phrase(" Every {stride}th vertex is drawn.", stride=stride) if stride > 1 else ""
    return Stage(
        marked("Grid"),
        phrase(
            "The scene is a box of {n} × {n} × {n} vertices, each with a colour and an opacity. These are the slices "
            "nearest to the heaviest sample, across x, y and z.{share}",
            n=n,
            share=share,
        ),
        (Pictures(tuple(names), tuple(images), np.array(marks)),),
        (
            (marked("vertices"), figure(n**3, ",")),
            (marked("memory"), phrase("{size:,.4g} MB", size=volume.logits.nbytes / 1e6)),
        ),
    )


def _cell(volume: RgbaVolume, place: Tensor) -> Stage:
    """The eight vertices around a place (3,), and how they are blended."""
    cell = place.floor().long().clamp(0, volume.side - 2)
    within = place - cell
    weights = torch.where(CORNERS == 1, within, 1 - within).prod(-1)
    at = (cell + CORNERS).to(volume.logits.device)
    logits = volume.logits[at[:, 0], at[:, 1], at[:, 2]].cpu()
    blended = (weights[:, None] * logits).sum(0)
    corners, sample = torch.sigmoid(logits).numpy(), torch.sigmoid(blended).numpy()
    names = tuple("".join(str(bit) for bit in corner) for corner in CORNERS.tolist())
    return Stage(
        marked("Cell"),
        marked(
            "The heaviest sample lies in a cell with 8 vertices. They are blended trilinearly, as logits: the nearer a "
            "vertex, the more it counts. A sigmoid of the blend gives colour and opacity."
        ),
        (
            BarCode((marked("blend"), "α"), (weights.numpy(), corners[:, ALPHA]), 1.0),
            Colors((*names, marked("blended")), np.concatenate([corners[:, RGB], sample[None, RGB]])),
        ),
        (
            (marked("cell"), ", ".join(str(v) for v in cell.tolist())),
            (marked("α of a cell's length"), number(float(sample[ALPHA]))),
            (marked("colour"), triple(sample[RGB])),
        ),
    )


def _opacities(samples: Samples, crossed: float) -> Stage:
    """The opacities along the ray. crossed: δ/h, the length of a sample in cells."""
    t, alpha = samples.t[0].cpu().numpy(), samples.alpha[0].cpu().numpy()
    of_cell = 1 - (1 - alpha.astype(np.float64)) ** (1 / crossed)
    sigma = samples.sigma[0].cpu().numpy()
    return Stage(
        marked("Opacity and density"),
        phrase(
            "A grid's α is that of one cell's length h. A sample stands for δ = {crossed} h, so that its opacity is "
            "1 − (1 − α)^(δ/h). That is the law of a density σ = −ln(1 − α)/h.",
            crossed=number(crossed, 3),
        ),
        (Stems(marked("α of a cell"), t, of_cell), Stems("σ", t, sigma)),
        (("δ/h", number(crossed)), (marked("largest σ"), number(float(sigma.max())))),
    )
