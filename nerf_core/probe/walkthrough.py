"""One pixel followed through the whole method: camera, ray, the method's own stages, colour, photo, loss."""

from __future__ import annotations

import numpy as np
import torch

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS, Explainable, Method, lacking
from nerf_core.methods.stages import Colors, Stage, number, triple
from nerf_core.probe.records import PassProbe, RayProbe, Truth

SAME_POSE = 1e-9  # of a camera that was flown to a photo's: easing ends exactly there, but for rounding


def truth_of(scene: Scene, camera: Camera, ray: RayProbe) -> Truth | None:
    """The photo whose camera stands where `camera` does and looks the same way, where its frame holds the ray."""
    for k, view in enumerate(scene.views):
        if np.abs(view.camera.c2w - camera.c2w).max() > SAME_POSE * max(1.0, float(np.abs(camera.c2w).max())):
            continue
        point = ray.origin.astype(np.float64) + ray.direction.astype(np.float64)
        (place,), (z,) = view.camera.project(point[None])
        width, height = view.camera.width, view.camera.height
        if z > 0 and 0 <= place[0] < width and 0 <= place[1] < height:  # NaN is neither
            x, y = int(place[0]), int(place[1])
            return Truth(k, (x, y), scene.images[k][y, x] / np.float32(65535))
    return None


def walk(method: Method, scene: Scene, camera: Camera, ray: RayProbe) -> tuple[Stage, ...]:
    """The stages of `ray`, which `camera` looks along, from the camera to the loss."""
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
    last = ray.passes[-1]
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
    # of earlier passes only a coarse network is still supervised: a guide has learnt before
    losses = [(p.name, _composited(ray, p)) for p in ray.passes if p.name == "coarse" or p is ray.passes[-1]]
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
            "The squared difference, averaged over the channels, is this pixel's part of the loss; its gradient flows "
            "back to every sample's density and colour, but not to where the samples lie."
            + (" Both networks are supervised: their losses are added." if len(off) > 1 else ""),
            rows=tuple((name, number(value)) for name, value in off),
        ),
    )  # fmt: skip


def _composited(ray: RayProbe, p: PassProbe) -> np.ndarray:
    if not len(p.t):
        return ray.background
    return p.weights @ p.rgb + (1 - p.weights.sum()) * ray.background
