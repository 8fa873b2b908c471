"""Rays against the pinhole formula, lens distortion by round trips, NDC against the map of points."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import Cameras, camera_rays
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.ndc import FARTHEST, Ndc

seeds = st.integers(0, 10_000)
mild = st.tuples(  # lenses that fold nowhere within the picture below
    st.floats(-0.15, 0.15),
    st.floats(-0.05, 0.05),
    st.floats(-0.02, 0.02),
    st.floats(-0.01, 0.01),
    st.floats(-0.01, 0.01),
)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def random_camera(seed: int, lens: tuple[float, ...] = (0, 0, 0, 0, 0)) -> Camera:
    rng = np.random.default_rng(seed)
    c2w = np.concatenate([rotation(seed), rng.uniform(-3, 3, (3, 1))], 1)
    return Camera(40, 30, 42.0, 45.0, 19.0, 16.5, c2w, Lens(*lens))


def pixels_of(camera: Camera) -> np.ndarray:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.stack([columns.ravel(), rows.ravel()], -1)


def test_a_pixel_looks_through_its_centre_along_opengl_axes() -> None:
    camera = Camera(4, 2, 10.0, 20.0, 2.0, 1.0, np.eye(4)[:3])
    rays = camera_rays(camera, 1.0, 3.0)
    for flat, (row, column) in enumerate(np.ndindex(2, 4)):
        vector = np.array([(column + 0.5 - 2) / 10, -(row + 0.5 - 1) / 20, -1])
        length = np.linalg.norm(vector)
        np.testing.assert_allclose(rays.directions[flat].numpy(), vector / length, atol=1e-6)
        assert float(rays.near[flat]) == pytest.approx(length, rel=1e-6)
        assert float(rays.far[flat]) == pytest.approx(3 * length, rel=1e-6)
    assert torch.equal(rays.origins, torch.zeros(8, 3))


def test_chosen_pixels_have_the_rays_of_the_whole_picture() -> None:
    camera = random_camera(1, (0.1, 0, 0, 0.01, 0))
    every = camera_rays(camera, 1, 2)
    some = camera_rays(camera, 1, 2, np.array([[3, 7], [39, 29]]))
    assert torch.equal(some.directions, every.directions[[7 * 40 + 3, 29 * 40 + 39]])


@given(seeds, mild)
def test_a_point_of_a_ray_projects_back_onto_its_pixel(seed: int, lens: tuple[float, ...]) -> None:
    camera = random_camera(seed, lens)
    rays = camera_rays(camera, 1.5, 9.0)
    for t in (rays.near, rays.far):
        where, depth = camera.project((rays.origins + t[:, None] * rays.directions).double().numpy())
        np.testing.assert_allclose(where, pixels_of(camera) + 0.5, atol=1e-3)
        np.testing.assert_allclose(depth, 1.5 if t is rays.near else 9.0, rtol=1e-5)


@given(seeds, mild)
def test_compiled_rays_equal_those_of_numpy(seed: int, lens: tuple[float, ...]) -> None:
    cameras = Cameras([random_camera(seed, lens), random_camera(seed + 1)], 1.0, 4.0)
    index = torch.arange(40) % 2
    pixels = torch.rand(40, 2, dtype=torch.float64) * torch.tensor([40, 30])
    compiled, plain = cameras.rays(index, pixels), cameras.plain_rays(index, pixels)
    torch.testing.assert_close(compiled.directions, plain.directions)
    torch.testing.assert_close(compiled.far, plain.far)


@given(st.tuples(*[st.floats(-20, 20)] * 5))
def test_an_absurd_lens_gives_no_broken_rays(lens: tuple[float, ...]) -> None:
    rays = camera_rays(random_camera(0, lens), 1.0, 4.0)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(1200))
    assert rays.near.isfinite().all()
    assert (rays.far >= rays.near).all()


@given(seeds, mild, st.integers(7, 90), st.integers(7, 90))
def test_a_resized_camera_sees_the_same(seed: int, lens: tuple[float, ...], width: int, height: int) -> None:
    camera = random_camera(seed, lens)
    centres = torch.rand(20, 2, dtype=torch.float64) * torch.tensor([40, 30])
    scale = torch.tensor([width / 40, height / 30], dtype=torch.float64)
    index = torch.zeros(20, dtype=torch.long)
    before = Cameras([camera], 1, 2).rays(index, centres)
    after = Cameras([camera.resized(width, height)], 1, 2).rays(index, centres * scale)
    torch.testing.assert_close(after.directions, before.directions)


def test_one_batch_mixes_cameras_of_any_size_and_lens() -> None:
    cameras = [random_camera(0), random_camera(1, (0.1, 0.02, 0, 0.005, -0.004)).resized(13, 50)]
    index = torch.tensor([1, 0, 1])
    pixels = np.array([[2, 40], [30, 20], [12, 0]])
    mixed = Cameras(cameras, 1, 2).rays(index, torch.from_numpy(pixels) + 0.5)
    for i in range(3):
        alone = camera_rays(cameras[int(index[i])], 1, 2, pixels[i : i + 1])
        torch.testing.assert_close(mixed.directions[i], alone.directions[0])
        torch.testing.assert_close(mixed.origins[i], alone.origins[0])


# ---- NDC ----------------------------------------------------------------------------------------------------------

NDC = Ndc(width=40, height=30, focal=35.0, near=1.0, far=12.0)


def forward_rays(seed: int, count: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays that start before the near plane and point to −z, in double precision."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform([-1, -1, -0.5], [1, 1, 0.5], (count, 3))
    directions = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), -np.ones((count, 1))], 1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return torch.from_numpy(origins), torch.from_numpy(directions)


@given(seeds)
def test_points_of_an_ndc_ray_are_the_projected_points_of_the_world_ray(seed: int) -> None:
    origins, directions = forward_rays(seed)
    o, d, exists = NDC.rays(origins, directions)
    assert exists.all()
    torch.testing.assert_close(o[:, 2], -torch.ones(64, dtype=torch.float64))  # t′ = 0: the near plane
    torch.testing.assert_close((o + d)[:, 2], torch.ones(64, dtype=torch.float64))  # t′ = 1: infinity
    t_ndc = torch.linspace(0, 0.9, 10, dtype=torch.float64).expand(64, 10)
    t = NDC.world_t(origins, directions, t_ndc)
    world = origins[:, None] + t[..., None] * directions[:, None]
    torch.testing.assert_close(NDC.point(world), o[:, None] + t_ndc[..., None] * d[:, None])


@given(seeds)
def test_t_is_linear_in_disparity_along_the_axis_up_to_infinity(seed: int) -> None:
    origins, directions = forward_rays(seed)
    t = NDC.world_t(origins, directions, torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64).expand(64, 3))
    depth = -(origins[:, None, 2] + t * directions[:, None, 2])
    torch.testing.assert_close(depth, torch.tensor([1.0, 2.0, FARTHEST], dtype=torch.float64).expand(64, 3))  # 1 − 1/z


def test_a_ray_that_turns_away_has_no_image_and_no_nan() -> None:
    origins = torch.zeros(4, 3)
    directions = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, 1.0, -1e-9]])
    o, d, exists = NDC.rays(origins, directions)
    assert not exists.any()
    assert o.isfinite().all()
    assert d.isfinite().all()
    assert NDC.world_t(origins, directions, torch.tensor([[0.0, 0.5, 1.0]]).expand(4, 3)).isfinite().all()
    assert NDC.point(torch.tensor([[0.0, 1.0, 0.0], [1.0, 1.0, 3.0]])).isfinite().all()


@given(seeds)
def test_a_length_in_ndc_becomes_a_world_distance(seed: int) -> None:
    origins, directions = forward_rays(seed)
    t_ndc = torch.linspace(0, 0.8, 9, dtype=torch.float64).expand(64, 9)
    t = NDC.world_t(origins, directions, t_ndc)
    delta = 0.1 * NDC.rays(origins, directions)[1].norm(dim=-1, keepdim=True).expand(64, 9)
    torch.testing.assert_close(
        NDC.stretched(origins, directions, t, delta), NDC.world_t(origins, directions, t_ndc + 0.1)
    )
