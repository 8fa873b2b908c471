"""Lenses of every kind against pycolmap, OpenCV's published formulas, and their own inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.datasets.calibration import oddities
from nerf_core.datasets.formats.colmap import LENSES
from nerf_core.geometry.camera import Camera, project
from nerf_core.geometry.camera_files import camera_of, camera_values
from nerf_core.geometry.cameras import Cameras, camera_rays
from nerf_core.geometry.coverage import Coverage
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, Lens, fisheye_radius

SIZE = 400, 300
RAYS = 1e-6  # radians: float32 directions have 6e-8
RATIONAL = Lens(k1=0.3, k2=-0.1, k3=0.02, p1=0.003, p2=-0.002, k4=0.25, k5=-0.05, k6=0.01)
MODELS = {  # {COLMAP's camera model: its parameters}
    "SIMPLE_PINHOLE": [320, 195, 160],
    "PINHOLE": [320, 310, 195, 160],
    "SIMPLE_RADIAL": [320, 195, 160, -0.08],
    "RADIAL": [320, 195, 160, -0.1, 0.03],
    "OPENCV": [320, 310, 195, 160, -0.1, 0.03, 0.002, -0.001],
    "FULL_OPENCV": [320, 310, 195, 160, 0.3, -0.1, 0.003, -0.002, 0.02, 0.25, -0.05, 0.01],
    "OPENCV_FISHEYE": [180, 175, 195, 160, -0.02, 0.006, -0.002, 0.0003],
    "SIMPLE_RADIAL_FISHEYE": [190, 195, 160, -0.02],
    "RADIAL_FISHEYE": [190, 195, 160, -0.02, 0.004],
}
wide = st.one_of(
    st.builds(Lens, k1=st.floats(-0.03, 0.1), k2=st.floats(-0.002, 0.02), kind=st.just(FISHEYE)),
    st.builds(Lens, k1=st.floats(-0.01, 0.05), k3=st.floats(0, 1e-4), k4=st.floats(0, 1e-5), kind=st.just(FISHEYE)),
    st.just(Lens(kind=EQUIRECTANGULAR)),
)


def camera_of_lens(lens: Lens, focal: float = 110.0, seed: int = 0) -> Camera:
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    c2w = np.column_stack([q * np.linalg.det(q), [0.3, -0.2, 0.5]])
    if lens.kind == EQUIRECTANGULAR:
        return Camera(*SIZE, SIZE[0] / 2 / np.pi, SIZE[1] / np.pi, SIZE[0] / 2, SIZE[1] / 2, c2w, lens)
    return Camera(*SIZE, focal, focal, 195.0, 160.0, c2w, lens)


def pixels(seed: int = 0, count: int = 500) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (count, 2)) * SIZE


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between vectors (P, 3), in radians; arccos of a product would lose half the digits."""
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a.astype(np.float64), b.astype(np.float64)))
    return 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1))


def rays_of(camera: Camera, at: np.ndarray) -> np.ndarray:
    rays = Cameras([camera], 1.0, 4.0).rays(torch.zeros(len(at), dtype=torch.long), torch.from_numpy(at))
    return rays.directions.double().numpy() @ camera.c2w[:, :3]


def lens_of(model: str, parameters: list[float]) -> Camera:
    values = dict(zip(LENSES[model], map(float, parameters), strict=True))
    focal = values.pop("f", 1.0)
    fx, fy, cx, cy = values.pop("fx", focal), values.pop("fy", focal), values.pop("cx"), values.pop("cy")
    return Camera(*SIZE, fx, fy, cx, cy, np.eye(4)[:3], Lens(**values, kind=FISHEYE if "FISHEYE" in model else 0))


