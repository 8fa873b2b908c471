"""Opened pixels as files, and cameras as command lines name them."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from balls import Ball, looking, model_of, ring_scene
from hypothesis import given
from hypothesis import strategies as st
from panel_states import odd_opened

from nerf_core.camera_files import camera_of, camera_values, picked_camera
from nerf_core.cameras import Cameras
from nerf_core.errors import UserError
from nerf_core.probe import Opened, RayHistory, open_pixel, write_inspection
from nerf_core.scene import Scene, View

RED = Ball((0.0, 0.0, 0.0), 0.7, (0.8, 0.2, 0.15))


@pytest.fixture(scope="module")
def opened() -> Opened:
    scene = ring_scene(RED, count=6, size=12)
    return open_pixel(model_of(scene, RED), scene, looking((4.0, 0.0, 0.9), 13), (6, 6), 7)


def test_json_and_npz_hold_the_same_arrays(opened: Opened, tmp_path: Path) -> None:
    for file in (tmp_path / "a.json", tmp_path / "a.npz"):
        write_inspection([opened], file)
    text, arrays = json.loads((tmp_path / "a.json").read_text()), np.load(tmp_path / "a.npz", allow_pickle=False)
    assert text["pixel"] == arrays["pixel"].tolist() == [6, 6]
    assert text["verdict"]["kind"] == str(arrays["verdict/kind"]) == "surface"
    for name in ("t", "until", "sigma", "weights", "rgb"):
        found = arrays[f"passes/1/{name}"]
        np.testing.assert_array_equal(found, getattr(opened.ray.passes[1], name))
        np.testing.assert_allclose(np.array(text["passes"][1][name], float)[:-1], found[:-1], rtol=1e-6)
    assert opened.radiance is not None
    assert opened.evidence is not None
    np.testing.assert_allclose(text["radiance"]["frozen_rgb"], opened.radiance.frozen_rgb, atol=1e-7)
    np.testing.assert_array_equal(arrays["evidence/views"], opened.evidence.views)


def test_csv_has_a_line_a_sample(opened: Opened, tmp_path: Path) -> None:
    write_inspection([opened, opened], tmp_path / "a.csv")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "a.csv").read_text())))
    assert len(rows) == 2 * sum(len(p.t) for p in opened.ray.passes)
    last = [row for row in rows if row["ray"] == "1" and row["pass"] == "fine"]
    np.testing.assert_allclose([float(row["weights"]) for row in last], opened.ray.passes[1].weights)
    np.testing.assert_allclose([float(row["green"]) for row in last], opened.ray.passes[1].rgb[:, 1])


@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("svg", b"<?xml")])
def test_a_figure_is_drawn_of_any_ray(opened: Opened, tmp_path: Path, kind: str, begin: bytes) -> None:
    for name, some in (("one", [opened]), ("two", [opened, replace(opened, radiance=None, evidence=None)]),
                       ("odd", [odd_opened()]), ("nothing", [met_nothing(opened)])):  # fmt: skip
        file = tmp_path / f"{name}.{kind}"
        write_inspection(some, file)
        assert file.read_bytes().startswith(begin)
        assert file.stat().st_size > 5_000


def met_nothing(opened: Opened) -> Opened:
    """As packed methods open a ray through empty space: a pass without samples."""
    one = opened.ray.passes[-1]
    empty = replace(one, **{f.name: getattr(one, f.name)[:0] for f in fields(one) if f.name != "name"})
    depths = dict.fromkeys(("depth_expected", "depth_median", "depth_strongest"))
    return replace(opened, ray=replace(opened.ray, passes=(empty,), opacity=0.0, **depths), verdict=None)


def test_a_file_says_what_it_is_of(opened: Opened, tmp_path: Path) -> None:
    steps, edges = np.array([0, 3]), np.linspace(2, 6, 5)
    history = RayHistory(edges, steps, np.ones((2, 4)), np.ones((2, 3)), np.array([np.nan, 3.0]), np.ones(2))
    write_inspection([replace(opened, name="the ball", history=history), opened], tmp_path / "a.json")
    first, second = json.loads((tmp_path / "a.json").read_text())["rays"]
    assert (first["scene"], first["method"], first["name"]) == ("balls", "nerf", "the ball")
    assert first["history"]["steps"] == [0, 3]
    assert first["history"]["depth"] == [None, 3.0]
    assert "name" not in second
    assert "history" not in second
    assert opened.evidence is not None
    assert first["evidence"]["photos"] == [opened.scene.views[k].name for k in opened.evidence.views]
    write_inspection([replace(opened, name="the ball $^$")], tmp_path / "a.svg")
    text = (tmp_path / "a.svg").read_text()
    assert "the ball $^$: surface" in text
    assert "balls, nerf, step 7" in text


def test_what_cannot_be_written_is_told(opened: Opened, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"ray\.txt: an opened ray is written as \.json, \.npz, \.csv, \.png, \.svg"):
        write_inspection([opened], tmp_path / "ray.txt")
    with pytest.raises(UserError, match="there is no opened ray"):
        write_inspection([], tmp_path / "ray.json")
    assert not list(tmp_path.iterdir())


# ---- cameras ------------------------------------------------------------------------------------------------------


def test_a_camera_comes_back_from_its_values() -> None:
    camera = replace(looking((4.0, 1.0, 0.9), 13), k1=0.1, p2=-0.01)
    again = camera_of(json.loads(json.dumps(camera_values(camera))))
    assert again.intrinsics() == camera.intrinsics()
    np.testing.assert_array_equal(again.c2w, camera.c2w)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0},
        {"fx": 1e-300},
        {"fy": 1e300},
        {"fy": "nan"},
        {"cx": 1e300},
        {"cy": "-inf"},
        {"k1": 1e300},
        {"p2": "nan"},
        {"width": 1 << 20},
        {"height": None},
        {"c2w": "no"},
        {"c2w": [[1, 0, 0, 0]] * 3},
        {"c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]},
        {"c2w": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]},
        {"c2w": [[float("nan"), 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]},
    ],
    ids=str,
)
def test_values_that_are_no_camera_are_refused(change: dict[str, object], tmp_path: Path) -> None:
    values = camera_values(looking((4.0, 1.0, 0.9), 13)) | change
    with pytest.raises((ValueError, TypeError)):
        camera_of(values)
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(values))
    with pytest.raises(UserError, match=r"camera\.json.*(holds no camera|is nan)"):
        picked_camera(scene_of("a"), str(file))


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ([], r"camera\.json holds \[\]: an object as an opened ray's file has under \"camera\" \(width, height, fx, "),
        ({}, r"holds no camera \(field width is missing\): an object as an opened ray's file has under \"camera\""),
        ({"camera": 5}, r"holds no camera \(5 is no object\)"),
        ({"camera": {"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2}}, r"\(field c2w is missing\)"),
    ],
    ids=str,
)
def test_a_file_that_holds_no_camera_is_told_what_one_is(document: object, words: str, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(document))
    with pytest.raises(UserError, match=words):
        picked_camera(scene_of("a"), str(file))


extreme = st.sampled_from([-1.0, -1e-3, 0.0, 1e-3, 1.0])


@given(
    st.sampled_from([1e-3, 1.0, 100.0, 1e9]), st.tuples(*[extreme] * 2), st.tuples(*[extreme] * 5),
    st.tuples(*[extreme] * 3),
)  # fmt: skip
def test_every_camera_that_is_taken_has_rays_of_numbers(
    focal: float, principal: tuple[float, ...], lens: tuple[float, ...], place: tuple[float, ...]
) -> None:
    values = camera_values(looking((4.0, 1.0, 0.9), 3))
    c2w = np.concatenate([np.eye(3), 1e9 * np.array(place)[:, None]], 1).tolist()
    values |= {"fx": focal, "fy": focal, "cx": 1e9 * principal[0], "cy": 1e9 * principal[1], "c2w": c2w}
    values |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (1e6 * k for k in lens), strict=True))
    camera = camera_of(values)
    pixels = torch.tensor([[0.5, 0.5], [2.5, 1.5], [1.0, 2.75]])
    cameras, nobody = Cameras([camera], 2.0, 6.0), torch.zeros(3, dtype=torch.long)
    for rays in (cameras.rays(nobody, pixels), cameras.plain_rays(nobody, pixels)):
        assert all(bool(v.isfinite().all()) for v in (rays.origins, rays.directions, rays.near, rays.far))
        torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(3))


def scene_of(*names: str) -> Scene:
    scene = ring_scene(RED, count=max(len(names), 1), size=4)
    views = tuple(View(name, view.camera) for name, view in zip(names, scene.views, strict=True))
    return replace(scene, views=views)


def test_a_photo_is_picked_by_its_name_or_its_end(opened: Opened, tmp_path: Path) -> None:
    scene = scene_of("train/r_1.png", "train/r_11.png", "test/r_1.png")
    assert picked_camera(scene, "train/r_1.png") is scene.views[0].camera
    assert picked_camera(scene, "r_11") is scene.views[1].camera
    with pytest.raises(UserError, match=r"--camera 'r_1': means 2 photos \('train/r_1\.png', 'test/r_1\.png'\): give"):
        picked_camera(scene, "r_1")
    with pytest.raises(UserError, match=r"--camera 'r_7': is none of the 3 photos \([^…]*\): give"):
        picked_camera(scene, "r_7")
    with pytest.raises(UserError, match=r"is none of the 4 photos \('a', 'b', 'c', …\): give"):
        picked_camera(scene_of("a", "b", "c", "d"), "r_7")
    write_inspection([opened], tmp_path / "ray.json")
    again = picked_camera(scene, str(tmp_path / "ray.json"))
    np.testing.assert_array_equal(again.c2w, opened.camera.c2w)
