"""The capture report: what it finds in captures with known faults, and what it writes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from nerf_core.captures.report import ReportCancelled, capture_report
from nerf_core.captures.report_html import to_html, to_json, write_report
from nerf_core.captures.report_odd import robust_z
from nerf_core.captures.sharpness import measure_photo, thumbnail
from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View

SIZE = 96


def textured(seed: int = 0) -> np.ndarray:
    """A photo (SIZE, SIZE, 3) uint16 with about the same contrast at every scale, as natural ones have."""
    rng = np.random.default_rng(seed)
    value = np.zeros((SIZE, SIZE))
    for n in (1, 2, 4, 8, 16, 32):
        value += np.kron(rng.normal(0, 0.08, (SIZE // n, SIZE // n)), np.ones((n, n)))
    return (np.clip(0.5 + value, 0.05, 0.95)[..., None] * [60000, 55000, 50000]).astype(np.uint16)


def blurred(image: np.ndarray, times: int = 3) -> np.ndarray:
    found = image.astype(np.float64)
    for _ in range(times):  # binomial 1 2 1 in both directions: a variance of 0.5 each time
        for axis in (0, 1):
            found = (np.roll(found, 1, axis) + 2 * found + np.roll(found, -1, axis)) / 4
    return found.astype(np.uint16)


def looking(eye: Sequence[float] | np.ndarray, at: Sequence[float] | np.ndarray = (0, 0, 0)) -> Camera:
    back = np.subtract(eye, at) / np.linalg.norm(np.subtract(eye, at))
    right = np.cross([0, 0, 1], back)
    right = right / np.linalg.norm(right)
    c2w = np.column_stack([right, np.cross(back, right), back, eye])
    return Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2, c2w)


def around(azimuths: Iterable[float], elevation: float = 20.0, radius: float = 4.0) -> list[Camera]:
    e = np.radians(elevation)
    return [
        looking(radius * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]))
        for a in np.radians(list(azimuths))
    ]


def scene_of(cameras: Sequence[Camera], images: Sequence[np.ndarray] | None = None, **changes: object) -> Scene:
    images = images or [textured(k) for k in range(len(cameras))]
    made = Scene(
        name="made", format="transforms", views=tuple(View(f"{k:03}.jpg", c) for k, c in enumerate(cameras)),
        photos=Photos.of(images), splits={"train": tuple(range(len(cameras)))}, near=1.0, far=8.0,
        background=(0.0, 0.0, 0.0), center=np.zeros(3), radius=4.0, up=np.array([0.0, 0, 1]), to_input=np.eye(4),
    )  # fmt: skip
    return replace(made, **changes)  # pyright: ignore[reportArgumentType]


RING = tuple(np.arange(0, 360, 12.0))


@pytest.fixture(scope="module")
def ring() -> Scene:
    return scene_of(around(RING))


def kinds(scene: Scene) -> dict[str, tuple[int, ...]]:
    return {limit.kind: limit.photos for limit in capture_report(scene).limits if limit.kind != "small"}


# ---- what is found ----------------------------------------------------------------------------------------------


def test_a_good_ring_has_no_complaint(ring: Scene) -> None:
    report = capture_report(ring)
    assert report.kind == "around"
    assert kinds(ring) == {}
    assert [p.name for p in report.photos if p.odd] == []
    assert report.gaps == ()
    assert not report.uncovered.any()


def test_sharpness_falls_with_blur_and_depends_on_nothing_else() -> None:
    sharp = textured()

    def measured(image: np.ndarray) -> float:
        work = measure_photo(Photos.of([image]), 0, None)
        while True:
            try:
                next(work)
            except StopIteration as end:
                return end.value.sharpness

    s = measured(sharp)
    assert measured(sharp // 3) == pytest.approx(s, rel=1e-3)  # neither on brightness nor on contrast
    assert measured(np.tile(sharp, (2, 2, 1))) == pytest.approx(s, rel=0.05)  # nor on size
    values = [measured(blurred(sharp, n)) for n in (0, 1, 2, 4)]
    assert values == sorted(values, reverse=True)
    assert values[1] < 0.5 * values[0]
    assert np.isnan(measured(np.full_like(sharp, 30000)))


def test_strips_of_a_large_photo_give_the_same_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = Photos.of([textured()])

    def last() -> object:
        work = measure_photo(photos, 0, None)
        while True:
            try:
                next(work)
            except StopIteration as end:
                return end.value.sharpness

    whole = last()
    monkeypatch.setattr("nerf_core.captures.sharpness.STRIP", 9 * SIZE)
    assert last() == pytest.approx(whole, rel=1e-5)


def test_a_blurred_and_a_dimmed_photo_are_found(ring: Scene) -> None:
    images = [textured(k) for k in range(len(RING))]
    images[7] = blurred(images[7])
    images[20] = images[20] // 2
    report = capture_report(scene_of(around(RING), images))
    found = {limit.kind: limit for limit in report.limits}
    assert found["soft"].photos == (7,)
    assert found["exposure"].photos == (20,)
    assert "as sharp as similar views" in report.photos[7].odd[0]
    assert "stops darker" in report.photos[20].odd[0]
    assert report.photos[20].relative_exposure == pytest.approx(-2.2, abs=0.3)  # half of the encoded value
    assert any("007.jpg" in text for text in report.next)


def test_a_photo_that_shows_nothing_is_found() -> None:
    images = [textured(k) for k in range(len(RING))]
    images[3] = np.full_like(images[3], 20000)
    assert kinds(scene_of(around(RING), images))["blank"] == (3,)


@pytest.mark.parametrize(
    ("missing", "words"), [((55, 125), "the right"), ((235, 305), "the left"), ((30, 150), "behind")]
)
def test_a_missing_side_is_named(missing: tuple[float, float], words: str) -> None:
    """Whoever stands at azimuth 0, on +x, and looks at the centre has +y, azimuth 90°, on the right.

    There is the first photo, which is the front of a ring. If a third of it is missing, the front is opposite to that.
    """
    report = capture_report(scene_of(around([a for a in RING if not missing[0] < a < missing[1]])))
    (gap,) = report.gaps
    assert gap.text == f"{words}, at its height"
    assert report.limits[0].kind == "gap"
    assert report.limits[0].text.startswith(f"no photo from {words}")
    assert report.next[0].startswith("Add ")
    assert gap.text in report.next[0]


def test_a_gap_in_one_of_two_rings_has_a_height() -> None:
    upper = [a for a in RING if not 100 < a < 260]
    report = capture_report(scene_of([*around(RING, 5), *around(upper, 50)]))
    assert len(report.gaps) == 1
    assert report.gaps[0].text.endswith(", above")
    assert report.gaps[0].width > 60


def test_one_side_is_said_and_has_no_gaps() -> None:
    report = capture_report(scene_of(around(np.arange(-60, 61, 6.0))))
    assert report.kind == "one-sided"
    assert [limit.kind for limit in report.limits if limit.kind != "small"] == ["one-sided"]
    assert any(text.startswith("To show it from all sides") for text in report.next)


def test_a_forward_facing_capture_has_no_gaps() -> None:
    cameras = [looking((x, -4, z), (x, 0, z)) for x in np.linspace(-0.6, 0.6, 6) for z in np.linspace(0, 0.4, 4)]
    report = capture_report(scene_of(cameras))
    assert report.kind == "forward-facing"
    assert "cannot be shown" in report.summary
    assert report.gaps == ()
    assert {limit.kind for limit in report.limits} <= {"small"}


def test_a_walk_through_a_room_has_no_gaps() -> None:
    cameras = [looking((x, 0, 1), (x + np.cos(a), np.sin(a), 1)) for x in (-1, 0, 1) for a in np.radians(RING)]
    report = capture_report(scene_of(cameras))
    assert report.kind == "free"
    assert report.gaps == ()


def test_odd_poses_are_found() -> None:
    cameras = around(RING)
    away = looking(cameras[4].c2w[:, 3], 2 * cameras[4].c2w[:, 3] + np.array([0.1, 0, 0]))
    cameras[4] = away
    cameras[9] = replace(cameras[9], fx=2 * cameras[9].fx, fy=2 * cameras[9].fy)
    cameras.append(cameras[15])
    found = kinds(scene_of(cameras))
    assert found["pose"] == (4,)
    assert found["focal"] == (9,)
    assert set(found["twin"]) == {15, 30}


def test_a_lens_that_folds_is_said() -> None:
    folding = Lens(k1=-2.0, k2=0.0, p1=0.0, p2=0.0)
    report = capture_report(scene_of([replace(c, lens=folding) for c in around(RING)]))
    assert any("fold" in line for line in report.calibration)
    assert report.limits[0].kind == "calibration"


def test_the_page_begins_with_what_the_capture_is_good_for_what_limits_it_and_what_to_do(ring: Scene) -> None:
    report = capture_report(ring)
    small = report.limits[0]
    assert report.overall == f"This capture is good for views from all sides. What limits it most: {small.text}. " \
        f"Next: {small.advice}."  # fmt: skip
    page = to_html(report)
    assert page.index(report.overall) < page.index("<h2>")
    side = capture_report(scene_of(around(np.arange(-60, 61, 6.0))))
    assert side.overall.startswith("This capture is good for views from the side that was photographed. ")
    few = capture_report(scene_of(around((0.0, 70.0, 200.0))))
    assert few.overall.startswith("This capture is not yet good for ")
    assert f"What limits it most: {few.limits[0].text}. Next: {few.limits[0].advice}." in few.overall


def dark(count: int) -> list[np.ndarray]:
    """The photos of a ring, the first `count` of which are black."""
    return [np.zeros_like(textured()) if k < count else textured(k) for k in range(len(RING))]


def astray(*wrong: int) -> list[Camera]:
    """The cameras of a ring, some of which look away from the centre."""
    return [
        looking(c.c2w[:, 3], 2 * c.c2w[:, 3] + [0.1, 0, 0]) if k in wrong else c for k, c in enumerate(around(RING))
    ]


def test_a_capture_most_photos_of_which_show_nothing_is_not_good() -> None:
    few = capture_report(scene_of(around(RING), dark(27))).overall
    assert few.startswith("This capture is not yet good for ")
    assert "What limits it most: 27 photos show nothing: " in few
    assert "all sides" not in few  # three photos side by side do not show them
    none = capture_report(scene_of(around(RING), dark(30))).overall
    assert none.startswith("This capture is not yet good for new views. What limits it most: 30 photos show nothing: ")
    one = capture_report(scene_of(around(RING), dark(1))).overall
    assert one.startswith("This capture is good for views from all sides. ")


@pytest.mark.parametrize(("count", "step"), [(9, 1), (10, 3), (12, 2)])
def test_a_capture_a_third_of_whose_poses_are_wrong_is_not_good(count: int, step: int) -> None:
    wrong = tuple(range(0, count * step, step))
    cameras = astray(*wrong)
    middle = np.mean([c.c2w[:, 3] for c in cameras], 0)  # what a capture has as its centre if so many look elsewhere
    report = capture_report(scene_of(cameras, center=np.zeros(3) if count < 10 else middle))
    assert {limit.kind: limit.photos for limit in report.limits}["pose"] == wrong
    assert report.overall.startswith("This capture is not yet good for views from ")
    assert f"What limits it most: {count} photos look past the centre: " in report.overall
    assert "where the photos were taken" not in report.overall
    assert capture_report(scene_of(astray(4))).overall.startswith("This capture is good for views from all sides. ")


def test_faults_of_different_photos_add_up() -> None:
    """A sixth of the photos shows nothing, and another sixth looks past the centre."""
    whole = capture_report(scene_of(astray(*range(10, 15)), dark(5))).overall
    assert whole.startswith("This capture is not yet good for ")
    assert capture_report(scene_of(around(RING), dark(5))).overall.startswith("This capture is good for ")


def test_one_photo_has_nothing_to_add_photos_between() -> None:
    report = capture_report(scene_of(around(RING[:1])))
    assert "Next: add photos from other places." in report.overall
    assert "in between" not in "".join([report.overall, *(limit.advice for limit in report.limits), *report.next])


def test_every_limit_says_what_to_do() -> None:
    cameras = around(RING)
    cameras[4] = looking(cameras[4].c2w[:, 3], 2 * cameras[4].c2w[:, 3] + np.array([0.1, 0, 0]))
    cameras[6] = looking(5 * cameras[6].c2w[:, 3])
    cameras[9] = replace(cameras[9], fx=2 * cameras[9].fx, fy=2 * cameras[9].fy)
    cameras = [*cameras[:20], cameras[15]]
    train = tuple(k for k in range(21) if k not in (1, 2, 3))
    report = capture_report(scene_of(cameras, splits={"train": train, "test": (1, 2, 3)}))
    found = {limit.kind for limit in report.limits}
    assert {"gap", "pose", "distance", "focal", "twin"} <= found
    assert all(limit.advice for limit in report.limits)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_photos_are_enough_for_a_report(count: int) -> None:
    report = capture_report(scene_of(around(RING[:count])))
    json.loads(to_json(report))
    ElementTree.fromstring(to_html(report).split("\n", 1)[1])


def test_cameras_at_one_place_give_a_report() -> None:
    camera = looking((4, 0, 1))
    report = capture_report(scene_of([camera] * 4))
    ElementTree.fromstring(to_html(report).split("\n", 1)[1])


def test_the_robust_z_score_is_that_of_iglewicz_and_hoaglin() -> None:
    z = robust_z(np.array([1.0, 2, 3, 4, 100, np.nan]), 0.0)
    np.testing.assert_allclose(z[:5], 0.6745 * np.array([-2, -1, 0, 1, 97]) / 1)
    assert z[5] == 0


def test_progress_is_told_and_a_cancel_ends_it(ring: Scene) -> None:
    told: list[tuple[int, int]] = []
    capture_report(ring, progress=lambda words, done, total: told.append((done, total)))
    assert told == sorted(told)
    assert told[-1] == (30, 30)
    with pytest.raises(ReportCancelled):
        capture_report(ring, cancel=lambda: True)


# ---- what is written --------------------------------------------------------------------------------------------


def test_the_page_is_whole_and_names_are_escaped(ring: Scene) -> None:
    odd = "<script>alert(\"1\") & '2'</script>.jpg"
    images = [textured(k) for k in range(len(RING))]
    images[0] = blurred(images[0])
    views = (replace(ring.views[0], name=odd), *ring.views[1:])
    points = np.random.default_rng(0).normal(0, 1, (4000, 3)).astype(np.float32)
    report = capture_report(replace(ring, name="a<b>&", views=views, photos=Photos.of(images), points=points))
    page = to_html(report)
    root = ElementTree.fromstring(page.split("\n", 1)[1])
    assert "http" not in page
    assert "<script" not in page
    assert not [e for e in root.iter() if e.tag in ("script", "link", "iframe")]
    pictures = [e.attrib["src"] for e in root.iter("img")]
    assert len(pictures) == 30
    assert all(src.startswith("data:image/webp;base64,") for src in pictures)
    assert odd in "".join(root.itertext())
    assert len(page) < 1_000_000


def test_no_heading_of_the_table_appears_twice(ring: Scene) -> None:
    root = ElementTree.fromstring(to_html(capture_report(ring)).split("\n", 1)[1])
    heads = [e.text for e in root.iter("th")]
    assert len(set(heads)) == len(heads)


def test_the_numbers_are_json(ring: Scene) -> None:
    report = json.loads(to_json(capture_report(ring)))
    assert report["kind"] == "around"
    assert len(report["photos"]) == 30
    assert report["photos"][3]["separation"] == pytest.approx(12, abs=1)
    assert "thumbnail" not in report["photos"][0]


def test_a_thumbnail_is_small() -> None:
    assert thumbnail(Photos.of([textured()]), 0)[8:12] == b"WEBP"


def test_only_earlier_reports_are_replaced(ring: Scene, tmp_path: Path) -> None:
    report = capture_report(ring)
    page = tmp_path / "page.html"
    for _ in range(2):
        assert write_report(report, page) == (page, tmp_path / "page.json")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["page.html", "page.json"]
    own = tmp_path / "transforms.json"
    own.write_text("{}", encoding="utf-8")
    with pytest.raises(UserError, match="is no capture report"):
        write_report(report, tmp_path / "transforms.html")
    assert own.read_text(encoding="utf-8") == "{}"
    with pytest.raises(UserError, match=r"name a \.html file"):
        write_report(report, tmp_path / "page.pdf")


def test_the_command(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from nerf_core.cli import main

    monkeypatch.chdir(tmp_path)
    before = sorted(capture.rglob("*"))
    assert main(["report", str(capture)]) == 0
    told = capsys.readouterr().out
    name = f"{capture.name}-report"
    assert f"wrote {name}.html" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{name}.html", f"{name}.json"]
    assert sorted(capture.rglob("*")) == before
    for arguments, text in (
        ([str(tmp_path / "none")], "none"),
        ([str(capture), "--out", "x.txt"], "name a .html file"),
        ([str(capture), "--downscale", "0"], "--downscale is 0"),
        ([str(capture), "--out", str(tmp_path / f"{name}.html" / "x.html")], "cannot be written"),
    ):
        assert main(["report", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert text in error
    monkeypatch.chdir(capture)
    assert main(["report", str(capture)]) == 2
    assert "--out" in capsys.readouterr().err
    assert sorted(capture.rglob("*")) == before


def test_photos_that_hold_less_than_their_size_are_said() -> None:
    large = [np.kron(textured(k), np.ones((9, 9, 1), np.uint16)) for k in range(3)]
    cameras = [c.resized(9 * SIZE, 9 * SIZE) for c in around(RING[:3])]
    found = {limit.kind for limit in capture_report(scene_of(cameras, [blurred(one, 12) for one in large])).limits}
    assert "soft all" in found
    assert "soft all" not in {limit.kind for limit in capture_report(scene_of(cameras, large)).limits}
