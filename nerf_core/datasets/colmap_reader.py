"""A program that turns a COLMAP model into one .npz file: `python -P colmap_reader.py MODEL OUT`.

pycolmap runs in a separate process because it can crash or hang on damaged files, and because it installs its own
SIGTERM handler.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

PARAMETERS = 16  # the largest number of parameters of a camera model
LONG_TRACK = 3  # photos that see a point: if only two do, its depth is often wrong
LARGE_ERROR = 2.0  # pixels, the mean of a point's track; COLMAP drops single observations of more than 4
MOST_SIGHTINGS = 200_000  # by photos, of points evenly chosen: a second to read, and more than a loss needs


def main(model: str, out: str) -> None:
    """Write the id, camera model, size, parameters and world-to-camera pose (3, 4) of each registered image.

    The file also holds the sparse points (P, 3), the lengths of their tracks (P,), and sightings (S,) of those points
    that are reliable: the ids of the images, and the indices of the points that they see.
    """
    import pycolmap

    os.chdir(model)  # pycolmap takes no path that is not UTF-8
    reconstruction = pycolmap.Reconstruction(".")
    images = [image for image in reconstruction.images.values() if image.has_pose]
    cameras = [reconstruction.cameras[image.camera_id] for image in images]
    parameters = np.zeros((len(images), PARAMETERS))
    for row, camera in zip(parameters, cameras, strict=True):
        row[: len(camera.params)] = camera.params
    points = list(reconstruction.points3D.values())
    by, seen = _sightings(points, list(reconstruction.points3D.keys()))
    np.savez(
        Path(out),
        ids=np.array([image.image_id for image in images], dtype=np.int64),
        models=np.array([camera.model.name for camera in cameras], dtype=str),
        sizes=np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64).reshape(-1, 2),
        parameters=parameters,
        poses=np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        tracks=np.array([point.track.length() for point in points], dtype=np.int64),
        sighting_images=by,
        sighting_points=seen,
    )


def _sightings(points: list[Any], ids: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The image ids and point indices (S,) of reliable points, by the points' ids: pycolmap lists them in any order."""
    order = sorted(range(len(ids)), key=ids.__getitem__)
    good = [k for k in order if points[k].track.length() >= LONG_TRACK and points[k].error <= LARGE_ERROR]
    apart = 1 + sum(points[k].track.length() for k in good) // MOST_SIGHTINGS
    found = [(element.image_id, k) for k in good[::apart] for element in points[k].track.elements]
    by, seen = np.array(found, dtype=np.int64).reshape(-1, 2).T
    return by, seen


if __name__ == "__main__":
    main(*sys.argv[1:])
