"""Files of opened pixels, and cameras given on the command line."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import fields, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from balls import Ball, looking, model_of, ring_scene
from hypothesis import given
from hypothesis import strategies as st
from panel_states import bare_ray, bare_snapshot, make_opened, make_ray, odd_opened

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera_files import camera_of, camera_values, picked_camera
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.scene import Scene, View
from nerf_core.probe import FAR_DEGREES, Opened, PassProbe, RayHistory, inspection, open_pixel, write_inspection
from nerf_core.probe.axis import FEWEST
from nerf_core.probe.figure import page
from nerf_core.probe.layers import grain_at
from nerf_core.probe.records import WITHOUT_SAMPLES

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
    for name in ("evidence/photos", "verdict/reasons"):
        group, key = name.split("/")
        assert arrays[name].dtype.kind == "U"
        assert arrays[name].tolist() == text[group][key] != []


def test_npz_holds_lists_without_texts(opened: Opened, tmp_path: Path) -> None:
    assert opened.verdict is not None
    assert opened.evidence is not None
    none = opened.evidence.at(np.zeros(0, np.int64))
    write_inspection([replace(opened, verdict=replace(opened.verdict, reasons=()), evidence=none)], tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        for name in ("evidence/photos", "verdict/reasons"):
            assert arrays[name].shape == (0,)
            assert arrays[name].dtype.kind == "U"


def test_csv_has_one_line_per_sample(opened: Opened, tmp_path: Path) -> None:
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
    """A ray through empty space as packed methods open it: its pass has no samples."""
    one = opened.ray.passes[-1]
    empty = replace(one, **{f.name: getattr(one, f.name)[:0] for f in fields(one) if f.name != "name"})
    depths = dict.fromkeys(("depth_expected", "depth_median", "depth_strongest"))
    return replace(opened, ray=replace(opened.ray, passes=(empty,), opacity=0.0, **depths), verdict=None)


# ---- the figure ---------------------------------------------------------------------------------------------------


def axes_of(some: Opened) -> dict[str, Any]:
    axes = page([some]).axes
    return dict(zip(("top", "marks", "middle", "strip", "disc"), axes, strict=True))


def with_pass(some: Opened, t: list[float], until: list[float], weights: list[float]) -> Opened:
    """The ray with one pass of the given samples. It has no depths, so none are marked."""
    arrays = [np.array(v, np.float32) for v in (t, until, weights)]
    transmittance = 1 - np.cumsum(arrays[2]) + arrays[2]
    one = PassProbe("made", arrays[0], arrays[1], arrays[1] - arrays[0], arrays[2], arrays[2] / transmittance,
                    transmittance, arrays[2], np.full((len(t), 3), 0.5, np.float32))  # fmt: skip
    depths = dict.fromkeys(("depth_expected", "depth_median", "depth_strongest"))
    ray = replace(some.ray, near=2.0, far=6.0, passes=(one,), opacity=float(np.sum(weights)), **depths)
    return replace(some, ray=ray, radiance=None, evidence=None)


def test_a_figure_shows_the_part_with_the_weight(opened: Opened) -> None:
    ray, radiance = opened.ray, opened.radiance
    assert radiance is not None
    axes = axes_of(opened)
    low, high = axes["top"].get_xlim()
    assert ray.near <= low < high <= ray.far
    assert high - low < 0.5 * (ray.far - ray.near)
    assert axes["strip"].get_xlabel().endswith(f"part of near {ray.near:.3g} … far {ray.far:.3g} (strip)")
    last = ray.passes[-1]
    assert last.weights[(last.t >= low) & (last.until <= high)].sum() > 0.99 * last.weights.sum()
    for t in (ray.depth_expected, ray.depth_median, ray.depth_strongest, radiance.t):
        assert t is not None
        assert low < t < high
    low, high = axes_of(with_pass(opened, [3.0], [3.0001], [0.9]))["top"].get_xlim()
    assert low < 3 < high
    assert high - low == pytest.approx(FEWEST * grain_at(3.0, opened.scene.radius), rel=1e-3)
    t = ray.near + 0.1
    assert axes_of(replace(opened, radiance=replace(radiance, t=t)))["top"].get_xlim()[0] < t


@pytest.mark.parametrize(
    ("t", "weights", "whole"),
    [
        ([2.0, 3.0, 4.0, 5.0], [0.2, 0.2, 0.2, 0.2], True),
        ([2.0, 3.0, 4.0, 5.0], [1e-4, 0.9, 1e-4, 1e-4], False),
        ([2.0, 3.0, 4.0, 5.0], [0.0, 0.04, 0.0, 0.0], True),
    ],
)
def test_a_figure_shows_the_whole_ray_if_its_weight_is_spread_or_low(
    opened: Opened, t: list[float], weights: list[float], whole: bool
) -> None:
    axes = axes_of(with_pass(opened, t, [v + 1 for v in t], weights))
    low, high = axes["top"].get_xlim()
    assert (low, high) == (2, 6) if whole else (2 < low < 3 and 4 < high < 6)
    assert ("part of" in axes["strip"].get_xlabel()) == (not whole)


def test_the_figure_of_an_empty_ray_says_so(opened: Opened) -> None:
    for some, said in (
        (met_nothing(opened), {"the ray met nothing", "no samples"}),
        (with_pass(opened, [3.0], [3.1], [0.01]), {"the ray met nothing"}),
        (with_pass(opened, [3.0], [3.1], [0.06]), set()),
        (odd_opened(), {"the ray's weights are not numbers"}),
    ):
        axes = axes_of(some)
        assert {text.get_text() for part in (axes["top"], axes["middle"]) for text in part.texts} == said
        low, high = axes["top"].get_xlim()
        assert (low <= some.ray.near and high >= some.ray.far) == bool(said)


def test_a_tiny_weight_is_not_scaled_up(opened: Opened) -> None:
    for weight, height in ((0.01, 0.01), (0.06, 1.0)):
        line = axes_of(with_pass(opened, [3.0], [3.1], [weight]))["top"].lines[0]
        assert max(line.get_ydata()) == pytest.approx(height)


def test_equal_depths_are_marked_in_rows_of_their_own(opened: Opened) -> None:
    depths = dict.fromkeys(("depth_expected", "depth_median", "depth_strongest"), 3.5)
    marks = axes_of(replace(opened, ray=replace(opened.ray, **depths)))["marks"]
    rows = dict(zip((text.get_text() for text in marks.get_yticklabels()), marks.get_yticks(), strict=True))
    assert list(rows) == ["expected depth", "median depth", "strongest w"]
    drawn = [line for line in marks.lines if line.get_label() in rows]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in drawn] == [(3.5, y) for y in rows.values()]
    size = 200 / 72 * max(line.get_markersize() + line.get_markeredgewidth() for line in drawn)
    heights = np.sort([line.get_transform().transform((3.5, line.get_ydata()[0]))[1] for line in drawn])
    assert np.diff(heights).min() > size
    marks = axes_of(replace(opened, ray=replace(opened.ray, depth_median=None)))["marks"]
    assert [text.get_text() for text in marks.get_yticklabels()] == ["expected depth", "strongest w"]


def test_the_point_is_marked_over_t(opened: Opened) -> None:
    assert opened.radiance is not None
    t = opened.radiance.t
    for some, marked in ((opened, True), (replace(opened, radiance=None, evidence=None), False)):
        axes = axes_of(some)
        for part in ("top", "middle", "strip"):
            assert any(list(line.get_xdata()) == [t, t] for line in axes[part].lines) == marked
        legend = [text.get_text() for text in axes["top"].get_legend().get_texts()]
        assert ("point" in legend) == marked


def test_the_disc_ends_at_its_circle(opened: Opened) -> None:
    disc = axes_of(opened)["disc"]
    path = disc.images[0].get_clip_path()
    corners = disc.transData.transform([(-1, -1), (1, 1)])
    np.testing.assert_allclose(path.get_fully_transformed_path().get_extents().get_points(), corners, atol=0.1)
    assert disc.images[0].get_array().min() > 0  # coloured up to the circle: nothing black, nothing empty


def test_the_disc_is_hatched_where_no_photo_looked_from(opened: Opened) -> None:
    """Checks the page pixel by pixel. The ball has one colour, so any other colour is a stripe or a mark."""
    radiance, evidence = opened.radiance, opened.evidence
    assert radiance is not None
    assert evidence is not None
    whole = page([opened])
    whole.canvas.draw()
    disc, picture = whole.axes[4], np.asarray(whole.canvas.buffer_rgba())[::-1, :, :3] / 255
    (left, low), (right, high) = np.rint(disc.transData.transform([(-1, -1), (1, 1)])).astype(int)
    columns, rows = np.meshgrid(np.arange(left, right), np.arange(low, high))
    places = disc.transData.inverted().transform(np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2))
    seen = evidence.directions[evidence.seen]
    marks = radiance.disc_position(np.concatenate([seen, -opened.ray.direction[None]]))
    apart = np.linalg.norm(places[:, None] - marks[np.isfinite(marks).all(-1)], axis=-1).min(-1)
    clean = (apart > 0.1) & (np.linalg.norm(places, axis=-1) < 0.95)
    places, other = places[clean], np.abs(picture[rows, columns] - RED.color).max(-1).ravel()[clean] > 0.1
    directions = np.column_stack([places, np.sqrt(1 - (places**2).sum(-1))]) @ radiance.axes
    nearest = np.degrees(np.arccos((directions @ seen.T).max(-1)))
    assert not other[nearest < FAR_DEGREES - 3].any()
    far = nearest > FAR_DEGREES + 3
    for side in (places[:, 0] < 0, places[:, 0] >= 0):
        assert 0.03 < other[far & side].mean() < 0.5
    assert "hatched: no photo looked from there" in disc.get_xlabel()


def test_colours_that_touch_have_no_seam_and_gaps_stay(opened: Opened) -> None:
    strip = axes_of(with_pass(opened, [2.0, 2.5, 3.5], [2.5, 3.0, 4.0], [0.1, 0.1, 0.1]))["strip"]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in strip.patches]
    assert bars == [(2, 3), (2.5, 3), (3.5, 4)]


def long_name(some: Opened, name: str) -> Opened:
    return replace(some, name=name, scene=replace(some.scene, name=70 * "m"))


def test_a_title_begins_with_a_capital_or_with_its_name(opened: Opened) -> None:
    for some, title in ((opened, "Surface"), (replace(opened, name="the ball"), "the ball: surface"),
                        (replace(opened, verdict=None), "A ray")):  # fmt: skip
        words, under = (text.get_text() for text in page([some]).texts)
        assert words == title
        assert under.startswith("Pixel 6, 6 of 13 × 13, balls, nerf, step 7")


def words_of(axes: Any) -> list[Any]:
    """The texts that are drawn. A tick's label is drawn only if the tick is in view."""
    found = [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        ticks = axis.get_major_ticks() if axis.get_visible() else []
        found += [tick.label1 for tick in ticks if low <= tick.get_loc() <= high]
    legend = axes.get_legend()
    found += legend.get_texts() if legend is not None else []
    return [text for text in found if text.get_visible() and text.get_text().strip()]


def test_texts_stay_on_the_page_and_do_not_overlap(opened: Opened) -> None:
    named = long_name(opened, "the rim of the glossy ball, against the highlight of the left window")
    assert page([named]).texts[0].get_text().replace("\n", " ") == f"{named.name}: surface"
    letters = [long_name(opened, name) for name in (200 * "W", 60 * "il ", 20 * "white wall ")]
    assert all("…" in page([one]).texts[0].get_text() for one in letters[::2])
    for some in ([opened], [named], [make_opened(make_ray())], [met_nothing(opened)], letters):
        whole = page(some)
        whole.canvas.draw()
        for top, marks in zip(whole.axes[::5], whole.axes[1::5], strict=True):
            assert top.get_legend().get_window_extent().y0 >= marks.bbox.y1
        texts = [*whole.texts, *(text for axes in whole.axes for text in words_of(axes))]
        boxes = [(text.get_text(), text.get_window_extent()) for text in texts]
        assert len(boxes) > 10
        for name, box in boxes:
            assert box.x0 >= 0, name
            assert box.y0 >= 0, name
            assert box.x1 <= whole.bbox.x1, name
            assert box.y1 <= whole.bbox.y1, name
        for (one, box), (other, there) in combinations(boxes, 2):
            assert not box.overlaps(there), (one, other)


def test_a_file_names_the_scene_the_method_and_the_ray(opened: Opened, tmp_path: Path) -> None:
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


def bare(visits: int, depth: float | None) -> Opened:
    """An opened pixel of a method without samples."""
    opened = bare_snapshot(bare_ray(visits, depth)).opened
    assert opened is not None
    return opened


@pytest.mark.parametrize(("visits", "depth"), [(10, 3.8), (0, None)])
def test_files_of_a_ray_without_samples_say_so_and_have_its_visits(
    visits: int, depth: float | None, tmp_path: Path
) -> None:
    one = bare(visits, depth)
    for kind in ("json", "npz", "csv", "png", "svg"):
        write_inspection([one], tmp_path / f"a.{kind}")
    text, arrays = json.loads((tmp_path / "a.json").read_text()), np.load(tmp_path / "a.npz", allow_pickle=False)
    assert text["lacks"] == str(arrays["lacks"]) == WITHOUT_SAMPLES
    assert text["passes"] == []
    np.testing.assert_allclose(text["visited"], one.ray.visited)
    np.testing.assert_array_equal(arrays["visited"], one.ray.visited)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "a.csv").read_text())))
    np.testing.assert_allclose([float(row["t"]) for row in rows], one.ray.visited)
    assert {(row["pass"], row["sigma"], row["weights"], row["blue"]) for row in rows} <= {("visited", "", "", "")}
    svg = (tmp_path / "a.svg").read_text()
    assert "keeps no samples along a ray" in svg
    assert ("no samples along the ray" in svg) == (visits == 0)
    assert "lacks" not in json.dumps(inspection(make_opened(make_ray())))


