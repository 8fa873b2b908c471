"""The stages of one ray through the nearest photo: which photo, where in it, and its colour."""

from __future__ import annotations

import numpy as np

from nerf_core.common.language import marked, phrase, phrases
from nerf_core.common.text import number, triple
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays
from nerf_core.methods.nearest_view.model import NearestViewModel
from nerf_core.methods.stages import Colors, Pictures, Stage

SIDE = 160  # most pixels of the picture's longer side
CANDIDATES = 3  # photos that are compared in numbers


def explain(model: NearestViewModel, rays: Rays) -> tuple[Stage, ...]:
    """Return the stages: the nearest photos with their distances, the ray's place in the first, and its colour."""
    looks = list(model.looks(rays))
    _, view, found = looks[-1]
    name = model.scene.views[view].name
    inside, place = bool(found.inside[0]), found.places[0]
    small = model.scene.photos.small(view, SIDE)
    scale = small.shape[1] / model.scene.views[view].camera.width
    mark = place * scale if inside else np.full(2, np.nan)
    where, colour = phrase("It misses the photo."), marked("Beside the photo there is only background.")
    if found.masked[0]:
        where, colour = phrase("It is masked there."), marked("The near photos are all masked here: a hole stays.")
    elif inside:
        colour = marked("The photo's pixel is the colour, as it is.")
        where = phrase("It falls on column {column:,}, row {row:,}.", column=int(place[0]), row=int(place[1]))
    return (
        _choice(model, *_shown(model, [view for _, view, _ in looks], bool(found.masked[0]))),
        Stage(
            marked("Place in the photo"),
            phrase(
                "The ray's direction in its own camera is drawn into the photo, with the photo's focal length and "
                "lens. {where}",
                where=where,
            ),
            (Pictures((name,), (small,), mark[None]),),
        ),
        Stage(
            marked("Colour"),
            colour,
            (Colors((marked("photo's pixel") if inside else marked("background"),), found.color),),
            ((marked("colour"), triple(found.color[0])),),
        ),
    )


def _shown(model: NearestViewModel, asked: list[int], hole: bool) -> tuple[str, bool]:
    """The photo that counts as nearest, and whether nearer ones are masked: of a hole the first of those asked."""
    return model.scene.views[asked[0 if hole else -1]].name, len(asked) > 1 and not hole


def _choice(model: NearestViewModel, name: str, passed: bool) -> Stage:
    """passed: whether nearer photos are masked where the ray falls."""
    photos = phrases("{n:,} training photo", "{n:,} training photos", len(model.views))
    if passed:
        return Stage(
            marked("Nearest photo"),
            phrase(
                "Of {photos}, {name} is the nearest that is not masked where the ray falls.", photos=photos, name=name
            ),
        )
    if model.faced is None:
        return Stage(
            marked("Nearest photo"),
            phrase(
                "Of {photos}, {name} was taken nearest to the ray's origin; of several from there, its optical axis is "
                "the nearest to the ray.",
                photos=photos,
                name=name,
            ),
        )
    nearest = model.ranking(model.faced)
    rows = tuple(
        (model.scene.views[int(nearest.views[k])].name, _distance(model.faced, nearest.distance[k], nearest.apart[k],
                                                                   nearest.aside[k]))
        for k in range(min(CANDIDATES, len(nearest.views)))
    )  # fmt: skip
    return Stage(
        marked("Nearest photo"),
        phrase(
            "Of {photos}, {name} was taken nearest to this camera. D² = (distance / ρ)² + angle², with ρ from the "
            "camera to the scene's centre: walking around the scene by an angle counts like turning by it.",
            photos=photos,
            name=name,
        ),
        rows=rows,
    )


def _distance(camera: Camera, distance: float, apart: float, aside: float) -> str:
    return phrase(
        "D {distance}: {apart} units, {aside:.1f}°",
        distance=number(float(distance), 3),
        apart=number(float(apart), 3),
        aside=np.degrees(aside),
    )
