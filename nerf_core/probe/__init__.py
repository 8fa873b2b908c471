"""A pixel, opened up as plain arrays: its ray, a point of it and all its directions, what the photos know of it."""

from nerf_core.probe.evidence import FAR_DEGREES, Sightings, Witnesses, diffuse_of, unseen
from nerf_core.probe.history import RayHistory
from nerf_core.probe.layers import Layer, layers_of
from nerf_core.probe.opened import Opened, open_pixel
from nerf_core.probe.radiance import (
    DISC_SIZE,
    SPHERE_COLUMNS,
    SPHERE_ROWS,
    RadianceProbe,
    disc_grid,
    open_radiance,
    view_dependence,
)
from nerf_core.probe.ray import PassProbe, RayProbe, open_ray
from nerf_core.probe.report import check_format, inspection, write_inspection
from nerf_core.probe.verdict import Standing, Verdict, judge
from nerf_core.probe.walk import Truth, truth_of, walk

__all__ = [
    "DISC_SIZE",
    "FAR_DEGREES",
    "SPHERE_COLUMNS",
    "SPHERE_ROWS",
    "Layer",
    "Opened",
    "PassProbe",
    "RadianceProbe",
    "RayHistory",
    "RayProbe",
    "Sightings",
    "Standing",
    "Truth",
    "Verdict",
    "Witnesses",
    "check_format",
    "diffuse_of",
    "disc_grid",
    "inspection",
    "judge",
    "layers_of",
    "open_pixel",
    "open_radiance",
    "open_ray",
    "truth_of",
    "unseen",
    "view_dependence",
    "walk",
    "write_inspection",
]
