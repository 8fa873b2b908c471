"""The stages of one ray through the multiplane images."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.language import marked, phrase
from nerf_core.common.text import number, triple
from nerf_core.geometry.rays import Rays, Samples
from nerf_core.methods.mpi.model import Blend, MpiModel
from nerf_core.methods.mpi.planes import BORDER, sharing
from nerf_core.methods.stages import Colors, Pictures, Stage, Stems, nothing_stage

HALF = 20  # texels on each side of the crossing that the picture of a plane shows


@torch.no_grad()
def explain(model: MpiModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: the nearest views, the planes of each of their MPIs, the blend, and all planes in order."""
    rays = rays.to(model.device)
    blend, passes = model.blend(rays), model.trace(rays).passes
    views = _views_stage(model, rays, blend)
    if not int(passes[-1].count[0]):  # pyright: ignore[reportOptionalSubscript]  plane_samples counts them
        return views, nothing_stage()
    stacks = [
        _planes_stage(model, blend, i, samples)
        for i, samples in enumerate(passes[:-1])
        if int(samples.count[0])  # pyright: ignore[reportOptionalSubscript]
    ]
    return views, *stacks, _blend_stage(model, blend), _merged_stage(passes[-1])


def _views_stage(model: MpiModel, rays: Rays, blend: Blend) -> Stage:
    beta = model.weights(rays.origins)[0].tolist()
    away = (model.positions - rays.origins[0]).norm(dim=-1).tolist()
    return Stage(
        marked("Nearest views"),
        phrase(
            "{stacks} of the photos have a multiplane image (MPI), a stack of {planes} planes. The ray is drawn from "
            "the {views} nearest ones. A view's weight β falls with its distance ℓ.",
            stacks=len(model.stacks),
            planes=model.config.planes,
            views=len(blend.views),
        ),
        rows=tuple((model.name(k), f"ℓ {number(away[k])}, β {number(beta[k])}") for k in blend.views),
    )


def _planes_stage(model: MpiModel, blend: Blend, i: int, samples: Samples) -> Stage:
    k, (t, alpha, weights) = blend.views[i], _numbers(samples, samples.t, samples.alpha, samples.weights)
    crossed = model.stacks[k].covers(blend.crossings[i].at[:, 0]).nonzero()[:, 0].tolist()
    images, marks = zip(*(_crop(model, k, plane, blend.crossings[i].at[plane, 0]) for plane in crossed), strict=True)
    return Stage(
        phrase("Planes of {view}", view=model.name(k)),
        marked(
            "The planes lie across this view's axis, evenly spaced in disparity. The ray looks each one up where it "
            "crosses it. A plane has a colour and an opacity α, not a density. Its weight w is α times what the planes "
            "in front of it let through."
        ),
        (Pictures(tuple(phrase("plane {number}", number=plane + 1) for plane in crossed), images, np.stack(marks)),
         Stems("α", t, alpha), Stems("w", t, weights)),
        (
            (marked("planes crossed"), phrase("{count} of {total}", count=len(crossed), total=model.config.planes)),
            ("Σ w", number(float(weights.sum()))),
        ),
    )  # fmt: skip


def _crop(model: MpiModel, k: int, plane: int, at: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return a plane's picture around a place as uint8 RGBA, and the place in it."""
    own = model.planes[k]
    alpha, color = own.alpha[plane], own.color[plane // sharing(len(own.alpha), len(own.color))]
    column, row = (int(v) for v in (at + BORDER).floor().tolist())
    left, top = max(0, column - HALF), max(0, row - HALF)
    part = slice(top, row + HALF + 1), slice(left, column + HALF + 1)
    rgba = torch.cat([color[:, *part], alpha[None, *part]]).permute(1, 2, 0)
    mark = at.cpu().numpy().astype(np.float64) + BORDER - (left, top)
    return (rgba.cpu().numpy() * 255 + 0.5).astype(np.uint8), mark


def _blend_stage(model: MpiModel, blend: Blend) -> Stage:
    opacity = torch.stack([seen.opacity[0] for seen in blend.seen])
    some = opacity > 0
    color = torch.stack([seen.color[:, 0] for seen in blend.seen]) / torch.where(some, opacity, 1)[:, None]
    names = [model.name(k) for k in blend.views]
    share = (blend.shares[:, 0] * opacity).tolist()
    rows = [
        (name, phrase("opacity A {opacity}, share {share}", opacity=number(a), share=number(s)))
        for name, a, s in zip(names, opacity.tolist(), share, strict=True)
    ]
    return Stage(
        marked("Blend"),
        marked(
            "Each MPI gives a colour C and an accumulated opacity A. They are blended with the weights β A: where an "
            "MPI holds nothing, the others fill in."
        ),
        (Colors((*names, marked("blended")), torch.cat([color, blend.color.T]).cpu().numpy()),),
        (*rows, (marked("blended"), triple(blend.color[:, 0].cpu().numpy()))),
    )


def _merged_stage(samples: Samples) -> Stage:
    t, alpha, transmittance, weights = _numbers(
        samples, samples.t, samples.alpha, samples.transmittance, samples.weights
    )
    return Stage(
        marked("All planes"),
        phrase(
            "The same colour as one line of {count} planes of all these MPIs, from front to back. W is a plane's "
            "weight in the blend, T = 1 − Σ W of the planes in front of it, and α = W / T.",
            count=len(t),
        ),
        (Stems("α", t, alpha), Stems("T", t, transmittance), Stems("W", t, weights)),
        (("Σ W", number(float(weights.sum()))),),
    )


def _numbers(samples: Samples, *values: torch.Tensor) -> list[np.ndarray]:
    """Return the values (R, S) of the first ray's samples without padding."""
    count = int(samples.count[0])  # pyright: ignore[reportOptionalSubscript]
    return [value[0, :count].cpu().numpy() for value in values]
