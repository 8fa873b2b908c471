"""Opened rays and the radiance at a point, compared with fields that are known in closed form."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from balls import Ball as PlainBall
from balls import model_of
from torch import Tensor, nn

from nerf_core.common.errors import UserError
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.scene import Scene
from nerf_core.kernels.torch_voxels import TorchVoxels
from nerf_core.methods import Method, Radiant, traced
from nerf_core.methods.guided.method import GuidedNerf
from nerf_core.methods.hash.method import Hash
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.methods.nerf.method import Nerf
from nerf_core.methods.voxels.method import Voxels
from nerf_core.methods.voxels.model import VoxelModel
from nerf_core.probe import (
    DISC_SIZE,
    SPHERE_COLUMNS,
    SPHERE_ROWS,
    RadianceProbe,
    RayProbe,
    disc_grid,
    inspection,
    layers_of,
    open_pixel,
    open_radiance,
    open_ray,
    view_dependence,
    write_inspection,
)
from nerf_core.probe.radiance import density_normal
from nerf_core.probe.ray import MOST_RAYS
from nerf_core.probe.records import Opened
from nerf_core.rendering.images import render_camera, tile_rays
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from nerf_core.volume.cells import Cells
from nerf_core.volume.voxel_grid import VoxelGrid

UP = np.array([0.0, 0.0, 1.0])
SMALL = {  # so that forty steps take seconds
    "nerf": {"width": "32", "rays": "64"},
    "nerf-guided": {"guide_steps": "30", "width": "32", "rays": "64"},
    "hash": {"samples": "8000", "log2_rows": "14"},
}


class Ball(nn.Module):
    """A ball of constant density whose colour encodes the viewing direction: rgb = 0.5 + 0.5·d."""

    def __init__(self, density: float = 200.0, radius: float = 1.0) -> None:
        super().__init__()
        self.value, self.radius = density, radius

    def encode_directions(self, directions: Tensor) -> Tensor:
        return directions

    def geometry(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(x.norm(dim=-1) < self.radius, self.value, -1.0), x

    def encode_positions(self, x: Tensor) -> Tensor:
        return x

    def color(self, trunk: Tensor, encoded: Tensor) -> Tensor:
        return (0.5 + 0.5 * encoded).expand(len(trunk), 3)

    def colors(self, trunk: Tensor, encoded: Tensor) -> Tensor:
        return (0.5 + 0.5 * encoded).expand(len(trunk), -1, -1)

    def forward(self, x: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor]:
        raw, trunk = self.geometry(x)
        return raw, self.color(trunk, encoded)


def ball_method(scene: Scene, **field: float) -> Nerf:
    """The real method with the closed form in place of its networks."""
    method = Nerf(scene, NerfConfig(depth=1, width=4, tile=32), torch.device("cpu"), 0)
    method.networks = {name: Ball(**field) for name in method.networks}  # type: ignore[assignment]  # no MLP, by intent
    return method


def test_an_opaque_ball_is_seen_where_it_is(scene: Scene) -> None:
    camera = scene.views[0].camera
    ray = open_ray(ball_method(scene), scene, camera, (8, 8), step=3)
    o, d = ray.origin.astype(float), ray.direction.astype(float)
    surface = -(o @ d) - np.sqrt((o @ d) ** 2 - o @ o + 1)
    spacing = 4 / 63
    assert ray.opacity == pytest.approx(1, abs=1e-4)
    for depth in (ray.depth_median, ray.depth_expected, ray.depth_strongest):
        assert depth == pytest.approx(surface, abs=spacing)
    np.testing.assert_allclose(ray.color, 0.5 + 0.5 * d, atol=1e-4)
    assert (ray.step, ray.pixel) == (3, (8, 8))
    assert [p.name for p in ray.passes] == ["coarse", "fine"]


def test_a_ray_past_the_ball_hits_nothing(scene: Scene) -> None:
    ray = open_ray(ball_method(scene), scene, scene.views[0].camera, (0, 0), step=0)
    assert ray.opacity == 0
    assert ray.depth_expected is None
    assert ray.depth_median is None
    np.testing.assert_array_equal(ray.color, scene.background)
    assert ray.depth_strongest is None
    assert open_radiance(ball_method(scene), scene, ray, UP).t == (ray.near + ray.far) / 2


def test_a_thin_medium_has_a_mean_but_no_median(scene: Scene) -> None:
    ray = open_ray(ball_method(scene, density=0.1), scene, scene.views[0].camera, (8, 8), step=0)
    assert 0.15 < ray.opacity < 0.2  # 1 − exp(−0.1 · 2)
    assert ray.depth_median is None
    assert ray.depth_expected is not None
    last = ray.passes[-1]
    assert ray.depth_strongest == last.t[np.argmax(last.weights)]


def test_the_median_depth_is_where_the_weights_sum_to_a_half(scene: Scene) -> None:
    ray = open_ray(ball_method(scene, density=1.0), scene, scene.views[0].camera, (8, 8), step=0)
    last = ray.passes[-1]
    total = 0.0
    for t, w in zip(last.t, last.weights, strict=True):
        total += float(w)
        if total >= 0.5:
            assert ray.depth_median == t
            break
    else:
        pytest.fail("the opacity never reached a half")


def test_the_opened_pixel_is_the_pixel_of_the_full_picture(make_trainer: Callable[..., Trainer], scene: Scene) -> None:
    trainer, camera = make_trainer(tile=37), scene.views[5].camera
    for _ in range(3):
        trainer.step()
    color, depth = render_camera(trainer.method, camera, scene)
    for column, row in [(0, 0), (8, 8), (15, 15), (5, 2)]:
        ray = open_ray(trainer.method, scene, camera, (column, row), trainer.step_count)
        np.testing.assert_array_equal(ray.rendered_color, color[row, column])
        np.testing.assert_allclose(ray.color, ray.rendered_color, atol=1e-5)
        assert ray.depth_expected == pytest.approx(float(depth[row, column]))
        for samples in ray.passes:
            for name, value in vars(samples).items():
                assert name == "name" or np.isfinite(value).all(), name


@pytest.mark.parametrize("method", ["voxels", "hash"])
def test_an_opened_ray_has_no_padding_samples(scene: Scene, method: str) -> None:
    trainer = Trainer(scene, RunSettings(method=method, changes={"samples": "2000"} if method == "hash" else {}))
    for _ in range(3):
        trainer.step()
    camera, counts = scene.views[0].camera, set()
    for pixel in ((0, 0), (8, 8), (3, 12)):
        ray = open_ray(trainer.method, scene, camera, pixel, 3)
        rays = tile_rays(camera, scene, pixel[1] * camera.width + pixel[0], 1)
        alone = traced(trainer.method, rays).passes[-1]
        t = ray.passes[-1].t
        assert (np.diff(t) > 0).all()
        assert len(t) == alone.t.shape[1]
        counts.add(len(t))
    assert len(counts) > 1


@pytest.mark.parametrize("method", ["voxels", "hash", "nerf-guided"])
def test_a_ray_without_samples_can_be_opened(scene: Scene, method: str) -> None:
    trainer = Trainer(scene, RunSettings(method=method, changes={"guide_steps": "2"} if "guided" in method else {}))
    model = trainer.method
    for _ in range(3):
        trainer.step()
    corner = torch.zeros(8, 8, 8, dtype=torch.bool)
    corner[0, 0, 0] = True
    if isinstance(model, Hash):
        c = model.occupancy.cells
        model.occupancy.cells = Cells.of(c.origin, c.voxel, torch.zeros_like(c.occupied), c.contracted)
    else:
        guide = model.guide if isinstance(model, GuidedNerf) else model
        assert isinstance(guide, VoxelModel)
        guide.grid = VoxelGrid.over(guide.space.low, (guide.space.high - guide.space.low) / 8, corner, False)
        guide.ema_rows = guide.grid.rows
    ray = open_ray(model, scene, scene.views[0].camera, (8, 8), 3)
    assert [len(one.t) for one in ray.passes] == [0] * len(ray.passes)
    assert (ray.opacity, ray.depth_strongest, ray.depth_median, ray.depth_expected) == (0, None, None, None)
    np.testing.assert_array_equal(ray.color, scene.background)
    radiance = open_radiance(model, scene, ray, UP)  # pyright: ignore[reportArgumentType]
    assert radiance.t == (ray.near + ray.far) / 2
    opened = open_pixel(model, scene, scene.views[0].camera, (8, 8), 3)
    assert opened.verdict is not None
    assert opened.verdict.kind == "background"
    json.dumps(inspection(opened), allow_nan=False)


@pytest.mark.parametrize("method", ["voxels", "nerf-guided", "hash", "nerf"])
def test_the_radiance_at_a_sample_is_the_samples_colour(scene: Scene, method: str) -> None:
    """Three pixels differ in point and direction, so that exchanged axes would show."""
    trainer = Trainer(scene, RunSettings(method=method, changes=SMALL.get(method, {})))
    for _ in range(40):
        trainer.step()
    for view, pixel in ((0, (8, 8)), (1, (7, 9)), (2, (9, 6))):
        ray = open_ray(trainer.method, scene, scene.views[view].camera, pixel, 40)
        last = ray.passes[-1]
        k = int(np.argmax(last.weights))
        point = torch.from_numpy(ray.origin.astype(np.float64) + float(last.t[k]) * ray.direction.astype(np.float64))
        found = trainer.method.radiance(point[None], torch.from_numpy(ray.direction.astype(np.float64))[None])[0, 0]  # pyright: ignore[reportAttributeAccessIssue]
        np.testing.assert_allclose(found.numpy(), last.rgb[k], atol=2e-3)


def test_in_open_space_far_is_where_the_weight_ends(scene: Scene) -> None:
    place = replace(scene, synthetic=False)
    trainer = Trainer(place, RunSettings(method="voxels", changes={"start": "12", "rays": "1024", "first_rays": "512"}))
    for _ in range(2):
        trainer.step()
    ray = open_ray(trainer.method, place, place.views[0].camera, (8, 8), 2)
    bound = float(tile_rays(place.views[0].camera, place, 8 * 16 + 8, 1).far[0])
    assert ray.passes[-1].t[-1] > 1000 * bound  # samples go on to the horizon
    assert bound < ray.far <= 3 * bound
    for _ in range(300):
        trainer.step()
    ray = open_ray(trainer.method, place, place.views[0].camera, (8, 8), 302)
    weights = ray.passes[-1].weights
    assert weights[ray.passes[-1].t > ray.far].sum() <= 0.01 * weights.sum()


@pytest.mark.parametrize("pixel", [(16, 0), (0, -1), (3, 16)])
def test_a_pixel_outside_the_picture_is_refused(scene: Scene, pixel: tuple[int, int]) -> None:
    with pytest.raises(
        UserError, match=rf"pixel {pixel[0]} {pixel[1]}: outside the picture, columns 0 … 15, rows 0 … 15"
    ):
        open_ray(ball_method(scene), scene, scene.views[0].camera, pixel, 0)


# ---- radiance -----------------------------------------------------------------------------------------------------


def opened(scene: Scene, pixel: tuple[int, int] = (9, 6), **field: float) -> tuple[RayProbe, RadianceProbe]:
    method, camera = ball_method(scene, **field), scene.views[2].camera
    ray = open_ray(method, scene, camera, pixel, 0)
    return ray, open_radiance(method, scene, ray, camera.c2w[:, 1])


def test_radiance_is_plotted_over_directions_to_the_viewer(scene: Scene) -> None:
    """The network gets d, camera to point. The plot is over v = −d: a field of 0.5 + 0.5·d shows 0.5 − 0.5·v."""
    _, radiance = opened(scene)
    assert SPHERE_ROWS * SPHERE_COLUMNS >= 4096
    assert disc_grid()[2].sum() >= 4096
    np.testing.assert_allclose(np.linalg.norm(radiance.directions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(radiance.rgb, 0.5 - 0.5 * radiance.directions, atol=1e-6)


def test_towards_the_viewer_the_point_emits_what_the_pixel_shows(scene: Scene) -> None:
    ray, radiance = opened(scene)
    np.testing.assert_allclose(radiance.axes[2], -ray.direction, atol=1e-6)
    centre = radiance.disc_image()[DISC_SIZE // 2, DISC_SIZE // 2]
    np.testing.assert_allclose(centre[:3], ray.color, atol=1e-3)
    assert centre[3] == 1


def test_the_colour_back_along_the_ray_does_not_depend_on_the_discs_axis(scene: Scene) -> None:
    method, camera = model_of(scene, PlainBall((0.0, 0.0, 0.0), 0.7, (0.5, 0.5, 0.5), gloss=0.4)), scene.views[2].camera
    ray = open_ray(method, scene, camera, (9, 6), 0)
    facing, turned = (open_radiance(method, scene, ray, camera.c2w[:, 1], None, a) for a in ("viewer", "normal"))
    np.testing.assert_allclose(facing.back_rgb, facing.disc_image()[DISC_SIZE // 2, DISC_SIZE // 2, :3], atol=1e-6)
    assert turned.axes[2] @ facing.axes[2] < 0.999
    np.testing.assert_allclose(turned.back_rgb, facing.back_rgb, atol=1e-6)
    assert len(turned.rgb) == len(turned.directions)


def test_the_point_is_at_the_given_t_or_in_the_middle_of_the_layers_weight(scene: Scene) -> None:
    for density in (200.0, 0.1):
        ray, radiance = opened(scene, density=density)
        assert radiance.t == layers_of(ray, scene)[0].t
        assert radiance.layer is not None
        last = ray.passes[-1]
        assert last.weights[last.t < radiance.t].sum() == pytest.approx(ray.opacity / 2, abs=float(last.weights.max()))
        np.testing.assert_allclose(radiance.point, ray.origin + radiance.t * ray.direction, atol=1e-6)
    asked = open_radiance(ball_method(scene), scene, ray, UP, point_t=3.25)
    assert asked.t == 3.25


def test_maps_and_positions_agree(scene: Scene) -> None:
    _, radiance = opened(scene)
    sphere = radiance.sphere_image("point")
    for k in range(0, SPHERE_ROWS * SPHERE_COLUMNS, 97):
        x, y = radiance.sphere_position(radiance.directions[k])
        row, column = divmod(k, SPHERE_COLUMNS)
        assert (x * SPHERE_COLUMNS, y * SPHERE_ROWS) == pytest.approx((column + 0.5, row + 0.5))
        np.testing.assert_array_equal(sphere[row, column], radiance.rgb[k])
    x, y, inside = disc_grid()
    image = radiance.disc_image("point")
    for direction, at in zip(radiance.directions[SPHERE_ROWS * SPHERE_COLUMNS :], np.argwhere(inside), strict=True):
        row, column = at
        assert radiance.disc_position(direction) == pytest.approx((x[row, column], y[row, column]))
        np.testing.assert_allclose(image[row, column, :3], 0.5 - 0.5 * direction, atol=1e-6)
    assert (image[~inside] == 0).all()
    assert y[0, 0] > 0  # row 0 is the top
    assert np.isnan(radiance.disc_position(-radiance.axes[2])).all()


def test_frames_are_right_handed_also_when_the_camera_looks_along_the_axis(scene: Scene) -> None:
    camera = scene.views[0].camera
    above = camera.moved(np.array([[1.0, 0, 0, 0.05], [0, 1, 0, 0.05], [0, 0, 1, 4]]))
    scene = replace(scene, up=np.array([0.0, 0.0, 2.0]))
    method = ball_method(scene)
    ray = open_ray(method, scene, above, (8, 8), 0)
    for up in (above.c2w[:, 1], ray.direction.astype(float)):
        radiance = open_radiance(method, scene, ray, up)
        np.testing.assert_allclose(radiance.axes @ radiance.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(radiance.axes) == pytest.approx(1)
        np.testing.assert_allclose(radiance.up, [0, 0, 1])
        assert radiance.up @ radiance.azimuth0 == pytest.approx(0, abs=1e-12)
        assert np.isfinite(radiance.directions).all()


def test_the_disc_is_the_whole_circle_and_nothing_but_it() -> None:
    x, y, inside = disc_grid()
    assert inside.mean() == pytest.approx(np.pi / 4, rel=0.01)
    assert np.array_equal(inside, np.hypot(x, y) < 1)


def test_view_dependence_of_a_matt_ball_and_of_a_known_one(scene: Scene) -> None:
    """For rgb = 0.5 + 0.5 d it is √(¼ · ¼) = ¼.

    The components of d over a hemisphere have the variances 1/12, 1/3 and 1/3, whose mean is ¼.
    """
    towards = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1)
    found = view_dependence(ball_method(scene), torch.zeros(20, 3, dtype=torch.float64), towards)
    np.testing.assert_allclose(found, 0.25, atol=0.01)
    matt = model_of(scene, PlainBall((0.0, 0.0, 0.0), 0.7, (0.8, 0.2, 0.15)))
    assert view_dependence(matt, torch.zeros(3, 3), towards[:3]).max() < 1e-6


def highlighted(scene: Scene) -> Method:
    """Two balls, one behind the other. The front one is thin, so that both share the pixel, and has a gloss."""
    front = PlainBall((0.0, 0.0, 0.0), 0.5, (0.3, 0.3, 0.4), density=2.0, gloss=0.3)
    return model_of(scene, front, PlainBall((0.0, 0.9, 0.0), 0.3, (0.8, 0.2, 0.1)))


def test_a_layer_emits_its_samples_mixed_by_their_weights(scene: Scene) -> None:
    """Σ w c(x, −v) / Σ w over the samples of the layer, recomputed from the opened ray and the model alone."""
    method, camera = highlighted(scene), scene.views[2].camera
    assert isinstance(method, Radiant)
    for pixel in ((8, 8), (9, 6)):
        ray = open_ray(method, scene, camera, pixel, 0)
        last = ray.passes[-1]
        for layer in layers_of(ray, scene):
            found = open_radiance(method, scene, ray, camera.c2w[:, 1], layer.t)
            assert found.layer is not None
            assert found.layer.tolist() == [layer.begin, layer.end]
            part = np.clip(last.until, layer.begin, layer.end) - np.clip(last.t, layer.begin, layer.end)
            part = np.where(last.weights > 0, part / (last.until - last.t), 0.0)
            inside = part > 0
            w = (part * last.weights)[inside]
            assert w.sum() == pytest.approx(layer.weight, rel=0.01)
            np.testing.assert_allclose(found.layer_back_rgb, w @ last.rgb[inside] / w.sum(), atol=4e-3)
            some = np.arange(0, len(found.directions), 301)
            points = ray.origin + last.t[inside, None].astype(np.float64) * ray.direction
            rgb = method.radiance(torch.from_numpy(points), torch.from_numpy(-found.directions[some])).numpy()
            expected = np.einsum("p,pkc->kc", w, rgb) / w.sum()
            np.testing.assert_allclose(found.layer_rgb[some], expected, atol=4e-3)  # the rest is not evaluated anew


def test_the_disc_shows_first_what_was_clicked(scene: Scene) -> None:
    """Towards the camera, the layer that makes the pixel shows the pixel, whatever the colour of a single point."""
    thick = PlainBall((0.0, 0.0, 0.0), 0.8, (0.5, 0.5, 0.5), density=3.0, gloss=0.2, pattern=0.5)  # as in a young model
    method, camera = model_of(scene, thick), scene.views[2].camera
    apart = []
    for pixel in ((9, 6), (8, 8), (7, 9), (10, 10)):
        ray = open_ray(method, scene, camera, pixel, 0)
        (layer,) = layers_of(ray, scene)
        found = open_pixel(method, scene, camera, pixel, 0).radiance
        assert found is not None
        assert (found.default, found.t) == ("layer", layer.t)
        own = (ray.color - (1 - ray.opacity) * ray.background) / ray.opacity
        centre = found.disc_image()[DISC_SIZE // 2, DISC_SIZE // 2, :3]
        np.testing.assert_allclose(centre, own, atol=0.01)
        np.testing.assert_allclose(found.layer_back_rgb, own, atol=0.01)
        apart.append(np.abs(found.back_rgb - own).max())
    assert max(apart) > 0.1  # a point alone can be of quite another colour
    asked = open_pixel(method, scene, camera, pixel, 0, point_t=layer.t).radiance
    assert asked is not None
    assert asked.default == "point"
    np.testing.assert_array_equal(asked.colors(), asked.rgb)
    outside = open_radiance(method, scene, ray, camera.c2w[:, 1], layer.end + 0.5)
    assert (outside.layer, outside.default) == (None, "point")
    np.testing.assert_array_equal(outside.layer_rgb, outside.rgb)


def test_a_frozen_ray_has_the_pixels_colour_towards_its_own_camera(scene: Scene) -> None:
    method = ball_method(scene, density=1.0)
    ray, radiance = opened(scene, density=1.0)
    last = ray.passes[-1]
    for k in range(0, len(radiance.directions), 997):
        d = torch.from_numpy(-radiance.directions[k])[None]
        points = ray.origin.astype(float) + last.t[:, None].astype(float) * ray.direction.astype(float)
        colors = method.radiance(torch.from_numpy(points), d)[:, 0].numpy()
        expected = last.weights @ colors + (1 - last.weights.sum()) * ray.background
        np.testing.assert_allclose(radiance.frozen_rgb[k], expected, atol=3e-3)
    centre = radiance.disc_image("ray")[DISC_SIZE // 2, DISC_SIZE // 2, :3]
    np.testing.assert_allclose(centre, ray.color, atol=2e-3)


def test_the_normal_points_out_of_a_ball(scene: Scene) -> None:
    ball = PlainBall((0.1, -0.2, 0.0), 0.7, (0.5, 0.5, 0.5))
    method = model_of(scene, ball)
    for direction in np.random.default_rng(0).normal(size=(10, 3)):
        out = direction / np.linalg.norm(direction)
        point = np.array(ball.center) + ball.radius * out
        normal = density_normal(method, point, 0.01, out)
        assert normal is not None
        np.testing.assert_allclose(normal, out, atol=1e-2)
    assert density_normal(method, np.full(3, 5.0), 0.01, np.array([0.0, 0.0, 1.0])) is None


def test_a_disc_can_lie_around_the_normal(scene: Scene) -> None:
    ball = PlainBall((0.0, 0.0, 0.0), 0.7, (0.5, 0.5, 0.5))
    method, camera = model_of(scene, ball), scene.views[2].camera
    ray = open_ray(method, scene, camera, (9, 6), 0)
    radiance = open_radiance(method, scene, ray, camera.c2w[:, 1], around="normal")
    assert radiance.normal is not None
    np.testing.assert_allclose(radiance.axes[2], radiance.normal, atol=1e-9)
    np.testing.assert_allclose(radiance.normal, radiance.point / np.linalg.norm(radiance.point), atol=0.1)


def test_a_slice_is_the_disc_along_a_line(scene: Scene) -> None:
    """The field is 0.5 + 0.5 d, so that a slice's colours tell their directions."""
    _, radiance = opened(scene)
    for azimuth in (0.0, 0.7, 2.5):
        angles, rgb = radiance.slice(azimuth)
        along = np.cos(azimuth) * radiance.axes[0] + np.sin(azimuth) * radiance.axes[1]
        directions = np.cos(angles)[:, None] * radiance.axes[2] + np.sin(angles)[:, None] * along
        np.testing.assert_allclose(rgb, 0.5 - 0.5 * directions, atol=0.02 if azimuth == 0 else 0.05)
        assert np.degrees(angles[-1]) == pytest.approx(-np.degrees(angles[0])) == pytest.approx(80.5, abs=0.1)
        for angle, direction in zip(angles[::20], directions[::20], strict=True):
            assert radiance.slice_position(direction, azimuth) == pytest.approx((angle, 0.0), abs=1e-9)


