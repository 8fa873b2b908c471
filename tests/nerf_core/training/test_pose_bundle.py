"""Photos compared with each other: derivatives, the elimination of distances, who moves, and what counts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, Lens
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.training import pose_bundle
from nerf_core.training.pose_bundle import LOOSE, Sightings, agreement, near_each, noise, sighted, steps
from nerf_core.training.pose_fit import SHIFT, TURN, Target, moved, robust, turn_of
from nerf_core.training.pose_refinement import PoseRefinement, targets
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

SMALL = {"rays": "4096", "first_rays": "4096", "resolution": "80", "level_steps": "15"}
LENSES = {
    "pinhole": Lens(),
    "polynomial": Lens(k1=-0.1, k2=0.02, p1=0.003, p2=-0.002),
    "fisheye": Lens(k1=0.02, k2=-0.004, kind=FISHEYE),
    "equirectangular": Lens(kind=EQUIRECTANGULAR),
}


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene(None, LoadOptions())


@pytest.fixture(scope="module")
def good(demo: Scene) -> Trainer:
    """A model of the demo scene from right poses."""
    return trained(demo, 60, SMALL)


def trained(scene: Scene, steps: int, changes: dict[str, str]) -> Trainer:
    trainer = Trainer(scene, RunSettings(method="voxels", changes=changes))
    for _ in range(steps):
        trainer.step()
    return trainer


def unexposed(photo: int, colors: np.ndarray) -> np.ndarray:
    return colors


def nothing() -> None:
    pass


def close(scene: Scene, count: int) -> list[int]:
    """A training photo and those that stand and look most alike."""
    views = list(scene.split("train"))
    return [views[0], *(views[n] for n in near_each(scene.poses[views], np.zeros(1, int), 4.0)[0, : count - 1])]


def found_in(trainer: Trainer, shown: list[Target], poses: np.ndarray, host: int, count: int = 200) -> Sightings:
    others = np.array([n for n in range(len(shown)) if n != host])
    pixels = shown[host].pixels(np.random.default_rng(host), count)
    return sighted(trainer.method, trainer.scene, shown, poses, host, others, pixels)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_derivatives_are_those_of_the_difference(demo: Scene, good: Trainer, lens: Lens) -> None:
    views = close(demo, 3)
    shown = [
        replace(t, camera=replace(t.camera, lens=lens, width=t.camera.width - k))
        for k, t in enumerate(targets(demo, views, 1))
    ]  # cameras of several sizes
    poses = demo.poses[list(views)]
    found = found_in(good, shown, poses, 0)
    assert len(found.off) > 100
    tiny = 1e-8  # of a radian and of a scene unit: with ten times as much, one place of 91 crossed into another pixel

    def slope(photo: int, k: int) -> np.ndarray:
        values = []
        for sign in (1, -1):
            there = poses.copy()
            there[photo] = moved(poses[photo], sign * tiny * np.eye(6)[k])
            values.append(pose_bundle._off(shown, there, found, found.local)[0])
        return (values[0] - values[1]) / (2 * tiny)

    def same(ours: np.ndarray, theirs: np.ndarray) -> bool:
        scale = max(np.abs(theirs).max(), 1e-6)
        return (
            float(np.median(np.abs(ours - theirs)) / scale) < 1e-4
            and (np.abs(ours - theirs) < 0.01 * scale).mean() > 0.99
        )

    for k in range(6):
        assert same(found.by_host[:, :, k], slope(0, k)), k
        for photo in (1, 2):
            its = found.other == photo - 1
            assert same(found.by_other[its, :, k], slope(photo, k)[its]), (photo, k)
    farther, nearer = (pose_bundle._off(shown, poses, found, found.local * (1 + sign * tiny))[0] for sign in (1, -1))
    assert same(found.by_distance, SHIFT * (farther - nearer) / (2 * tiny))


def test_distances_are_eliminated_and_photos_that_are_no_host_stand_still() -> None:
    """The same steps as from all equations at once, those of the distances among them."""
    rng = np.random.default_rng(0)
    unit, scale = np.repeat([TURN, SHIFT * 4], 3), 0.1
    found = []
    for host, others in ((0, [1, 3]), (1, [3, 0])):
        pixel, other = (v.ravel() for v in np.indices((5, 2)))
        found.append(
            Sightings(
                host, np.array(others), np.zeros((5, 2), int), np.zeros((5, 3)), np.zeros((5, 3)), pixel, other,
                rng.normal(scale=0.1, size=(10, 3)), rng.normal(size=(10, 3, 6)), rng.normal(size=(10, 3, 6)),
                rng.normal(size=(10, 3)),
            )
        )  # fmt: skip
    before = 0.01 * rng.normal(size=(4, 6))
    ours = steps(found, before, unit, scale)
    assert (ours[2:] == 0).all()
    square, slope = np.eye(12 + 10), np.zeros(12 + 10)
    square[12:, 12:] /= LOOSE**2
    slope[:12] = (before[:2] / unit).ravel()
    for s in found:
        for a in range(len(s.off)):
            row = np.zeros((3, 22))
            row[:, 6 * s.host : 6 * s.host + 6] = s.by_host[a] * unit
            other = s.others[s.other[a]]
            if other < 2:
                row[:, 6 * other : 6 * other + 6] = s.by_other[a] * unit
            row[:, 12 + 5 * s.host + s.pixel[a]] = s.by_distance[a]
            weight = robust(s.off[a], scale) / scale**2
            square += row.T @ (weight[:, None] * row)
            slope += row.T @ (weight * s.off[a])
    np.testing.assert_allclose(ours[:2], (-np.linalg.solve(square, slope)[:12]).reshape(2, 6) * unit, rtol=1e-9)


def test_left_out_pixels_tell_better_poses_from_worse_ones(demo: Scene, good: Trainer) -> None:
    views = close(demo, 9)
    shown, truth = targets(demo, views, 1), demo.poses[list(views)]
    gains = []
    for host in range(9):
        wrong = truth.copy()
        wrong[host] = moved(truth[host], np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.02]))
        for first, then in ((wrong, truth), (truth, wrong)):
            found = found_in(good, shown, first, host)
            gains.append(agreement(shown, first, then, found, noise([found])))
    found, error, _ = np.array(gains).reshape(9, 2, 3).transpose(2, 1, 0)
    certain = 3 * np.sqrt((error**2).sum(-1))
    assert found[0].sum() > certain[0]
    assert found[1].sum() < -certain[1]
    there = found_in(good, shown, truth, 0)
    assert agreement(shown, truth, truth, there, noise([there]))[0] == 0
    nothing = found_in(good, shown, truth, 0, count=0)
    assert agreement(shown, truth, truth[::-1], nothing, noise([nothing])) == (0, 0, 0)


def test_sightings_that_are_lost_say_nothing(demo: Scene, good: Trainer) -> None:
    views = close(demo, 3)
    shown, poses = targets(demo, views, 1), demo.poses[list(views)]
    found = found_in(good, shown, poses, 0)
    there = np.arange(len(found.off)) % 3 > 0
    some = replace(
        found, pixel=found.pixel[there], other=found.other[there], off=found.off[there],
        by_distance=found.by_distance[there],
    )  # fmt: skip
    ours = pose_bundle._distance_equations(found, found.off, robust(found.off, 0.1) * there[:, None])
    np.testing.assert_allclose(ours, pose_bundle._distance_equations(some, some.off, robust(some.off, 0.1)))
    away = poses.copy()
    away[1:] = [moved(c2w, np.array([0, 0.25, 0, 0, 0, 0])) for c2w in poses[1:]]  # most surfaces leave the pictures
    assert agreement(shown, poses, away, found, noise([found])) == (0, 0, 0)


def test_a_camera_that_moves_alone_is_judged_where_it_is_put(demo: Scene, good: Trainer) -> None:
    """Those that stand still hold the gauge: what is common to all corrections is not taken out."""
    views = close(demo, 4)
    turn = np.array([0, np.radians(1.0), 0, 0, 0, 0])
    wrong = demo.reposed({views[0]: moved(demo.poses[views[0]], turn)})
    refinement = PoseRefinement(wrong, views, 0)
    refinement.rounds = 100
    refinement.poses[0] = moved(refinement.poses[0], np.full(6, 1e-6))
    shown = [t.corrected(partial(unexposed, n)) for n, t in enumerate(refinement._shown())]
    tried = refinement._among_photos(good.method, np.random.default_rng(0), shown, nothing)
    assert tried.photos.tolist() == [0]
    assert (tried.wanted[1:] == refinement.poses[1:]).all()
    assert (tried.wanted[0] != refinement.poses[0]).any()


def test_an_exposure_that_is_none_moves_no_camera(demo: Scene, good: Trainer) -> None:
    refinement = PoseRefinement(demo, close(demo, 4), 0)
    refinement.rounds, refinement.among = 100, True
    refinement.poses[0] = before = moved(refinement.poses[0], np.full(6, 1e-6))
    broken = refinement.round(good.method, lambda photo, colors: colors * np.nan if photo == 1 else colors, nothing)
    assert (broken.poses[0] == before).all()
    assert not broken.among


@pytest.mark.parametrize("what", ["masked", "fog"])
def test_where_nothing_is_seen_no_camera_moves(
    demo: Scene, good: Trainer, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, scene = close(demo, 4), demo
    if what == "masked":
        hidden = np.zeros((demo.views[0].camera.height, demo.views[0].camera.width), bool)
        scene = replace(demo, photos=demo.photos.masked(dict.fromkeys(views, hidden)))
    else:
        render = good.method.render

        def fog(rays: Rays) -> Rendering:
            drawn = render(rays)
            return replace(drawn, opacity=torch.zeros_like(drawn.opacity))

        monkeypatch.setattr(good.method, "render", fog)
    refinement = PoseRefinement(scene, views, 0)
    refinement.rounds, refinement.among = 100, True
    refinement.poses[0] = before = moved(refinement.poses[0], np.full(6, 1e-6))
    refinement.take(refinement.round(good.method, unexposed, nothing))
    assert (refinement.poses[0] == before).all()
    assert not refinement.among


@pytest.mark.thorough(18)
def test_cameras_come_back_together_from_a_turn_that_a_shift_takes_back(demo: Scene) -> None:
    """What a comparison with the model leaves: photos of a small object hardly tell one from the other."""
    sharp = trained(demo, 100, {"rays": "8192", "first_rays": "8192", "resolution": "96", "level_steps": "20"})
    views = demo.split("train")
    rng, truth, some = np.random.default_rng(0), demo.poses[list(views)], range(24)
    wrong = {}
    for n in some:
        sideways = np.radians(1.0) * rng.choice((-1, 1))
        depth = np.linalg.norm(truth[n, :, 3] - demo.center)
        wrong[views[n]] = moved(truth[n], np.array([0, sideways, 0, sideways * depth, 0, 0]))
    refinement = PoseRefinement(demo.reposed(wrong), views, 0)
    refinement.rounds = 100  # photos of the full size
    for n in some:
        refinement.poses[n] = moved(refinement.poses[n], np.full(6, 1e-6))  # found wrong once
    for _ in range(8):
        refinement.among = True
        refinement.take(refinement.round(sharp.method, unexposed, nothing))
    turned = np.linalg.norm(turn_of(truth[:, :, :3].swapaxes(1, 2) @ refinement.poses[:, :, :3]), axis=-1)
    assert np.median(turned[some]) < 0.7 * np.radians(1.0)
    assert (refinement.poses[len(some) :] == truth[len(some) :]).all()  # they had not moved, so they stand


def test_rounds_take_turns_once_a_camera_has_moved(demo: Scene, good: Trainer) -> None:
    refinement = PoseRefinement(demo, demo.split("train")[:8], 0)
    refinement.rounds = 100
    refinement.take(refinement.round(good.method, unexposed, nothing))
    assert (refinement.poses == refinement.given).all()
    assert not refinement.among  # right poses: no photo need be compared with others
    refinement.poses[0] = moved(refinement.poses[0], np.full(6, 1e-6))
    turns = []
    for _ in range(4):
        refinement.take(refinement.round(good.method, unexposed, nothing))
        turns.append(refinement.among)
    assert turns == [True, False, True, False]


def test_masked_pixels_and_those_at_the_edge_are_no_sightings(demo: Scene, good: Trainer) -> None:
    views = close(demo, 2)
    poses = demo.poses[list(views)]
    plain = found_in(good, targets(demo, views, 1), poses, 0)
    width, height = demo.views[0].camera.width, demo.views[0].camera.height
    mask = np.ones((height, width), bool)
    mask[:, : width // 2] = False
    scene = replace(demo, photos=demo.photos.masked({views[1]: mask}))
    found = found_in(good, targets(scene, views, 1), poses, 0)
    assert 0 < len(found.off) < len(plain.off)
    seen, _ = pose_bundle._seen(
        targets(scene, views, 1), poses, 0, np.array([1]), found.local[found.pixel], found.other
    )
    column, row = np.floor(seen.pixels - 0.5).astype(int).T
    assert (mask[row, column] & mask[row, column + 1] & mask[row + 1, column] & mask[row + 1, column + 1]).all()
    camera = Camera(width, height, 100.0, 100.0, width / 2, height / 2, poses[1])
    target = Target(Photos.of([demo.images[views[1]]]), 0, camera)
    at_edge = np.array([[0.4, 20.0], [0.6, 20.0], [width - 0.4, 20.0], [width - 0.6, 20.0]])
    local = np.column_stack([(at_edge - (camera.cx, camera.cy)) / (100, -100), -np.ones(4)])
    seen, _ = pose_bundle._seen([target], poses[[1]], 0, np.array([0]), local, np.zeros(4, int))
    assert pose_bundle._inside([target], np.array([0]), np.zeros(4, int), seen).tolist() == [False, True, False, True]


def test_what_a_fisheye_does_not_show_is_no_sighting(demo: Scene) -> None:
    """A photo is black beside its circle, so no colour is blended with that."""
    plain = targets(demo, close(demo, 1), 1)[0]
    camera = replace(plain.camera, lens=Lens(k1=-2.0, kind=FISHEYE))  # it folds within the picture
    centre, radius = np.array([camera.cx, camera.cy]), camera.lens.reach() * camera.fx
    assert radius < camera.width / 2
    turn = np.linspace(0, 2 * np.pi, 500)
    places = centre + (radius - 1) * np.stack([np.cos(turn), np.sin(turn)], -1)
    shown = [replace(plain, camera=camera)]
    counts = pose_bundle._between_pixels(shown, np.array([0]), np.zeros(500, int), places)[2]
    around = np.floor(places - 0.5)[:, None] + [(0.5, 0.5), (1.5, 0.5), (0.5, 1.5), (1.5, 1.5)]
    within = (np.linalg.norm(around - centre, axis=-1) < radius).all(1)
    assert 0 < within.sum() < 500
    np.testing.assert_array_equal(counts, within)


def test_near_cameras_look_at_the_same_place() -> None:
    looks = {"same": np.eye(3), "away": np.diag([-1.0, 1.0, -1.0])}
    poses = np.stack(
        [
            np.column_stack([looks[look], [x, 0.0, 0.0]])
            for x, look in ((0, "same"), (0.5, "away"), (1, "same"), (3, "same"))
        ]
    )
    assert near_each(poses, np.array([2, 0]), reach=4.0).tolist() == [[0, 3, 1], [2, 3, 1]]


def test_a_checkpoint_of_a_version_without_these_rounds_is_read(demo: Scene) -> None:
    refinement = PoseRefinement(demo, demo.split("train")[:4], 0)
    state = refinement.state() | {"counts": torch.tensor([7.0, 100.0, 0.5, 1.0], dtype=torch.float64)}
    refinement.load_state(state)
    assert (refinement.rounds, refinement.stride, refinement.wrong) == (7, 0.5, True)
    assert (refinement.stride_among, refinement.among) == (1.0, False)
    with pytest.raises(ValueError, match="poses of 4 photos, not 5"):
        PoseRefinement(demo, demo.split("train")[:5], 0).load_state(state)
