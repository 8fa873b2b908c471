"""The stages of one ray through the decoded volume."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.language import figure, marked, phrase
from nerf_core.common.text import number, triple
from nerf_core.geometry.rays import Rays, Samples
from nerf_core.methods.neural_volumes.decoder import Volume
from nerf_core.methods.neural_volumes.model import NeuralVolumesModel
from nerf_core.methods.neural_volumes.warp import AffineWarp
from nerf_core.methods.stages import BarCode, Pictures, Stage, Stems, field_stage, nothing_stage

PLANES = (("x", (2, 1)), ("y", (2, 0)), ("z", (1, 0)))  # a slice's normal, and the axes along its height and width


@torch.no_grad()
def explain(model: NeuralVolumesModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: latent code, inverse warp, template, density and colour, additive opacity."""
    samples = model.trace(rays).passes[0]
    code = _code_stage(model)
    assert samples.count is not None
    if not int(samples.count[0]):
        return code, nothing_stage()
    strongest = int(samples.weights[0].argmax())
    rays = rays.to(model.device)
    u = model.cube(rays.origins + samples.t[:, strongest, None] * rays.directions).clamp(-1, 1)
    warp = () if model.volume.warp is None else (_warp_stage(model, u),)
    return (
        code,
        *warp,
        _template_stage(model.volume, u),
        field_stage(
            samples,
            marked(
                "The template is interpolated like this at all samples. It holds a colour, the same towards all sides, "
                "and σ, the opacity that a ray gains per unit of length."
            ),
        ),
        additive_stage(samples),
    )


def _code_stage(model: NeuralVolumesModel) -> Stage:
    code = model.shown.latent.detach().cpu().numpy()
    side, layers = model.config.template, len(model.shown.decoder.layers)
    return Stage(
        marked("Latent code"),
        phrase(
            "All of the volume is decoded from these numbers. The paper's encoder reads them from photos of a moment; "
            "here nothing moves, so they are learnt like weights. A fully connected layer and {layers} transposed "
            "convolutions, each of which doubles the side, make {side}³ voxels of them.",
            layers=layers,
            side=side,
        ),
        (BarCode(("z",), (code,), float(np.abs(code).max())),),
        (
            (marked("numbers"), figure(len(code), ",")),
            (marked("weights of the decoder"), figure(sum(p.numel() for p in model.parameters()), ",")),
        ),
    )


def _warp_stage(model: NeuralVolumesModel, u: Tensor) -> Stage:
    """The warp at a point u (1, 3) of the cube."""
    volume = model.volume
    moved = volume.moved(u)
    here, there = u[0].cpu().numpy(), moved[0].cpu().numpy()
    charts = [BarCode(("x", "W⁻¹(x)"), (here, there), max(1.0, float(np.abs(there).max())))]
    what = phrase("A field of displacements, decoded as a small volume of its own, is interpolated at the sample.")
    if isinstance(model.shown.warp, AffineWarp):
        shares = model.shown.warp.shares(model.shown.latent, u)[0].cpu().numpy()
        what = phrase(
            "{count} affine warps each scale, rotate and move the sample; the shares are how much each of them counts "
            "here.",
            count=len(shares),
        )
        charts.append(BarCode((marked("share"),), (shares,), float(shares.max())))
    return Stage(
        marked("Inverse warp"),
        phrase(
            "Before the template is looked up, the heaviest sample is moved. {what} So regions with detail get more of "
            "the template's voxels, and empty ones fewer.",
            what=what,
        ),
        tuple(charts),
        (
            (marked("x in the box"), triple(here)),
            (marked("in the template"), triple(there)),
            (marked("magnified there"), f"{number(magnification(volume, u))} ×"),
        ),
    )


def magnification(volume: Volume, u: Tensor) -> float:
    """How many times longer a short distance at u (1, 3) becomes in the template: |det ∂W⁻¹/∂u|^⅓ by differences."""
    if volume.warp is None:
        return 1.0
    h = 0.5 * 2 / (volume.warp.shape[-1] - 1)  # half a voxel of the warp, within which it is almost linear
    steps = h * torch.eye(3, device=u.device)
    jacobian = (volume.moved(u + steps) - volume.moved(u - steps)) / (2 * h)
    return float(jacobian.double().det().abs() ** (1 / 3))


def _template_stage(volume: Volume, u: Tensor) -> Stage:
    """Slices of the template through where a point u (1, 3) of the cube lies in it."""
    template = volume.template[0].cpu().numpy()  # (4, z, y, x)
    side = template.shape[-1]
    place = (volume.moved(u)[0].cpu().numpy() + 1) / 2 * (side - 1)  # x, y, z in voxels
    nearest = np.clip(np.round(place), 0, side - 1).astype(int)
    seen = np.clip(template[3] * 2 / (side - 1), 0, 1)  # opacity of one voxel
    rgba = np.concatenate([template[:3], seen[None]])
    images, marks = [], []
    for axis, (_, (up, across)) in enumerate(PLANES):
        cut = np.take(rgba, nearest[axis], axis=3 - axis)  # (4, height, width): the axes left are in the order z, y, x
        images.append((cut[:, ::-1].transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8))
        inside = 0 <= place[axis] <= side - 1
        marks.append((place[across] + 0.5, side - 0.5 - place[up]) if inside else (np.nan, np.nan))
    names = tuple(f"{name} = {index}" for (name, _), index in zip(PLANES, nearest, strict=True))
    color, opacity = volume.at(u)[1][0].cpu().numpy(), float(volume.at(u)[0])
    return Stage(
        marked("Template"),
        phrase(
            "Slices of the {side}³ voxels of colour and opacity through the place of the heaviest sample. Their 8 "
            "voxels around it are blended.",
            side=side,
        ),
        (Pictures(names, tuple(images), np.array(marks)),),
        (
            (marked("place in voxels"), triple(place)),
            (marked("colour"), triple(color)),
            (marked("opacity of a voxel's length"), number(opacity * 2 / (side - 1))),
        ),
    )


def additive_stage(samples: Samples) -> Stage:
    """Return the stage with the opacity that samples add to the first ray."""
    t, sigma, delta, transmittance, weights = (
        v[0].float().cpu().numpy()
        for v in (samples.t, samples.sigma, samples.delta, samples.transmittance, samples.weights)
    )
    total = float(weights.sum())
    full = np.flatnonzero(transmittance - weights <= 0)
    end = phrase("at {t}", t=number(float(t[full[0]]))) if len(full) else phrase("nowhere")
    return Stage(
        marked("Additive opacity"),
        marked(
            "Each sample adds its opacity σδ to the ray's opacity A, until that is 1; what it adds is its weight w. "
            "Fog in front of a surface therefore takes nothing from the surface before A is 1. In NeRF a sample takes "
            "a share of the light that is left, here a fixed amount. α in the tables is w as a share of what was left, "
            "1 − A."
        ),
        (Stems("σδ", t, sigma * delta), Stems("A", t, 1 - transmittance + weights), Stems("w", t, weights)),
        (
            ("Σ w", number(total)),
            (marked("A reaches 1"), end),
            (marked("left for what is behind"), number(max(0.0, 1 - total))),
        ),
    )