@pytest.mark.parametrize("plain", [False, True])
def test_a_ray_opened_alone_equals_the_pictures_pixel(scene: Scene, plain: bool) -> None:
    """The voxel method opens a ray by itself. Up to rounding it equals the picture's pixel, also with torch kernels."""
    trainer = Trainer(scene, RunSettings(method="voxels"))
    for _ in range(30):
        trainer.step()
    method, camera = trainer.method, scene.views[5].camera.resized(61, 61)
    assert isinstance(method, Voxels)
    if plain:
        method.kernels = TorchVoxels()
    whole = render_camera(method, camera, scene)[0]
    for x, y in np.random.default_rng(0).integers(61, size=(40, 2)).tolist():
        ray = open_ray(method, scene, camera, (x, y), 0)
        np.testing.assert_allclose(ray.color, whole[y, x], atol=1e-5)
        np.testing.assert_allclose(ray.rendered_color, whole[y, x], atol=1e-6)


def _in_space(scene: Scene, kind: str) -> Scene:
    """The scene in a box, without bounds, or before forward-facing cameras in NDC."""
    if kind == "world":
        return scene
    if kind == "contracted":
        return replace(scene, synthetic=False, background=(0.0, 0.0, 0.0))
    turned = scene.views[0].camera.c2w  # NDC needs rays along −z: turn the world by this
    turn = np.linalg.inv(np.vstack([turned, [0, 0, 0, 1]]))[:3]
    views = []
    for k, view in enumerate(scene.views):
        camera = scene.views[0].camera
        beside = camera.c2w[:, :3] @ np.array([0.2 * (k - 2), 0.1 * (k % 3 - 1), 0.0])
        c2w = np.column_stack([camera.c2w[:, :3], camera.c2w[:, 3] + beside])
        moved = turn @ np.vstack([c2w, [0, 0, 0, 1]])
        views.append(replace(view, camera=camera.moved(moved)))
    ndc = Ndc(16, 16, scene.views[0].camera.fx, 1.0, 20.0)
    return replace(scene, synthetic=False, views=tuple(views), ndc=ndc, near=1.0, far=20.0, center=turn[:, 3])


