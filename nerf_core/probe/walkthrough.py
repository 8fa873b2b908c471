"""Follow one pixel through the whole method: camera, ray, the method's own stages, colour, photo and loss."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.common.text import number, triple
from nerf_core.geometry.camera import Camera
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
        The first photo with this pose that has the ray in its frame; None if there is none.
    """
    for k, view in enumerate(scene.views):
        if np.abs(view.camera.c2w - camera.c2w).max() > SAME_POSE * max(1.0, float(np.abs(camera.c2w).max())):
            continue
        point = ray.origin.astype(np.float64) + ray.direction.astype(np.float64)
        (place,), (z,) = view.camera.project(point[None])
        width, height = view.camera.width, view.camera.height
        if z > 0 and 0 <= place[0] < width and 0 <= place[1] < height:  # false for NaN
            x, y = int(place[0]), int(place[1])
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
    return (Stage("Method", f"What happens between the ray and its pixel is not shown: {lacking(name, 'explain')}."),)


def _camera_stage(camera: Camera, ray: RayProbe) -> Stage:
    column, row = ray.pixel
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    straight = ray.direction @ camera.c2w[:, :3]
    undone = (("with the lens undone", triple(straight / -straight[2])),) if camera.lens.bends else ()
    return Stage(
        "Camera and pixel",
        "The pixel's centre (i + ½, j + ½), less the principal point and over the focal length, is a direction before "
        "the camera" + (", once it is undone how the lens bends." if undone else "."),
        rows=(
            ("picture", f"{camera.width:,} × {camera.height:,}"),
            ("pixel", f"{column:,}, {row:,}"),
            ("fx, fy", f"{number(camera.fx)}, {number(camera.fy)} px"),
            ("before the camera", triple(np.array([x, -y, -1.0]))),
            *undone,
        ),
    )


def _ray_stage(ray: RayProbe) -> Stage:
    return Stage(
        "Ray",
        "Turned into the world and made unit, the direction d and the camera's place o make the ray x(t) = o + t d.",
        rows=(
            ("o", triple(ray.origin)), ("d", triple(ray.direction)),
            ("t", f"{number(ray.near)} … {number(ray.far)}"),
        ),
    )  # fmt: skip


def _pixel_stage(ray: RayProbe) -> Stage:
    if not ray.passes:
        return Stage(
            "Pixel",
            "The method gives the colour as it is: nothing is composited, and no background shines through.",
            (Colors(("pixel",), ray.color[None]),),
            (("pixel", triple(ray.color)),),
        )
    last = ray.last
    seen = last.weights @ last.rgb if len(last.t) else np.zeros(3)
    return Stage(
        "Pixel",
        "The samples' colours, each times its weight, and the background times what is left, add up to the pixel.",
        (Colors(("Σ w c", "background × (1 − Σ w)", "pixel"),
                np.stack([seen, (1 - ray.opacity) * ray.background, ray.color])),),
        (("pixel", triple(ray.color)), ("opacity Σ w", number(ray.opacity))),
    )  # fmt: skip


def _photo_stages(scene: Scene, camera: Camera, ray: RayProbe) -> tuple[Stage, ...]:
    truth = truth_of(scene, camera, ray)
    if truth is None:
        return (
            Stage(
                "Photo",
                "No photo was taken from here, so nothing says what this pixel should be. Fly to a photo (→) and open "
                "a ray there to see the photo's colour and the loss.",
            ),
        )
    view = scene.views[truth.view]
    split = next((name for name, indices in scene.splits.items() if truth.view in indices), "no")
    learnt = "Training has seen it." if split == "train" else "Training never sees it."
    # Of the earlier passes only `coarse` has a loss; the guide is already trained.
    losses = [(p.name, _composited(ray, p)) for p in ray.passes if p.name == "coarse" or p is ray.last]
    losses = losses or [("pixel", ray.color)]
    flows = "; its gradient flows back to every sample's density and colour, but not to where the samples lie."
    off = [(name, float(np.square(color - truth.color).mean())) for name, color in losses]
    return (
        Stage(
            "Photo",
            f"{view.name} ({split} photo) shows this at its pixel {truth.pixel[0]:,}, {truth.pixel[1]:,}. {learnt}",
            (Colors(("model", "photo", "difference"),
                    np.stack([ray.color, truth.color, np.abs(ray.color - truth.color)])),),
            (("photo", triple(truth.color)),),
        ),
        Stage(
            "Loss",
            "The squared difference, averaged over the channels, is this pixel's part of the loss"
            + (flows if ray.passes else ".")
            + (" Both networks are supervised: their losses are added." if len(off) > 1 else ""),
            rows=tuple((name, number(value)) for name, value in off),
        ),
    )  # fmt: skip


def _composited(ray: RayProbe, p: PassProbe) -> np.ndarray:
    if not len(p.t):
        return ray.background
    return p.weights @ p.rgb + (1 - p.weights.sum()) * ray.background