def test_the_figure_of_visits_goes_down_from_the_first_to_the_last() -> None:
    axes, color = page([bare(10, 3.8)]).axes
    (way, discs, depth) = axes.lines
    np.testing.assert_allclose(discs.get_xdata(), bare_ray().visited)
    np.testing.assert_array_equal(discs.get_ydata(), np.arange(1, 11))
    assert way.get_xydata().tolist() == discs.get_xydata().tolist()
    assert set(depth.get_xdata()) == {3.8}
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
    assert [text.get_text() for text in axes.texts] == [f"{k}" for k in range(1, 11)]
    assert color.patches[0].get_facecolor()[:3] == pytest.approx(np.clip(bare_ray().color, 0, 1))
    assert len(page([bare(10, 3.8), make_opened(make_ray())]).axes) > 2  # beside a ray with samples


def test_an_unknown_suffix_and_an_empty_list_are_refused(opened: Opened, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"ray\.txt: an opened ray is written as \.json, \.npz, \.csv, \.png, \.svg"):
        write_inspection([opened], tmp_path / "ray.txt")
    with pytest.raises(UserError, match="there is no opened ray"):
        write_inspection([], tmp_path / "ray.json")
    assert not list(tmp_path.iterdir())


# ---- cameras ------------------------------------------------------------------------------------------------------