@pytest.mark.parametrize("space", ["world", "contracted", "ndc"])
@pytest.mark.parametrize("method", ["voxels", "nerf-guided", "hash", "nerf"])
def test_every_pixel_is_the_sum_of_its_samples(scene: Scene, method: str, space: str) -> None:
    """Compares every opened pixel with the full picture: 10,816 in a box, 1,600 in the other spaces."""
    scene = _in_space(scene, space)
    trainer = Trainer(scene, RunSettings(method=method, changes=SMALL.get(method, {})))
    for _ in range(40):
        trainer.step()
    size = 104 if space == "world" else 40
    camera = scene.views[5].camera.resized(size, size)
    whole = render_camera(trainer.method, camera, scene)[0].reshape(-1, 3)
    count, background = min(trainer.method.tile, MOST_RAYS), np.array(scene.background)
    worst, most = 0.0, 0.0
    for start in range(0, size**2, count):
        last = traced(trainer.method, tile_rays(camera, scene, start, count)).passes[-1]
        weights, rgb = last.weights.double().cpu().numpy(), last.rgb.double().cpu().numpy()
        color = np.einsum("rs,rsc->rc", weights, rgb) + (1 - weights.sum(-1))[:, None] * background
        worst = max(worst, float(np.abs(color - whole[start : start + count]).max()))
        most = max(most, float(weights.sum(-1).max()))
    assert worst < 1e-5
    assert 0.1 < most < 1 + 1e-5
    # Some also through open_ray: few if the method cannot trace a ray alone, as open_ray then traces a whole tile.
    some = 200 if trainer.method.alone else 10
    for pixel in np.random.default_rng(0).integers(0, size, (some, 2)):
        ray = open_ray(trainer.method, scene, camera, (int(pixel[0]), int(pixel[1])), 40)
        last = ray.passes[-1]
        color = last.weights.astype(np.float64) @ last.rgb + (1 - last.weights.sum(dtype=np.float64)) * background
        shown = whole[pixel[1] * size + pixel[0]]
        assert np.abs(color - shown).max() < 1e-5
        assert np.abs(ray.rendered_color.clip(0, 1) - shown).max() < 1e-5