@pytest.mark.parametrize("model", LENSES)
def test_rays_are_those_of_colmap(model: str) -> None:
    theirs = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=MODELS[model])
    mine, at = lens_of(model, MODELS[model]), pixels()
    plane = np.asarray(theirs.cam_from_img(at), np.float64)
    expected = np.stack([plane[:, 0], -plane[:, 1], -np.ones(len(plane))], -1)
    seen = np.isfinite(plane).all(-1) & (np.linalg.norm(plane, axis=-1) < 5)  # COLMAP's plane ends at 90°
    assert seen.mean() > 0.9
    assert angles(rays_of(mine, at), expected)[seen].max() < RAYS
    back = np.asarray(
        theirs.img_from_cam(np.stack([plane[:, 0], plane[:, 1], np.ones(len(plane))], -1)[seen]), np.float64
    )
    np.testing.assert_allclose(mine.project(expected[seen])[0], back, atol=1e-6)


def test_a_fisheye_lens_is_opencvs() -> None:
    """θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), u = fx θ_d x / r + cx (OpenCV, calib3d, fisheye), to 130°."""
    k1, k2, k3, k4 = -0.02, 0.006, -0.001, 0.0001
    fx, fy, cx, cy = 80.0, 78.0, 195.0, 160.0
    camera = Camera(*SIZE, fx, fy, cx, cy, np.eye(4)[:3], Lens(k1=k1, k2=k2, k3=k3, k4=k4, kind=FISHEYE))
    rng = np.random.default_rng(1)
    theta, turn = rng.uniform(1e-6, np.radians(130), 2000), rng.uniform(-np.pi, np.pi, 2000)
    direction = np.stack([np.sin(theta) * np.cos(turn), -np.sin(theta) * np.sin(turn), -np.cos(theta)], -1)
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    u, v = fx * theta_d * np.cos(turn) + cx, fy * theta_d * np.sin(turn) + cy
    at = np.stack([u, v], -1)
    assert angles(rays_of(camera, at), direction).max() < RAYS
    found, depth = camera.project(3 * direction)
    np.testing.assert_allclose(found, at, atol=1e-9)
    np.testing.assert_allclose(depth, 3, rtol=1e-12)


def test_an_equirectangular_picture_shows_longitude_and_latitude() -> None:
    camera = replace(camera_of_lens(Lens(kind=EQUIRECTANGULAR)), c2w=np.eye(4)[:3])
    width, height = SIZE
    at = np.array([(width / 2, height / 2), (0.75 * width, height / 2), (width / 2, 0), (1e-9, height / 2)])
    expected = np.array([(0, 0, -1), (1, 0, 0), (0, 1, 0), (0, 0, 1)])  # ahead, right, up, behind
    np.testing.assert_allclose(rays_of(camera, at), expected, atol=1e-7)


@given(wide, st.integers(0, 1000))
def test_projection_inverts_a_wide_lens_s_rays(lens: Lens, seed: int) -> None:
    camera, at = camera_of_lens(lens, seed=seed), pixels(seed, 50)
    shown = np.linalg.norm((at - (195, 160)) / 110, axis=-1) < lens.reach()
    rays = Cameras([camera], 1.5, 9.0).rays(torch.zeros(50, dtype=torch.long), torch.from_numpy(at))
    assert (rays.near == 1.5).all()
    assert (rays.far == 9.0).all()
    found, depth = camera.project((rays.origins + rays.far[:, None] * rays.directions).double().numpy())
    np.testing.assert_allclose(found[shown], at[shown], atol=2e-3)
    np.testing.assert_allclose(depth, 9.0, rtol=1e-6)


@given(st.one_of(wide, st.just(RATIONAL)), st.integers(0, 1000))
def test_compiled_rays_of_mixed_lenses_equal_those_of_numpy(lens: Lens, seed: int) -> None:
    cameras = Cameras([camera_of_lens(lens), camera_of_lens(RATIONAL, 300.0), camera_of_lens(Lens())], 1.0, 4.0)
    index, at = torch.arange(60) % 3, torch.from_numpy(pixels(seed, 60))
    compiled, plain = cameras.rays(index, at), cameras.plain_rays(index, at)
    torch.testing.assert_close(compiled.directions, plain.directions, atol=1e-6, rtol=0)
    torch.testing.assert_close(compiled.near, plain.near)
    torch.testing.assert_close(compiled.far, plain.far)


