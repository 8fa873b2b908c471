"""Check that a calibration fits its photo, and that a real lens could have it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase, phrases
from nerf_core.datasets.capture import Photo
from nerf_core.datasets.images import Header
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, FAR_OFF, FISHEYE

ASPECT_TOLERANCE = 0.02  # programs that shrink photos round each side to whole pixels
FOCAL_RANGE = (0.05, 100.0)  # in image sizes: fields of view between 169° and half a degree
FOLD_PIXELS = 0.5  # how far off a pixel may be after undistortion and distortion


def fitted(photo: Photo, header: Header) -> bool:
    """Return whether the photo must be rotated by its EXIF orientation to have the shape of its calibration.

    Of a calibration that says that it is of the upright photo, that is so. Otherwise the pixels as stored are tried
    first, because most tools calibrate those. Raises UserError if neither shape fits.
    """
    if photo.upright:
        return header.orientation != 1
    stated = photo.camera.width / photo.camera.height
    if abs(stated * header.height / header.width - 1) <= ASPECT_TOLERANCE:
        return False
    if header.orientation >= 5 and abs(stated * header.width / header.height - 1) <= ASPECT_TOLERANCE:
        return True
    raise UserError(
        f"{photo.path} is {header.width}×{header.height} pixels, but its calibration is for {photo.camera.width}×"
        f"{photo.camera.height}: give w and h of the photos that were calibrated, or those photos"
    )


def oddities(cameras: Sequence[Camera]) -> list[str]:
    """Return one warning for each kind of unusual calibration, with the number of photos that have it."""
    found: dict[str, list[float]] = {"focal": [], "principal": [], "fold": [], "blind": []}
    seen: dict[tuple[float, ...], list[tuple[str, float]]] = {}
    for camera in cameras:
        key = camera.intrinsics()
        if key not in seen:
            seen[key] = _odd(camera)
        for kind, value in seen[key]:
            found[kind].append(value)
    texts = {
        "focal": marked("{photos} with a focal length of {value:.3g} image sizes: check fl_x, w or camera_angle_x"),
        "principal": marked(
            "{photos} with a principal point {value:.3g} image sizes from the centre: check cx, cy, w and h"
        ),
        "fold": marked(
            "{photos} with lens coefficients that fold the image (a pixel is off by {value:.3g}): check k1, k2, k3, "
            "p1, p2"
        ),
        "blind": marked(
            "{photos} with corners beyond {value:.3g}° from the axis, where the fisheye lens shows nothing: they are "
            "not trained on; if they do show something, check k1 to k4"
        ),
    }
    return [
        phrase(texts[kind], photos=phrases("{n:,} photo", "{n:,} photos", len(values)), value=values[0])
        for kind, values in found.items()
        if values
    ]


def _odd(camera: Camera) -> list[tuple[str, float]]:
    odd: list[tuple[str, float]] = []
    focal = camera.fx / camera.width
    if (
        not FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1]
        or not FOCAL_RANGE[0] <= camera.fy / camera.width <= FOCAL_RANGE[1]
    ):
        odd.append(("focal", focal))
    shift = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if shift > 0.5:
        odd.append(("principal", shift))
    if camera.lens.bends:
        border = _border(camera)
        with np.errstate(all="ignore"):  # absurd coefficients overflow, and the result shows it
            if camera.lens.wide:
                back = camera.lens.see(camera.lens.directions(border)).bent
            else:
                back = camera.lens.distort(camera.lens.undistort(border))
            error = np.abs((back - border) * (camera.fx, camera.fy)).max()
        if camera.lens.kind == FISHEYE and not error <= FOLD_PIXELS:
            odd.append(("blind", float(np.degrees(camera.lens.angle(np.array([FAR_OFF]))[0]))))
        elif camera.lens.kind != EQUIRECTANGULAR and not error <= FOLD_PIXELS:
            odd.append(("fold", float(error)))
    return odd


def _border(camera: Camera) -> np.ndarray:
    """Image-plane points (P, 2) of pixels around the image's edge, where a lens folds first."""
    u = np.linspace(0, 1, 33)
    edges = [np.stack(np.broadcast_arrays(x, y), -1) for x, y in ((u, 0), (u, 1), (0, u), (1, u))]
    pixels = np.concatenate(edges) * (camera.width, camera.height)
    return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
