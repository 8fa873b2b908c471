"""What the methods with the paper's networks explain alike."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.language import listed, marked, phrase
from nerf_core.common.text import triple
from nerf_core.geometry.rays import Rays, Samples
from nerf_core.methods.mlp.model import MlpModel
from nerf_core.methods.stages import BarCode, Stage


@torch.no_grad()
def code_stage(model: MlpModel, rays: Rays, samples: Samples) -> Stage:
    """Return the stage with the encoding γ of the first ray's heaviest sample, which is the input of the network."""
    strongest = int(samples.weights[0].argmax())
    point = (rays.origins + samples.t[:1, strongest, None].to(rays.origins) * rays.directions).to(model.device)
    x, field = model.network_points(point), model.final
    position = field.encode_positions(x)[0].float().cpu().numpy()
    direction = model.parametrise(rays.to(model.device)).encoded[0].float().cpu().numpy()
    codes = {"γ(x)": position, "γ(d)": direction} if model.config.view_directions else {"γ(x)": position}
    what = phrase("The network gets bare coordinates, without sines and cosines: near points look alike to it.")
    if model.config.position_frequencies:
        what = phrase(
            "The network does not get bare coordinates: γ adds sines and cosines of doubling frequency, so that near "
            "points look different to it."
        )
    here = phrase("Here the heaviest sample's place x; it gets no direction.")
    if model.config.view_directions:
        here = phrase("Here the heaviest sample's place x, and the direction d.")
    return Stage(
        marked("Encoding"),
        listed((what, here), " "),
        (BarCode(tuple(codes), tuple(codes.values()), max(float(np.abs(code).max()) for code in codes.values())),),
        (("x", triple(x[0].cpu().numpy())), (marked("numbers"), " + ".join(str(len(code)) for code in codes.values()))),
    )


def towards(model: MlpModel) -> str:
    """Return the words that say for whom the network's colours are, as a phrase."""
    return phrase("towards the camera") if model.config.view_directions else phrase("to all sides")
