from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.lens import PINHOLE, Lens
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS
from nerf_core.methods.mpi.config import MpiConfig
from nerf_core.methods.mpi.model import MpiModel
from nerf_core.methods.mpi.planes import BORDER, Seen, Spread, Stack, alpha_gradient, look
from nerf_core.methods.mpi.references import blending, spread_out
from nerf_core.methods.mpi.sweep import Photo, sweep
from nerf_core.methods.stages import Pictures
from nerf_core.probe import open_ray
from nerf_core.rendering.images import render_camera
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
SMALL = {"references": "3", "planes": "8", "shared": "1", "blended": "2", "rays": "256", "margin": "0"}


def build(scene: Scene, **changes: str) -> Any:
    kind = METHODS.get("mpi")
    return kind(scene, kind.configure(scene, "auto", SMALL | changes, CPU), CPU, 0)


def filled(scene: Scene, **changes: str) -> Any:
    """A model with random planes."""
    method, random = build(scene, **changes), torch.Generator().manual_seed(1)
    method.swept = len(method.stacks)
    for alpha, color, *_ in method.planes:
        alpha[:, 1:-1, 1:-1] = torch.rand(alpha[:, 1:-1, 1:-1].shape, generator=random) * 0.6
        color.copy_(torch.rand(color.shape, generator=random))
    return method


def turned(degrees: float, place: tuple[float, float, float]) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s, place[0]], [0, 1, 0, place[1]], [-s, 0, c, place[2]]])


def stack_of(camera: Camera, planes: int = 5) -> Stack:
    return Stack.of(0, camera, (2.0, 8.0), planes, 640, 0.0, CPU)


def test_the_planes_are_evenly_spaced_in_disparity_between_near_and_far(facing: Scene) -> None:
    stack = stack_of(facing.views[0].camera)
    np.testing.assert_allclose(1 / stack.depths.numpy(), [0.5, 0.40625, 0.3125, 0.21875, 0.125])


def test_crossings_are_those_of_rays_and_planes_by_hand() -> None:
    reference = Camera(20, 16, 30.0, 25.0, 9.0, 7.0, turned(10, (0.1, -0.2, 0.3)))
    stack = stack_of(reference)
    rays = camera_rays(Camera(6, 5, 9.0, 9.0, 3.0, 2.5, turned(-8, (-0.3, 0.1, 0.5))), 2.0, 8.0)
    crossed = stack.crossings(rays)
    for plane, depth in enumerate(stack.depths.numpy()):
        normal = reference.c2w[:, 2]
        point = reference.c2w[:, 3] - depth * normal
        o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
        t = ((point - o) @ normal) / (d @ normal)
        np.testing.assert_allclose(crossed.t[plane], t, rtol=1e-5)
        pixels, z = reference.project(o + t[:, None] * d)
        np.testing.assert_allclose(z, depth, rtol=1e-6)
        np.testing.assert_allclose(crossed.at[plane], pixels, atol=1e-4)


def test_crossings_are_those_of_the_planes_homographies() -> None:
    """From pixel to pixel, H = K (R − t nᵀ / z) K′⁻¹ of two cameras with a plane at depth z (Hartley and Zisserman)."""
    first = Camera(20, 16, 30.0, 25.0, 9.0, 7.0, turned(10, (0.1, -0.2, 0.3)))
    second = Camera(20, 16, 28.0, 28.0, 10.0, 8.0, turned(-5, (0.4, 0.0, 0.1)))
    stack = stack_of(first)
    flip = np.diag([1.0, -1.0, -1.0])  # axes with y down that look along +z
    k1, k2 = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (first, second))
    rotation = flip @ second.c2w[:, :3].T @ first.c2w[:, :3] @ flip  # of points, from the first camera to the second
    shift = flip @ second.c2w[:, :3].T @ (first.c2w[:, 3] - second.c2w[:, 3])
    pixels = np.array([(3, 4), (10, 8), (15, 11)])
    crossed = stack.crossings(camera_rays(second, 2.0, 8.0, pixels))
    for plane, depth in enumerate(stack.depths.tolist()):
        homography = k2 @ (rotation + np.outer(shift, [0, 0, 1 / depth])) @ np.linalg.inv(k1)
        place = np.concatenate([crossed.at[plane].double().numpy(), np.ones((3, 1))], 1) @ homography.T
        np.testing.assert_allclose(place[:, :2] / place[:, 2:], pixels + 0.5, atol=1e-4)


