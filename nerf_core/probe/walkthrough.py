"""Follow one pixel through the whole method: camera, ray, the method's own stages, colour, photo and loss."""

from __future__ import annotations

import math

import numpy as np
import torch

from nerf_core.common.language import digits, figure, marked, phrase
from nerf_core.common.text import number, triple
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Explainable, Method, lacking
from nerf_core.methods.stages import Colors, Stage
from nerf_core.probe.records import PassProbe, RayProbe, Truth

SAME_POSE = 1e-9  # relative: a camera that flies to a photo ends at its pose, except for rounding


def truth_of(scene: Scene, camera: Camera, ray: RayProbe) -> Truth | None:
    """Return what a photo shows where the ray looks. It must have been taken with the pose of `camera`.

    Args:
        scene: the scene.
        camera: the camera that has the ray.
        ray: an opened ray.

    Returns:
        The first photo with this pose that has the ray in its frame and not masked; None if there is none.
    """
    apart = np.abs(scene.poses - camera.c2w).max((1, 2))
    for k in np.flatnonzero(apart <= SAME_POSE * max(1.0, float(np.abs(camera.c2w).max()))).tolist():
        view = scene.views[k]
        point = ray.origin.astype(np.float64) + ray.direction.astype(np.float64)
        (place,), (z,) = view.camera.project(point[None])
        width, height = view.camera.width, view.camera.height
        if z > 0 and 0 <= place[0] < width and 0 <= place[1] < height:  # false for NaN
            x, y = int(place[0]), int(place[1])
            if not scene.photos.counts(k, x, y):
                continue
            return Truth(k, (x, y), scene.photos.part(k, y, x) / np.float32(65535))
    return None


def walk(method: Method, scene: Scene, camera: Camera, ray: RayProbe) -> tuple[Stage, ...]:
    """Return the stages of a ray from the camera to the loss, with the ray's own values.

    Args:
        method: the model. Its own stages are shown if it is `Explainable`; else one stage says that it is not.
        scene: its scene. A photo and the loss are shown if a photo was taken with the pose of `camera`.
        camera: the camera that has the ray.
        ray: the opened ray.

    Returns:
        The stages in their order: camera and pixel, ray, the method's own, pixel, photo, loss.
    """
    o, d, near, far = (
        torch.as_tensor(v, dtype=torch.float32)[None] for v in (ray.origin, ray.direction, ray.near, ray.far)
    )
    return (
        _camera_stage(camera, ray),
        _ray_stage(ray),
        *_method_stages(method, Rays(o, d, near, far)),
        _pixel_stage(ray),
        *_photo_stages(scene, camera, ray),
    )


def _method_stages(method: Method, rays: Rays) -> tuple[Stage, ...]:
    if isinstance(method, Explainable):
        return method.explain(rays)
    name = METHODS.name_of(type(method))
    lacks = phrase("What happens between the ray and its pixel is not shown: {lacks}.", lacks=lacking(name, "explain"))
    return (Stage(marked("Method"), lacks),)


def _camera_stage(camera: Camera, ray: RayProbe) -> Stage:
    text, direction = _looks(camera, ray)
    return Stage(
        marked("Camera and pixel"),
        text,
        rows=(
            (marked("picture"), f"{figure(camera.width, ',')} × {figure(camera.height, ',')}"),
            (marked("pixel"), _place(ray.pixel)),
            ("fx, fy", phrase("{x}, {y} px", x=number(camera.fx), y=number(camera.fy))),
            *direction,
        ),
    )