def test_a_camera_comes_back_from_its_values() -> None:
    camera = replace(looking((4.0, 1.0, 0.9), 13), lens=Lens(k1=0.1, p2=-0.01))
    again = camera_of(json.loads(json.dumps(camera_values(camera))))
    assert again.intrinsics() == camera.intrinsics()
    np.testing.assert_array_equal(again.c2w, camera.c2w)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0},
        {"fx": 1e-300},
        {"fy": 1e300},
        {"fy": float("inf")},
        {"cx": 1e300},
        {"cy": -float("inf")},
        {"k1": 1e300},
        {"p2": float("nan")},
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
    with pytest.raises(UserError, match=r"camera\.json.*(holds no camera|is (nan|-?inf))"):
        picked_camera(scene_of("a"), str(file))


FLAT = {"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2, "c2w": np.eye(3, 4).tolist()}


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ([], r"camera\.json holds \[\]: an object as an opened ray's file has under \"camera\" \(width, height, fx, "),
        ({}, r"holds no camera \(field width is missing\): an object as an opened ray's file has under \"camera\""),
        ({"camera": 5}, r"holds no camera \(5 is not an object\)"),
        ({"camera": {"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2}}, r"\(field c2w is missing\)"),
        (FLAT | {"fx": "4"}, r"\(fx is '4': a number is needed\)"),
        (FLAT | {"cy": None}, r"\(cy is None: a number is needed\)"),
        (FLAT | {"k1": [0]}, r"\(k1 is \[0\]: a number is needed\)"),
        (FLAT | {"width": True}, r"\(width is True: a number is needed\)"),
        (FLAT | {"height": 4.5}, r"\(a picture of 4 × 4\.5 pixels\)"),
        (FLAT | {"c2w": [[1, 2], [3]]}, r"\(c2w must be 3 × 4 numbers between ±1e\+09\)"),
        (FLAT | {"c2w": "abc"}, r"\(c2w must be 3 × 4 numbers"),
    ],
    ids=str,
)
def test_a_file_without_a_camera_is_refused_with_what_is_needed(document: object, words: str, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(document))
    with pytest.raises(UserError, match=words):
        picked_camera(scene_of("a"), str(file))


extreme = st.sampled_from([-1.0, -1e-3, 0.0, 1e-3, 1.0])


@given(
    st.sampled_from([1e-3, 1.0, 100.0, 1e9]), st.tuples(*[extreme] * 2), st.tuples(*[extreme] * 5),
    st.tuples(*[extreme] * 3),
)  # fmt: skip
def test_every_accepted_camera_has_finite_rays(
    focal: float, principal: tuple[float, ...], lens: tuple[float, ...], place: tuple[float, ...]
) -> None:
    values = camera_values(looking((4.0, 1.0, 0.9), 3))
    c2w = np.concatenate([np.eye(3), 1e9 * np.array(place)[:, None]], 1).tolist()
    values |= {"fx": focal, "fy": focal, "cx": 1e9 * principal[0], "cy": 1e9 * principal[1], "c2w": c2w}
    values |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (1e6 * k for k in lens), strict=True))
    camera = camera_of(values)
    pixels = torch.tensor([[0.5, 0.5], [2.5, 1.5], [1.0, 2.75]])
    cameras, zeros = Cameras([camera], 2.0, 6.0), torch.zeros(3, dtype=torch.long)
    for rays in (cameras.rays(zeros, pixels), cameras.plain_rays(zeros, pixels)):
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
    other = replace(opened, camera=scene.views[0].camera)
    write_inspection([opened, other], tmp_path / "rays.json")
    first = picked_camera(scene, str(tmp_path / "rays.json"))  # a file of several rays gives the first one's camera
    np.testing.assert_array_equal(first.c2w, opened.camera.c2w)