def test_a_ray_beside_or_behind_the_planes_meets_none_of_them(facing: Scene) -> None:
    stack = stack_of(facing.views[0].camera)
    place = stack.position.float()
    origins = torch.stack([place, place, place - torch.tensor([0.0, 0.0, 9.0]), place - torch.tensor([0.0, 0.0, 4.0])])
    directions = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    crossed = stack.crossings(Rays(origins, directions, torch.ones(4), torch.full((4,), 9.0)))
    assert stack.covers(crossed.at).sum(0).tolist() == [0, 0, 0, 2]  # of the depths 2, 2.46, 3.2, 4.57 and 8
    assert crossed.t.isfinite().all()


def seen_by_hand(alpha: list[float], rgb: list[list[float]]) -> tuple[Seen, Tensor, Tensor]:
    """One texel per plane, seen by one ray through its centre."""
    a = torch.zeros(len(alpha), 3, 3)
    a[:, 1, 1] = torch.tensor(alpha)
    c = torch.tensor(rgb)[:, :, None, None].expand(-1, -1, 3, 3).contiguous()
    return look(a, c, torch.full((len(alpha), 1, 2), 0.5)), a, c


def test_planes_are_composited_with_over_by_hand() -> None:
    seen, _, _ = seen_by_hand([0.5, 0.25, 0.9], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    over = np.zeros(3)
    for color, alpha in (([0, 0, 1], 0.9), ([0, 1, 0], 0.25), ([1, 0, 0], 0.5)):  # back to front
        over = np.multiply(color, alpha) + (1 - alpha) * over
    np.testing.assert_allclose(seen.color[:, 0], over, atol=1e-6)
    np.testing.assert_allclose(seen.weights[:, 0], [0.5, 0.125, 0.3375], atol=1e-6)
    np.testing.assert_allclose(seen.opacity, 1 - 0.5 * 0.75 * 0.1, atol=1e-6)


def test_planes_that_share_a_colour_look_it_up_where_each_is_crossed() -> None:
    alpha = torch.zeros(2, 3, 4)
    alpha[:, 1, 1:3] = 0.5
    color = torch.zeros(1, 3, 3, 4)
    color[0, :, 1, 1], color[0, :, 1, 2] = 0.2, 0.8
    seen = look(alpha, color, torch.tensor([[[0.5, 0.5]], [[1.5, 0.5]]]))
    np.testing.assert_allclose(seen.rgb[0, 0, :, 0], [0.2, 0.8], atol=1e-6)
    np.testing.assert_allclose(seen.color[:, 0], 0.5 * 0.2 + 0.25 * 0.8, atol=1e-6)


def test_scattering_is_the_transpose_of_looking_up() -> None:
    random = torch.Generator().manual_seed(0)
    at = torch.rand(40, 2, generator=random) * torch.tensor([7.0, 6.0]) - 1  # also outside the plane of 5 × 4 texels
    plane, values = torch.rand(1, 6, 7, generator=random), torch.rand(40, generator=random)
    plane[:, (0, -1)], plane[:, :, (0, -1)] = 0, 0
    onto = torch.zeros(6, 7)
    Spread.of(at, 5, 4).onto(values, onto)
    looked = look(plane, torch.zeros(1, 3, 6, 7), at[None]).alpha[0]
    assert float((looked * values).sum()) == pytest.approx(float((onto * plane[0]).sum()), rel=1e-5)


def test_gradients_are_those_of_finite_differences(facing: Scene) -> None:
    """Of the squared error of rays through one MPI, for opacities and for colours that two planes share."""
    method = filled(facing, planes="5", shared="2")
    stack, rays = method.stacks[0], camera_rays(facing.views[3].camera, facing.near, facing.far)[40:60]
    alpha, color = method.planes[0].alpha.double(), method.planes[0].color.double()
    at, behind = stack.crossings(rays).at.double(), torch.tensor([[0.3], [0.9], [0.1]], dtype=torch.float64)
    truth = torch.rand(3, len(rays), generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def loss() -> float:
        seen = look(alpha, color, at)
        return float((seen.color + (1 - seen.opacity) * behind - truth).square().sum())

    seen = look(alpha, color, at)
    gradient = 2 * (seen.color + (1 - seen.opacity) * behind - truth)
    on_alpha, on_color = torch.zeros_like(alpha), torch.zeros_like(color)
    for plane, values in enumerate(alpha_gradient(seen, gradient, behind)):
        spread = Spread.of(at[plane], stack.width, stack.height)
        spread.onto(values, on_alpha[plane])
        for channel in range(3):
            spread.onto(seen.weights[plane] * gradient[channel], on_color[plane // 2, channel])
    for values, found in ((alpha, on_alpha), (color, on_color)):
        inner = found[..., 1:-1, 1:-1].abs()
        assert (inner > 0.05).sum() > 5
        for place in (inner > 0.05).nonzero()[::3]:
            index = (*place[:-2].tolist(), *(place[-2:] + BORDER).tolist())
            kept = values[index].clone()
            values[index] = kept + 1e-5
            higher = loss()
            values[index] = kept - 1e-5
            assert (higher - loss()) / 2e-5 == pytest.approx(float(found[index]), rel=1e-4)
            values[index] = kept


def test_blending_weights_fall_with_the_distance_and_leave_one_at_its_place() -> None:
    weights = blending(torch.tensor([[1.0, 2.0, 4.0, 3.0], [0.0, 1.0, 2.0, 5.0]]), 3, 0.5)
    plain = np.exp([-0.5, -1.0, 0, -1.5]) * [1, 1 / 2, 0, 1 / 3]
    np.testing.assert_allclose(weights[0], plain / plain.sum(), rtol=1e-6)
    assert weights[1].tolist() == [1, 0, 0, 0]
    near = blending(torch.tensor([[1e-6, 1.0, 2.0, 5.0]]), 3, 0.5)
    torch.testing.assert_close(near[0], weights[1], atol=1e-5, rtol=0)  # continuous
    assert blending(torch.tensor([[0.0]]), 3, 0.5).tolist() == [[1]]


def test_reference_views_are_spread_out() -> None:
    line = np.array([[x, 0.0, 0.0] for x in (0, 1, 2, 3, 4, 10)])
    assert spread_out(line, 3) == [3, 5, 0]
    assert spread_out(line, 2) == [3, 5]
    assert len(spread_out(line, 9)) == 6
    assert spread_out(np.zeros((4, 3)), 3) == [0]


def test_at_a_reference_view_the_picture_is_the_mpi_itself(facing: Scene) -> None:
    """Texel by texel: the planes are composited where they lie, and no other MPI is blended in."""
    method = filled(facing, shared="2")
    for k, stack in enumerate(method.stacks):
        camera = facing.views[stack.view].camera
        drawn, _ = render_camera(method, camera, facing)
        picture = np.ones((camera.height, camera.width, 3)) * 0  # over nothing, back to front
        covered = np.zeros((camera.height, camera.width, 1))
        for plane in range(7, -1, -1):
            alpha = method.planes[k].alpha[plane, 1:-1, 1:-1].numpy()[..., None]
            color = method.planes[k].color[plane // 2, :, 1:-1, 1:-1].permute(1, 2, 0).numpy()
            picture = alpha * color + (1 - alpha) * picture
            covered = alpha + (1 - alpha) * covered
        np.testing.assert_allclose(drawn, picture / covered, atol=2e-5)


def test_a_pixel_blends_what_its_nearest_mpis_hold(facing: Scene) -> None:
    """C = Σ β C_k / Σ β A_k, of the two nearest of three views, written out."""
    method = filled(facing)
    camera = facing.views[6].camera
    rays = camera_rays(camera, facing.near, facing.far)
    away = np.array([np.linalg.norm(facing.views[s.view].camera.c2w[:, 3] - camera.c2w[:, 3]) for s in method.stacks])
    gamma = camera.fx / (8 * facing.near)  # f / (D z0)
    total, covered = np.zeros((len(rays), 3)), np.zeros((len(rays), 1))
    for k in np.argsort(away)[:2]:
        seen = look(method.planes[k].alpha, method.planes[k].color, method.stacks[k].crossings(rays).at)
        beta = math.exp(-gamma * away[k]) / away[k]
        total += beta * seen.color.T.numpy()
        covered += beta * seen.opacity[:, None].numpy()
    drawn = method.render(rays)
    some = covered[:, 0] > 0.2 * covered.max()
    assert some.mean() > 0.8
    np.testing.assert_allclose(drawn.color[some], total[some] / covered[some], atol=1e-5)
    np.testing.assert_allclose(drawn.opacity[some], 1, atol=1e-6)


def test_a_pixel_that_no_mpi_holds_is_background(facing: Scene) -> None:
    method = filled(facing)
    for planes in method.planes:
        planes.alpha.mul_(1e-5)
    drawn = method.render(camera_rays(facing.views[6].camera, facing.near, facing.far))
    assert float(drawn.opacity.max()) < 0.01
    torch.testing.assert_close(drawn.color, torch.ones(256, 3), atol=0.01, rtol=0)
    assert drawn.depth.isnan().all()


@pytest.mark.parametrize("ndc", [False, True])
def test_the_opened_planes_are_the_pixel(facing: Scene, ndc: bool) -> None:
    scene = facing
    if ndc:  # the cameras stand at z = 4: moved to 0, as NDC needs
        views = tuple(
            replace(v, camera=v.camera.moved(np.column_stack([np.eye(3), v.camera.c2w[:, 3] - (0, 0, 4)])))
            for v in facing.views
        )
        scene = replace(facing, views=views, ndc=Ndc(16, 16, views[0].camera.fx, 1.0, 6.0))
    method, camera = filled(scene), scene.views[6].camera
    for pixel in ((8, 8), (0, 0), (15, 3)):
        ray = open_ray(method, scene, camera, pixel, 0)
        np.testing.assert_allclose(ray.color, ray.rendered_color, atol=1e-5)
        assert [p.name for p in ray.passes] == [method.name(k) for k in sorted_views(method, camera)] + ["planes"]
        assert len(ray.last.t) == sum(len(p.t) for p in ray.passes[:-1]) > 2
        for samples in ray.passes:
            assert (np.diff(samples.t) >= 0).all()
            np.testing.assert_allclose(samples.until[:-1], samples.t[1:], rtol=1e-4)  # stretches join
            np.testing.assert_allclose(1 - np.exp(-samples.sigma * samples.delta), samples.alpha, atol=1e-5)


def sorted_views(method: MpiModel, camera: Camera) -> list[int]:
    origin = torch.tensor(camera.c2w[None, :, 3])
    return (method.weights(origin)[0] > 0).nonzero()[:, 0].tolist()


def test_a_scene_that_is_seen_from_all_around_is_refused(scene: Scene, facing: Scene) -> None:
    kind = METHODS.get("mpi")
    with pytest.raises(UserError) as caught:
        kind.configure(scene, "auto", {}, CPU)
    text = str(caught.value)
    assert text.startswith("method mpi needs a forward-facing capture: ")
    assert "of 5 training cameras look away from their mean direction of view; take " in text
    assert "\n" not in text
    assert isinstance(kind.configure(facing, "auto", {}, CPU), MpiConfig)


def test_opposite_cameras_without_a_mean_are_refused_too(facing: Scene) -> None:
    around = tuple(
        replace(v, camera=v.camera.moved(np.column_stack([turned(180.0 * (i % 2), (0, 0, 0))[:, :3], (i, 0, 0)])))
        for i, v in enumerate(facing.views)
    )
    scene = replace(facing, views=around, splits={"train": (0, 1, 2, 3)})
    with pytest.raises(UserError, match="the 4 training cameras have no mean direction of view"):
        METHODS.get("mpi").configure(scene, "auto", {}, CPU)


@pytest.mark.parametrize("lens", [PINHOLE, Lens(k1=0.2, p1=0.02)])
def test_a_projected_photo_agrees_with_projected_points(facing: Scene, lens: Lens) -> None:
    views = tuple(replace(v, camera=replace(v.camera, lens=lens)) for v in facing.views)
    scene, stack = replace(facing, views=views), stack_of(views[0].camera)
    points = stack.points()
    photo = Photo(scene, 4, stack, points.float())
    colors, shown = photo.onto(3.2)
    for row, column in ((1, 1), (8, 9), (15, 4)):
        world = stack.rotation @ (3.2 * points[row, column].double()) + stack.position
        (pixel,), _ = views[4].camera.project(world.numpy()[None])
        inside = bool(((pixel >= 0) & (pixel <= 16)).all())
        assert bool(shown[row, column] >= 1) == inside
        if inside and ((pixel > 1) & (pixel < 15)).all():
            x, y = pixel - 0.5
            left, top = int(x), int(y)
            image = facing.images[4].astype(float) / 65535
            mixed = sum(
                image[top + i, left + j] * (1 - abs(y - top - i)) * (1 - abs(x - left - j))
                for i in (0, 1)
                for j in (0, 1)
            )
            np.testing.assert_allclose(colors[:, row, column], mixed, atol=1e-4)


@pytest.fixture(scope="module")
def wall(facing: Scene) -> Scene:
    """Photos of a textured wall at the depth 3.2 of all cameras."""
    images = []
    for view in facing.views:
        rays = camera_rays(view.camera, facing.near, facing.far)
        x, y, _ = (rays.origins - rays.directions * (3.2 / rays.directions[:, 2:])).double().numpy().T
        rgb = np.stack([np.sin(7 * x + 3 * y), np.sin(9 * y - 2 * x), np.sin(4 * x - 6 * y)], -1) * 0.4 + 0.5
        images.append((rgb.reshape(16, 16, 3) * 65535).astype(np.uint16))
    return replace(facing, photos=Photos.of(images), near=2.0, far=8.0)


def test_a_sweep_finds_the_depth_at_which_photos_agree(wall: Scene) -> None:
    method = build(wall, planes="5", references="1", sweep_window="3", sweep_softness="0.01")
    stack = method.stacks[0]
    alpha, color = sweep(wall, (0, 1, 2, 3, 4), stack, 5, 3, 0.01, lambda: None)
    assert stack.depths.tolist()[2] == pytest.approx(3.2)
    seen = look(alpha, color, stack.crossings(camera_rays(wall.views[stack.view].camera, 2.0, 8.0)).at)
    inner = seen.weights.view(5, 16, 16)[:, 3:-3, 3:-3]
    assert (inner.argmax(0) == 2).float().mean() > 0.9
    assert inner[2].mean() > 0.8
    assert float(seen.opacity.min()) > 0.99


def test_it_learns_a_picture_that_it_has_not_seen(wall: Scene) -> None:
    changes = SMALL | {"margin": "0.25", "rate_color": "0.03", "rate_alpha": "0.03"}
    trainer = Trainer(wall, RunSettings(method="mpi", changes=changes, steps=60, device="cpu", threads=1))
    view = wall.views[wall.split("test")[0]]
    truth = wall.images[6].astype(np.float32) / 65535

    def error() -> float:
        return float(np.square(render_camera(trainer.method, view.camera, wall)[0] - truth).mean())

    assert error() > 0.05  # white: nothing is there
    for _ in range(3):
        assert trainer.method.stage.startswith("plane sweep: ")
        trainer.step()
    swept = error()
    assert swept < 0.02
    while trainer.step_count < 60:
        trainer.step()
    assert error() < 0.7 * swept


def test_the_planes_of_a_frozen_copy_stay_as_they_are(wall: Scene) -> None:
    trainer = Trainer(wall, RunSettings(method="mpi", changes=SMALL, steps=60, device="cpu", threads=1))
    trainer.step()
    rays = camera_rays(wall.views[6].camera, wall.near, wall.far)
    frozen = trainer.frozen_method()
    before = frozen.render(rays).color
    for _ in range(6):
        trainer.step()
    assert torch.equal(frozen.render(rays).color, before)
    assert not torch.equal(trainer.method.render(rays).color, before)


def test_a_large_photo_has_smaller_planes_and_the_stage_says_their_size(facing: Scene) -> None:
    method = build(facing, resolution="8", margin="0.25")
    assert (method.stacks[0].width, method.stacks[0].height) == (12, 12)
    method.swept = 3
    assert method.stage == "3 MPIs of 8 planes: 75.3 kB, and 226 kB to train them"
    assert sum(4 * value.numel() for value in method.parameters()) == 3 * 8 * 4 * 14 * 14 * 4


def test_the_walk_shows_the_stack_with_marks_where_the_ray_crosses_it(wall: Scene) -> None:
    method = filled(wall)
    camera = wall.views[6].camera
    stages = method.explain(camera_rays(camera, wall.near, wall.far, np.array([(8, 8)])))
    names = [method.name(k) for k in sorted_views(method, camera)]
    assert [s.title for s in stages] == ["Nearest views", *(f"Planes of {n}" for n in names), "Blend", "All planes"]
    pictures = stages[1].charts[0]
    assert isinstance(pictures, Pictures)
    assert len(pictures.images) == len(pictures.marks) == 8
    point = camera.c2w[:, 3]
    direction = camera_rays(camera, 2.0, 8.0, np.array([(8, 8)])).directions[0].double().numpy()
    stack = method.stacks[sorted_views(method, camera)[0]]
    for plane, (image, mark) in enumerate(zip(pictures.images, pictures.marks, strict=True)):
        assert image.shape == (18, 18, 4)  # the whole plane with its border
        assert (image[[0, -1], :, 3] == 0).all()
        t = (float(stack.depths[plane]) + point[2] - 4) / -direction[2]
        (pixel,), _ = wall.views[stack.view].camera.project((point + t * direction)[None])
        np.testing.assert_allclose(mark, pixel + BORDER, atol=1e-3)


def test_a_photo_that_is_larger_than_its_planes_is_averaged(facing: Scene) -> None:
    stack = Stack.of(0, facing.views[0].camera, (2.0, 8.0), 2, 8, 0.0, CPU)  # a texel has 2 × 2 pixels
    photo = Photo(facing, 0, stack, stack.points().float())
    blocks = facing.images[0].reshape(8, 2, 8, 2, 3).mean((1, 3)) / 65535
    colors, shown = photo.onto(3.0)
    np.testing.assert_allclose(colors[:, 1:-1, 1:-1].permute(1, 2, 0), blocks, atol=1e-4)
    assert shown[1:-1, 1:-1].all()


def with_a_painted_subject(wall: Scene, masks: bool) -> Scene:
    """The wall, in front of which each photo has a red square at another place; masks: it is masked, and its edge."""
    images, hidden = [], {}
    for k, image in enumerate(wall.images):
        top = 2 * (k % 4)
        painted, mask = image.copy(), np.ones((16, 16), bool)
        painted[top + 1 : top + 5, 6:10] = (65535, 0, 0)
        mask[top + 1 : top + 5, 6:10] = False
        images.append(painted)
        hidden[k] = mask
    photos = Photos.of(images)
    return replace(wall, photos=photos.masked(hidden) if masks else photos)


@pytest.mark.parametrize("resolution", [16, 8])
def test_masked_pixels_are_not_swept(wall: Scene, resolution: int) -> None:
    """With masks, a moving subject changes neither depths nor colours: the planes are those of the plain wall."""
    found = []
    for scene in (wall, with_a_painted_subject(wall, True), with_a_painted_subject(wall, False)):
        stack = Stack.of(0, scene.views[0].camera, (2.0, 8.0), 5, resolution, 0.0, CPU)
        alpha, color = sweep(scene, (0, 1, 2, 3, 4), stack, 5, 3, 0.01, lambda: None)
        seen = look(alpha, color, stack.crossings(camera_rays(scene.views[0].camera, 2.0, 8.0)).at)
        found.append(seen.color.view(3, 16, 16)[:, 3:-3, 3:-3])
    plain, masked, painted = found
    assert float((masked - plain).abs().max()) < 0.1
    assert float((painted - plain).abs().max()) > 0.25
    assert bool(torch.isfinite(masked).all())


def test_a_texel_that_all_photos_mask_stays_finite(wall: Scene) -> None:
    mask = np.ones((16, 16), bool)
    mask[2:14, 2:14] = False
    scene = replace(wall, photos=wall.photos.masked(dict.fromkeys(range(len(wall.views)), mask)))
    stack = stack_of(scene.views[0].camera)
    alpha, color = sweep(scene, (0, 1, 2), stack, 5, 3, 0.01, lambda: None)
    assert bool(torch.isfinite(alpha).all())
    assert bool(torch.isfinite(color).all())


def test_masked_pixels_are_not_trained_on(wall: Scene) -> None:
    """What is behind the mask makes no difference, bit for bit."""
    states = []
    for value in (0, 65535):
        scene = with_a_painted_subject(wall, True)
        kept = scene.photos.kept
        assert kept is not None
        flat = np.where(kept[:, None], scene.photos.flat, np.uint16(value))
        scene = replace(scene, photos=replace(scene.photos, flat=flat))
        trainer = Trainer(scene, RunSettings(method="mpi", changes=SMALL, steps=12, device="cpu", threads=1))
        for _ in range(6):
            trainer.step()
        states.append(trainer.state())
    for name, values in states[0].items():
        if "planes" in name:
            assert torch.equal(values, states[1][name]), name