@given(wide, st.integers(0, 1000))
def test_points_may_have_a_lens_of_another_kind_each(lens: Lens, seed: int) -> None:
    cameras = [camera_of_lens(lens), camera_of_lens(RATIONAL, 300.0), camera_of_lens(Lens())]
    local = np.random.default_rng(seed).standard_normal((30, 3))
    index = np.arange(30) % 3
    together = project(local, np.array([cameras[i].intrinsics() for i in index]))
    for k, camera in enumerate(cameras):
        alone = project(local[index == k], np.array(camera.intrinsics(), np.float64))
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_array_equal(a[index == k], b)


@given(st.tuples(*[st.floats(-20, 20)] * 4))
def test_an_absurd_fisheye_lens_gives_no_broken_rays(k: tuple[float, ...]) -> None:
    camera = camera_of_lens(Lens(k1=k[0], k2=k[1], k3=k[2], k4=k[3], kind=FISHEYE))
    rays = camera_rays(camera, 1.0, 4.0, pixels().astype(int))
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(len(rays)))
    found, _ = camera.project(np.random.default_rng(0).standard_normal((50, 3)))
    assert not np.isinf(found).any()
    oddities([camera])


def test_beyond_its_fold_a_fisheye_lens_shows_nothing() -> None:
    lens = Lens(k1=-0.1, kind=FISHEYE)  # falls from θ = √(1 / 0.3)
    fold = (1 / 0.3) ** 0.5
    assert lens.reach() == pytest.approx(fisheye_radius(fold, -0.1, 0, 0, 0)[0])
    np.testing.assert_allclose(lens.angle(np.array([0.0, lens.reach() + 1, 1e300])), [0, fold, fold], atol=1e-6)
    before, after = (np.array([[np.sin(t), 0, -np.cos(t)]]) for t in (fold - 0.1, fold + 0.1))
    assert lens.see(before).shown.tolist() == [True]
    assert lens.see(after).shown.tolist() == [False]
    camera = camera_of_lens(lens, focal=100.0)
    (note,) = oddities([camera, camera])
    assert note.startswith(f"2 photos with corners beyond {np.degrees(fold):.3g}° from the axis")
    assert not oddities([camera_of_lens(Lens(kind=EQUIRECTANGULAR)), camera_of_lens(Lens(kind=FISHEYE), 130.0)])


def test_space_behind_a_fisheye_camera_is_covered() -> None:
    """The camera sees up to 2.4 radians aside and to 2 upwards."""
    camera = replace(camera_of_lens(Lens(kind=FISHEYE), focal=80.0), c2w=np.eye(4)[:3])
    found = Coverage.of([camera], 0.5, 2.0, np.zeros(3), 2.0)
    points = 1.8 * np.array([[np.sin(2.2), 0, -np.cos(2.2)], [0, np.sin(2.7), -np.cos(2.7)], [0, 0, -1]])
    cells = ((points - found.low) / found.side).astype(int)
    assert [bool(found.covered[tuple(cell)]) for cell in cells] == [True, False, True]


@pytest.mark.parametrize("lens", [RATIONAL, Lens(k4=0.1, kind=FISHEYE), Lens(kind=EQUIRECTANGULAR)])
def test_a_camera_file_keeps_the_lens(lens: Lens) -> None:
    camera = camera_of_lens(lens)
    assert camera_of(camera_values(camera)).lens == lens
    with pytest.raises(ValueError, match="lens is 'pinhole': perspective, fisheye, equirectangular are known"):
        camera_of(camera_values(camera) | {"lens": "pinhole"})
