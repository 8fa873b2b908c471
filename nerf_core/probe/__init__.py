"""Open a pixel: its ray, the radiance of a point on it, and what the training photos show of that point.

Everything is returned as plain arrays.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerf_core.probe.by_hand import (
        HandRay,
        HandTerms,
        hand_cdf,
        hand_ray_of,
        hand_terms,
        resample_by_weights,
        sampled_at,
        spread_evenly,
    )
    from nerf_core.probe.directions import DISC_SIZE, SPHERE_COLUMNS, SPHERE_ROWS, RadianceProbe, Source, disc_grid
    from nerf_core.probe.evidence import TrainingViews
    from nerf_core.probe.layers import layers_of
    from nerf_core.probe.opened import open_pixel
    from nerf_core.probe.radiance import open_radiance, view_dependence
    from nerf_core.probe.ray import open_ray
    from nerf_core.probe.records import Opened, PassProbe, RayHistory, RayProbe, Truth
    from nerf_core.probe.report import check_format, inspection, write_inspection
    from nerf_core.probe.sightings import FAR_DEGREES, Sightings, mean_emitted, unseen
    from nerf_core.probe.standing import Layer, Standing, Verdict
    from nerf_core.probe.verdict import judge
    from nerf_core.probe.walkthrough import truth_of, walk

# The module of each public name. A name is imported when it is asked for, so that the records load without torch.
_HOMES = {
    "by_hand": (
        "HandRay", "HandTerms", "hand_cdf", "hand_ray_of", "hand_terms", "resample_by_weights", "sampled_at",
        "spread_evenly",
    ),
    "directions": ("DISC_SIZE", "SPHERE_COLUMNS", "SPHERE_ROWS", "RadianceProbe", "Source", "disc_grid"),
    "evidence": ("TrainingViews",),
    "layers": ("layers_of",),
    "opened": ("open_pixel",),
    "radiance": ("open_radiance", "view_dependence"),
    "ray": ("open_ray",),
    "records": ("Opened", "PassProbe", "RayHistory", "RayProbe", "Truth"),
    "report": ("check_format", "inspection", "write_inspection"),
    "sightings": ("FAR_DEGREES", "Sightings", "mean_emitted", "unseen"),
    "standing": ("Layer", "Standing", "Verdict"),
    "verdict": ("judge",),
    "walkthrough": ("truth_of", "walk"),
}  # fmt: skip

__all__ = [
    "DISC_SIZE",
    "FAR_DEGREES",
    "SPHERE_COLUMNS",
    "SPHERE_ROWS",
    "HandRay",
    "HandTerms",
    "Layer",
    "Opened",
    "PassProbe",
    "RadianceProbe",
    "RayHistory",
    "RayProbe",
    "Sightings",
    "Source",
    "Standing",
    "TrainingViews",
    "Truth",
    "Verdict",
    "check_format",
    "disc_grid",
    "hand_cdf",
    "hand_ray_of",
    "hand_terms",
    "inspection",
    "judge",
    "layers_of",
    "mean_emitted",
    "open_pixel",
    "open_radiance",
    "open_ray",
    "resample_by_weights",
    "sampled_at",
    "spread_evenly",
    "truth_of",
    "unseen",
    "view_dependence",
    "walk",
    "write_inspection",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
