"""The nearest photo: it is shown pixel for pixel, and the right one is chosen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.methods import METHODS
from nerf_core.methods.nearest_view.method import NearestView
from nerf_core.methods.stages import Pictures
from nerf_core.probe import open_pixel
from nerf_core.rendering.images import render_camera

BENT = Lens(k1=-0.12, k2=0.03, p1=0.004, p2=-0.003)


def method_of(scene: Scene, **changes: str) -> NearestView:
    kind = METHODS.get("nearest-view")
    config = kind.configure(scene, "auto", changes, torch.device("cpu"))
    method = kind(scene, config, torch.device("cpu"), 0)
    assert isinstance(method, NearestView)
    return method


def bent(scene: Scene) -> Scene:
    """The scene as a lens with distortion would have taken it; only the cameras say so."""
    views = tuple(View(v.name, replace(v.camera, lens=BENT, cx=v.camera.cx + 1.3)) for v in scene.views)
    return replace(scene, views=views)


def of_eight_bits(scene: Scene) -> Scene:
    noise = np.random.default_rng(0).integers(0, 256, (len(scene.views), 16, 16, 3), np.uint16)
    photos = Photos.empty([(16, 16)] * len(scene.views), eight_bits=True)
    for k, image in enumerate(noise):
        photos.put(k, image * 257)
    return replace(scene, photos=photos)


def of_noise(scene: Scene) -> Scene:
    rng = np.random.default_rng(1)
    return replace(scene, photos=Photos.of([rng.integers(0, 65536, (16, 16, 3), np.uint16) for _ in scene.views]))


@pytest.mark.parametrize("change", [of_noise, of_eight_bits, lambda scene: bent(of_noise(scene))])
def test_at_a_training_camera_the_picture_is_the_photo(scene: Scene, change: Callable[[Scene], Scene]) -> None:
    scene = change(scene)
    method = method_of(scene)
    for k in scene.split("train"):
        color, depth = render_camera(method, scene.views[k].camera, scene)
        np.testing.assert_array_equal(color, scene.images[k].astype(np.float32) / np.float32(65535))
        assert np.isnan(depth).all()
        rays = camera_rays(scene.views[k].camera, scene.near, scene.far)
        unfaced = method.render(rays)
        np.testing.assert_array_equal(unfaced.color.numpy().reshape(color.shape), color)
        assert (unfaced.opacity == 1).all()
        assert method.caption(scene.views[k].camera) == f"the training photo {k}.png, taken from here"


def at(x: float, y: float, z: float, towards: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    back = np.subtract((x, y, z), towards).astype(float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.6, 0.8], back)
    right /= np.linalg.norm(right)
    return Camera(16, 16, 20, 20, 8, 8, np.stack([right, np.cross(back, right), back, [x, y, z]], -1))


def standing(scene: Scene, *cameras: Camera) -> Scene:
    """A scene with these training cameras, whose photos are plain: the first 0.1, the second 0.2, …"""
    photos = Photos.of([np.full((16, 16, 3), 6553 * (k + 1), np.uint16) for k in range(len(cameras))])
    views = tuple(View(f"{k}.png", camera) for k, camera in enumerate(cameras))
    return replace(scene, views=views, photos=photos, splits={"train": tuple(range(len(cameras)))})


def test_a_step_around_the_scene_counts_like_a_turn(scene: Scene) -> None:
    """D² is known in closed form: 0.3 rad around at distance 4, against 0.4 rad turned on the spot."""
    here = at(4, 0, 0)
    around = at(4 * np.cos(0.3), 4 * np.sin(0.3), 0)
    turned = at(4, 0, 0, (4 - np.cos(0.4), np.sin(0.4), 0))
    ranking = method_of(standing(scene, turned, around)).ranking(here)
    assert ranking.views.tolist() == [0, 1]
    np.testing.assert_allclose(ranking.distance, [0.4, np.hypot(2 * np.sin(0.15), 0.3)], rtol=1e-12)
    np.testing.assert_allclose(ranking.apart, [0, 8 * np.sin(0.15)], atol=1e-12)
    np.testing.assert_allclose(ranking.aside, [0.4, 0.3], rtol=1e-12)
    caption = method_of(standing(scene, turned, around)).caption(here)
    assert caption == "the nearest training photo: 0.png (23° aside, 0 units away)"


def test_of_equally_near_photos_the_first_is_shown(scene: Scene) -> None:
    method = method_of(standing(scene, at(0, 4, 0), at(4, 0, 0), at(4, 0, 0)))
    assert method.facing(at(4, 0.1, 0)).photo == 1


def test_an_eye_at_the_centre_goes_by_distance(scene: Scene) -> None:
    method = method_of(standing(scene, at(3, 0, 0), at(0, 1, 0)))
    assert method.facing(at(0, 0, 0, (1, 0, 0))).photo == 1
    assert np.isfinite(method.ranking(at(0, 0, 0, (1, 0, 0))).distance).all()


def test_the_photo_turns_with_the_camera_and_ends_at_its_edges(scene: Scene) -> None:
    """Only the direction in the camera counts: a wider picture has the photo in its middle, and background around."""
    method = method_of(standing(scene, at(4, 0, 0), at(-4, 0, 0)))
    wide = replace(at(3, 0.5, 0.5), width=32, height=16, cx=16.0)
    faced = method.facing(wide)
    color, _ = render_camera(method, wide, scene)
    expected = np.ones((16, 32, 3), np.float32)
    expected[:, 8:24] = np.float32(6553) / np.float32(65535)
    np.testing.assert_array_equal(color, expected)
    opacity = faced.render(camera_rays(wide, 2.0, 6.0)).opacity.numpy().reshape(16, 32)
    np.testing.assert_array_equal(opacity, expected[..., 0] < 1)


def test_rays_without_a_camera_take_the_nearest_origin_then_the_nearest_look(scene: Scene) -> None:
    left, right = at(4, 0, 0, (4, -1, 0)), at(4, 0, 0, (4, 1, 0))
    method = method_of(standing(scene, at(0, 4, 0), left, right))
    rays = camera_rays(replace(right, c2w=right.c2w + 1e-7), 2.0, 6.0)
    np.testing.assert_allclose(method.render(rays).color, 3 * 6553 / 65535, rtol=1e-6)


def test_only_the_chosen_training_photos_are_shown(scene: Scene) -> None:
    method = method_of(scene, train_images="2")
    assert method.views.tolist() == [0, 4]
    assert {method.facing(view.camera).photo for view in scene.views} == {0, 4}
    with pytest.raises(UserError, match="no such constant; it has train_images"):
        method_of(scene, total_steps="5")
    with pytest.raises(UserError, match="--preset 'fast': method nearest-view has none but auto"):
        METHODS.get("nearest-view").configure(scene, "fast", {}, torch.device("cpu"))


def test_a_pixel_says_which_photo_it_is_of(scene: Scene) -> None:
    scene, method = of_noise(scene), method_of(of_noise(scene))
    opened = open_pixel(method, scene, scene.views[5].camera, (3, 12), 0)
    titles = {stage.title: stage for stage in opened.walk}
    choice, place, colour = (titles[name] for name in ("Nearest photo", "Place in the photo", "Colour"))
    assert len(choice.rows) == 3
    assert choice.rows[0][0] == "0.png"  # of two neighbours at the same angle the first
    assert "0.png was taken nearest" in choice.sentence
    (chart,) = place.charts
    assert isinstance(chart, Pictures)
    np.testing.assert_array_equal(chart.images[0][..., :3], scene.images[0] >> 8)
    np.testing.assert_allclose(chart.marks, [[3.5, 12.5]], atol=1e-4)
    assert "column 3, row 12" in place.sentence
    np.testing.assert_array_equal(opened.ray.color, scene.images[0][12, 3].astype(np.float32) / np.float32(65535))
    assert colour.sentence == "The photo's pixel is the colour, as it is."
    wide = replace(scene.views[5].camera, width=48, cx=24.0)
    beside = open_pixel(method, scene, wide, (1, 8), 0)
    stages = {stage.title: stage for stage in beside.walk}
    assert stages["Colour"].sentence == "Beside the photo there is only background."
    (chart,) = stages["Place in the photo"].charts
    assert isinstance(chart, Pictures)
    assert np.isnan(chart.marks).all()
    assert beside.ray.opacity == 0


def masked(scene: Scene, *holes: int) -> Scene:
    """The scene, of whose views `holes` the upper left quarter is masked."""
    mask = np.ones((16, 16), bool)
    mask[:8, :8] = False
    return replace(scene, photos=scene.photos.masked(dict.fromkeys(holes, mask)))


@pytest.mark.parametrize("faced", [True, False])
def test_a_masked_pixel_is_filled_from_the_next_nearest_photo(scene: Scene, faced: bool) -> None:
    """Photos along an arc, as seen from the first: the nearest two are masked in a corner, the third is not."""
    cameras = [at(4 * np.cos(a), 4 * np.sin(a), 0) for a in (0.0, 0.2, 0.5, 0.9)]
    plain = standing(scene, *cameras)
    method = method_of(masked(plain, 0, 1))
    drawn = method.facing(cameras[0]) if faced else method
    seen = drawn.render(camera_rays(cameras[0], 2.0, 6.0))
    color = np.rint(seen.color.numpy().reshape(16, 16, 3)[..., 0] * 65535 / 6553)
    assert (color[8:] == 1).all()
    assert (color[:, 8:] == 1).all()
    assert (color[:8, :8] != 1).all()
    if faced:  # one direction in all cameras: the corner of the third photo
        assert (color[:8, :8] == 3).all()
    opened = open_pixel(method, masked(plain, 0, 1), cameras[0], (3, 3), 0)
    stages = {stage.title: stage for stage in opened.walk}
    assert "2.png is the nearest that is not masked" in stages["Nearest photo"].sentence
    assert stages["Colour"].sentence == "The photo's pixel is the colour, as it is."


def test_a_pixel_that_is_masked_in_all_photos_is_a_hole(scene: Scene) -> None:
    cameras = [at(4 * np.cos(a), 4 * np.sin(a), 0) for a in (0.0, 0.2)]
    hidden = masked(standing(scene, *cameras), 0, 1)
    method = method_of(hidden)
    opacity = method.facing(cameras[0]).render(camera_rays(cameras[0], 2.0, 6.0)).opacity.numpy().reshape(16, 16)
    assert opacity[:8, :8].max() == 0
    assert opacity[8:].min() == 1
    stages = {stage.title: stage for stage in open_pixel(method, hidden, cameras[0], (3, 3), 0).walk}
    assert stages["Colour"].sentence == "The near photos are all masked here: a hole stays."


def test_a_copy_shares_the_photos(scene: Scene) -> None:
    assert method_of(scene).frozen().scene.photos is scene.photos
