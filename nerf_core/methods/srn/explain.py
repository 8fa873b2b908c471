"""The stages of one ray through a Scene Representation Network."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.language import marked, phrase
from nerf_core.common.text import number, triple
from nerf_core.geometry.rays import Rays
from nerf_core.methods.srn.model import SrnModel
from nerf_core.methods.stages import BarCode, Colors, Marks, Stage, Stems

NO_BINS = np.zeros(0, np.float32)


@torch.no_grad()
def explain(model: SrnModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages of the first ray: start, march, features of the found point and their colour."""
    found = model.found(rays[:1])
    t = (found.t[0] * model.unit).float().cpu().numpy()
    steps, origin, direction = np.diff(t), *(v[0].cpu().numpy() for v in (rays.origins, rays.directions))
    features = found.features[0].float().cpu().numpy()
    raw = found.color[0].float().cpu().numpy()
    count, width, hidden = len(steps), model.config.width, model.config.hidden
    return (
        Stage(
            marked("Start"),
            marked(
                "A scene representation network has no density σ, no transmittance T and no weights w: nothing along "
                "the ray is added up. It looks for one point of a surface, beginning at the same distance on every ray."
            ),
            (Marks(t[:1], NO_BINS),),
            ((marked("start"), number(float(t[0]))), ("x", triple(origin + t[0] * direction))),
        ),
        Stage(
            marked("March"),
            phrase(
                "At each point the network Φ gives {width} features. An LSTM, which remembers {hidden} numbers from "
                "step to step, turns them into the length of the next step. There are always {count} steps; one below "
                "0 goes back. The marcher has settled if the last step is short.",
                width=width,
                hidden=hidden,
                count=count,
            ),
            (Marks(t, NO_BINS), Stems(marked("step δ"), t[:-1], steps)),
            (
                (marked("steps back"), phrase("{count} of {total}", count=int((steps < 0).sum()), total=count)),
                (marked("last step"), number(float(steps[-1]))),
                (marked("found at"), number(float(t[-1]))),
            ),
        ),
        Stage(
            marked("Found point"),
            marked(
                "The last point is the surface that the network claims, whether there is one or not: the background is "
                "painted on such a point too. Here are its features Φ(x)."
            ),
            (BarCode(("Φ(x)",), (features,), float(np.abs(features).max())),),
            (
                ("x", triple(origin + t[-1] * direction)),
                (
                    marked("before the camera") if t[-1] >= 0 else marked("behind the camera"),
                    number(abs(float(t[-1]))),
                ),
                (
                    marked("features above 0"),
                    phrase("{count} of {total}", count=int((features > 0).sum()), total=len(features)),
                ),
            ),
        ),
        Stage(
            marked("Pixel generator"),
            phrase(
                "{count} more layers turn these features, and nothing else, into the colour. They are not told the "
                "direction: a point has one colour for all who see it.",
                count=len(model.network.generator),
            ),
            (Colors((marked("colour"),), raw[None].clip(0, 1)),),
            ((marked("colour"), triple(raw)),),
        ),
    )