def _looks(camera: Camera, ray: RayProbe) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Say how the camera's lens makes a direction of the ray's pixel, and the numbers on the way."""
    column, row = ray.pixel
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    straight = ray.direction @ camera.c2w[:, :3]
    lens, before = camera.lens, marked("before the camera")
    on_sensor = (marked("on the sensor"), f"{number(x)}, {number(y)}")
    if lens.kind == EQUIRECTANGULAR:
        return marked(
            "The pixel's centre (i + ½, j + ½), less the principal point and over the focal length, is longitude and "
            "latitude (downwards) in a picture of everything around."
        ), (on_sensor, (before, triple(straight)))
    if lens.kind == FISHEYE:
        angle = math.degrees(math.acos(min(1.0, max(-1.0, float(-straight[2])))))
        aside = (marked("angle to the optical axis"), f"{figure(angle, '.1f')}°")
        return marked(
            "The pixel's centre (i + ½, j + ½), less the principal point and over the focal length, is a place on the "
            "sensor of a fisheye lens. Its distance from the middle tells the angle to the optical axis."
        ), (on_sensor, aside, (before, triple(straight)))
    plane = (before, triple(np.array([x, -y, -1.0])))
    if lens.bends:
        return marked(
            "The pixel's centre (i + ½, j + ½), less the principal point and over the focal length, is a direction "
            "before the camera, once it is undone how the lens bends."
        ), (plane, (marked("with the lens undone"), triple(straight / -straight[2])))
    return marked(
        "The pixel's centre (i + ½, j + ½), less the principal point and over the focal length, is a direction "
        "before the camera."
    ), (plane,)


def _ray_stage(ray: RayProbe) -> Stage:
    return Stage(
        marked("Ray"),
        marked(
            "Turned into the world and made unit, the direction d and the camera's place o make the ray x(t) = o + t d."
        ),
        rows=(
            ("o", triple(ray.origin)), ("d", triple(ray.direction)),
            ("t", f"{number(ray.near)} … {number(ray.far)}"),
        ),
    )  # fmt: skip


def _pixel_stage(ray: RayProbe) -> Stage:
    if not ray.passes:
        return Stage(
            marked("Pixel"),
            marked("The method gives the colour as it is: nothing is composited, and no background shines through."),
            (Colors((marked("pixel"),), ray.color[None]),),
            ((marked("pixel"), triple(ray.color)),),
        )
    last = ray.last
    seen = last.weights @ last.rgb if len(last.t) else np.zeros(3)
    return Stage(
        marked("Pixel"),
        marked(
            "The samples' colours, each times its weight, and the background times what is left, add up to the pixel."
        ),
        (Colors(("Σ w c", marked("background × (1 − Σ w)"), marked("pixel")),
                np.stack([seen, (1 - ray.opacity) * ray.background, ray.color])),),
        ((marked("pixel"), triple(ray.color)), (marked("opacity Σ w"), number(ray.opacity))),
    )  # fmt: skip


def _photo_stages(scene: Scene, camera: Camera, ray: RayProbe) -> tuple[Stage, ...]:
    truth = truth_of(scene, camera, ray)
    if truth is None:
        return (
            Stage(
                marked("Photo"),
                marked(
                    "No photo was taken from here, so nothing says what this pixel should be. Fly to a photo (→) and "
                    "open a ray there to see the photo's colour and the loss."
                ),
            ),
        )
    view = scene.views[truth.view]
    split = next((name for name, indices in scene.splits.items() if truth.view in indices), "no")
    learnt = phrase("Training has seen it.") if split == "train" else phrase("Training never sees it.")
    # Of the earlier passes only `coarse` has a loss; the guide is already trained.
    losses = [(p.name, _composited(ray, p)) for p in ray.passes if p.name == "coarse" or p is ray.last]
    losses = losses or [(marked("pixel"), ray.color)]
    sentence = marked("The squared difference, averaged over the channels, is this pixel's part of the loss.")
    if ray.passes:
        sentence = marked(
            "The squared difference, averaged over the channels, is this pixel's part of the loss; its gradient flows "
            "back to every sample's density and colour, but not to where the samples lie."
        )
    if len(losses) > 1:
        sentence = phrase("{sentence} Both networks are supervised: their losses are added.", sentence=phrase(sentence))
    off = [(name, float(np.square(color - truth.color).mean())) for name, color in losses]
    return (
        Stage(
            marked("Photo"),
            phrase(
                "{name} ({split} photo) shows this at its pixel {place}. {learnt}",
                name=view.name,
                split=split,
                place=_place(truth.pixel),
                learnt=learnt,
            ),
            (Colors((marked("model"), marked("photo"), marked("difference")),
                    np.stack([ray.color, truth.color, np.abs(ray.color - truth.color)])),),
            ((marked("photo"), triple(truth.color)),),
        ),
        Stage(
            marked("Loss"),
            sentence,
            rows=tuple((name, number(value)) for name, value in off),
        ),
    )  # fmt: skip


def _place(pixel: tuple[int, int]) -> str:
    """Return a pixel's column and row as text."""
    return digits(", ".join(f"{v:,}" for v in pixel))


def _composited(ray: RayProbe, p: PassProbe) -> np.ndarray:
    if not len(p.t):
        return ray.background
    return p.weights @ p.rgb + (1 - p.weights.sum()) * ray.background