@pytest.mark.parametrize("method", ["voxels", "nerf-guided", "hash", "nerf"])
def test_under_ndc_a_ray_is_recomputed_from_its_exported_arrays(scene: Scene, method: str, tmp_path: Path) -> None:
    """Also behind the capture's far bound, where t′ goes on to infinity."""
    scene = _in_space(scene, "ndc")
    assert scene.ndc is not None
    scene = replace(scene, ndc=replace(scene.ndc, far=2.0), far=2.0)
    # bfloat16, where the processor has it, rounds an evaluation of other points differently
    precise = {"precision": "float32"} if method.startswith("nerf") else {}
    trainer = Trainer(scene, RunSettings(method=method, changes=SMALL.get(method, {}) | precise))
    for _ in range(40):
        trainer.step()
    camera, file = scene.views[5].camera.resized(40, 40), tmp_path / "ray.json"
    behind = 0.0
    for pixel in np.random.default_rng(0).integers(0, 40, (6, 2)):
        ray = open_ray(trainer.method, scene, camera, (int(pixel[0]), int(pixel[1])), 40)
        write_inspection([Opened(camera, scene, method, ray)], file)
        told = json.loads(file.read_text())
        last = {name: np.array(values) for name, values in told["passes"][-1].items() if name != "name"}
        origin, direction, weights = np.array(told["origin"]), np.array(told["direction"]), last["weights"]
        assert np.isfinite(last["t"]).all()
        behind += weights[last["t"] > scene.far].sum()
        background = (1 - weights.sum()) * np.array(told["background"])
        np.testing.assert_allclose(weights @ last["rgb"] + background, told["color"], atol=1e-5)
        points = torch.from_numpy(origin + last["t"][:, None] * direction)
        assert isinstance(trainer.method, Radiant)
        rgb = trainer.method.radiance(points, torch.from_numpy(direction)[None])[:, 0].cpu().numpy()
        np.testing.assert_allclose(weights @ rgb + background, told["color"], atol=1e-5)
        if not weights.sum():  # the ray meets nothing: it has no depth
            assert told["depth_expected"] is None
            continue
        # t′ / (1 − t′) of the distance t, with the near plane at told["ndc"]["near"]
        near = told["ndc"]["near"]
        ratio = (last["t"] * -direction[2] - (near + origin[2])) / near
        mean = weights @ (ratio / (1 + ratio)) / weights.sum()
        expected = ((near + origin[2]) + near * mean / (1 - mean)) / -direction[2]
        np.testing.assert_allclose(expected, told["depth_expected"], rtol=1e-5)
        if told["depth_median"] is not None:
            assert last["t"][np.searchsorted(np.cumsum(weights), 0.5)] == told["depth_median"]
        assert last["t"][np.argmax(weights)] == told["depth_strongest"]
    assert behind > 0.05
