"""The stages of one ray through the guided method."""

from __future__ import annotations

import numpy as np

from nerf_core.common.language import marked, phrase
from nerf_core.geometry.rays import Rays
from nerf_core.methods.guided.model import GuidedModel
from nerf_core.methods.mlp.explain import code_stage, towards
from nerf_core.methods.stages import Marks, Stage, Stems, absorption_stage, field_stage, nothing_stage
from nerf_core.methods.voxels.explain import explain as explain_voxels


def explain(model: GuidedModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: proposal grid, placed samples, encoding, network, compositing; at first those of the grid."""
    if not model.ready:
        return explain_voxels(model.guide, rays)
    guide, fine = model.trace(rays).passes
    t, weights = (v[0].cpu().numpy() for v in (guide.t, guide.weights))
    count = 0 if fine.count is None else int(fine.count[0])
    found = (
        Stage(
            marked("The guide"),
            marked("A voxel grid was trained first: the proposal grid. Its weights say where the ray meets something."),
            (Stems(marked("proposal w"), t, weights),),
        ),
        Stage(
            marked("Placed samples"),
            phrase(
                "Samples that weigh more than {least:g} are kept, {count} of {total}. Only these go to the network; "
                "the paper's method would evaluate it at 256.",
                least=model.config.least,
                count=count,
                total=len(t),
            ),
            (Marks(fine.t[0, :count].cpu().numpy(), np.zeros(0, np.float32)),),
        ),
    )
    if not count:
        return (*found, nothing_stage())
    return (
        *found,
        code_stage(model, rays, fine),
        field_stage(
            fine,
            phrase("The paper's network gives each of them a density and a colour {towards}.", towards=towards(model)),
        ),
        absorption_stage(fine),
    )
