"""What tells one scene from another, for checkpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View


@pytest.fixture
def rounded_scene() -> Scene:
    c2w = np.hstack([np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0], [[0.0], [0.3], [4.0]]])
    camera = Camera(8, 8, 10.0, 10.0, 4.0, 4.0, c2w)
    photo = np.full((8, 8, 3), 257 * 9, np.uint16)
    return Scene(
        "balls", "blender", (View("a", camera),), Photos.of([photo]), {"train": (0,)}, 2.0, 6.0, (1.0, 1.0, 1.0),
        np.zeros(3), 4.0, np.array([0.0, 0.0, 1.0]), np.eye(4), ndc=Ndc(8, 8, 10.0, 1.0, 6.0),
    )  # fmt: skip


def moved(scene: Scene, by: float) -> Scene:
    """The scene with every number of its poses and bounds a little greater."""
    views = tuple(replace(v, camera=replace(v.camera, c2w=v.camera.c2w + by)) for v in scene.views)
    assert scene.ndc is not None
    return replace(scene, views=views, near=scene.near + by, ndc=replace(scene.ndc, far=scene.ndc.far - by))


def described(scene: Scene) -> dict[str, object]:
    return {
        "scene": scene.identity(),
        "scene_identity": 2,
        "scene_name": scene.name,
        "scene_summary": scene.summary(),
    }


def test_a_processors_rounding_makes_no_other_scene(rounded_scene: Scene) -> None:
    """OpenBLAS takes other kernels with AVX-512 than with AVX2, and the last digits of poses differ."""
    for by in (1e-15, -1e-15, 1e-12):
        other = moved(rounded_scene, by)
        assert other.is_of(described(rounded_scene))
        assert other.doubt(described(rounded_scene)) == ""


def test_another_pose_or_photo_makes_another_scene(rounded_scene: Scene) -> None:
    darker = replace(rounded_scene, photos=Photos.of([np.zeros((8, 8, 3), np.uint16)]))
    for other in (moved(rounded_scene, 1e-4), darker, replace(rounded_scene, splits={"test": (0,)})):
        assert not other.is_of(described(rounded_scene))


def test_an_older_checkpoint_is_taken_with_a_warning_where_its_hash_differs(rounded_scene: Scene) -> None:
    older = described(rounded_scene) | {"scene": "of exact numbers, on another processor"}
    del older["scene_identity"]
    assert rounded_scene.is_of(older)
    assert "its poses are not compared" in rounded_scene.doubt(older)
    assert not rounded_scene.is_of(older | {"scene_name": "cubes"})
    assert not rounded_scene.is_of(older | {"scene_summary": "photos of 9×9 pixels"})


def test_a_scene_is_printed_in_a_line() -> None:
    scene = load_scene(None, LoadOptions(downscale=8))
    assert repr(scene).startswith("Scene('demo', demo: photos of 25×25 pixels (")
    assert len(repr(scene)) < 200


def test_cameras_that_look_outwards_are_inside(scene: Scene) -> None:
    """The fixture's look at the middle; turned by half a turn about their own y axis, they look away from it."""
    back = np.diag([-1.0, 1.0, -1.0])
    turned = {i: np.column_stack([c2w[:, :3] @ back, c2w[:, 3]]) for i, c2w in enumerate(scene.poses)}
    assert not scene.from_inside
    assert scene.reposed(turned).from_inside
    assert not scene.reposed({0: turned[0]}).from_inside  # a single one that looks away
    assert not replace(scene.reposed(turned), ndc=Ndc(8, 8, 10.0, 1.0, 6.0)).from_inside
    assert not replace(scene, splits={}).from_inside
