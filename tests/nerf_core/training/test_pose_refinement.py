"""Poses of training photos: wrong ones come back, right ones stay, and a photo that does not fit moves no camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_core.commands.evaluate import _print_metrics, _print_poses
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.rays import Rays, Rendering
from nerf_core.geometry.scene import Scene
from nerf_core.training import checkpoint
from nerf_core.training.evaluate import Selection, evaluate
from nerf_core.training.pose_fit import Comparison, Target, between, gain, moved, rotation, turn_of
from nerf_core.training.pose_records import REFUSED, UNTRIED
from nerf_core.training.pose_refinement import PoseRefinement, better, fitted
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

SMALL = {"rays": "4096", "resolution": "64", "level_steps": "20"}
FEW = {"rays": "16384", "first_rays": "16384", "resolution": "24", "train_images": "6"}


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene(None, LoadOptions(downscale=3))


@pytest.fixture(scope="module")
def good(demo: Scene) -> Trainer:
    """A model of the demo scene from right poses."""
    return trained(demo, 60, refine=False)


def trained(scene: Scene, steps: int, refine: bool = True, changes: dict[str, str] = SMALL) -> Trainer:
    trainer = Trainer(scene, RunSettings(method="voxels", refine_poses=refine, changes=changes))
    for _ in range(steps):
        trainer.step()
    return trainer


def disturbed(c2w: np.ndarray, seed: int) -> np.ndarray:
    """A pose turned by 1° and shifted by 1 % of the demo's distance, 4, about and along random axes."""
    axis, way = (v / np.linalg.norm(v) for v in np.random.default_rng(seed).normal(size=(2, 3)))
    return moved(c2w, np.concatenate([np.radians(1) * axis, 0.04 * way]))


def degrees(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.linalg.norm(turn_of(np.swapaxes(truth[..., :3], -1, -2) @ poses[..., :3]), axis=-1))


def misplaced(scene: Scene, views: Sequence[int], poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far from its true place each camera sees a cube in the scene's middle: RMS in pixels, (N,).

    What a turn undoes of a shift does not count: photos of a small object hardly tell one from the other.
    """
    cube = np.array(list(product((-0.5, 0.5), repeat=3)))
    found = []
    for i, pose, true in zip(views, poses, truth, strict=True):
        camera = scene.views[i].camera
        off = camera.moved(pose).project(cube)[0] - camera.moved(true).project(cube)[0]
        found.append(np.sqrt((off**2).sum(-1).mean()))
    return np.array(found)


def unexposed(photo: int, colors: np.ndarray) -> np.ndarray:
    return colors


def nothing() -> None:
    pass


def rounds(refinement: PoseRefinement, trainer: Trainer, count: int) -> None:
    for _ in range(count):
        refinement.take(refinement.round(trainer.method, unexposed, nothing))


def test_a_few_disturbed_cameras_come_back(demo: Scene, good: Trainer) -> None:
    views = demo.split("train")[::9]
    wrong = demo.reposed({i: disturbed(demo.poses[i], i) for i in views[:4]})
    refinement, truth = PoseRefinement(wrong, views, 0), demo.poses[list(views)]
    refinement.rounds = 6  # whole photos from the beginning: they have 67 pixels a side
    rounds(refinement, good, 12)
    before, after = (misplaced(demo, views, p, truth) for p in (refinement.given, refinement.poses))
    assert before[:4].mean() > 1
    assert after[:4].mean() < 0.4 * before[:4].mean()
    assert after[4:].max() < 0.4
    found = refinement.corrections()
    assert (after[:4] < 0.7 * before[:4])[before[:4] > 0.5].all()  # the other lies within chance
    assert np.median(found.turned[4:]) < 0.1


def test_all_disturbed_cameras_come_closer_while_the_model_learns(demo: Scene) -> None:
    wrong = demo.reposed({i: disturbed(demo.poses[i], i) for i in demo.split("train")})
    views = list(demo.split("train"))
    trainer = trained(wrong, 60, changes=SMALL | {"rays": "12288", "first_rays": "12288"})
    before, after = (misplaced(demo, views, s.poses[views], demo.poses[views]) for s in (wrong, trainer.scene))
    assert np.median(after) < 0.8 * np.median(before)
    assert trainer.capture is wrong
    index = torch.arange(len(views))
    rays = trainer.batches._at(1).cameras.rays(index, torch.zeros(len(views), 2))
    np.testing.assert_allclose(rays.origins, trainer.scene.poses[views, :, 3], rtol=1e-6)  # batches see them, too


def test_a_summary_says_why_no_camera_moved(demo: Scene) -> None:
    refinement = PoseRefinement(demo, demo.split("train"), 0)
    assert refinement.corrections().summary() == "not corrected yet"
    refinement.rounds = 1
    assert refinement.corrections().summary() == f"{len(refinement.views)} cameras not tried yet"
    refinement.outcome[:] = REFUSED
    count, why = len(refinement.views), "pixels left out of the fit agreed no better elsewhere"
    assert refinement.corrections().summary() == f"{count} cameras stayed where they were: {why}"
    refinement.poses[0] = disturbed(refinement.poses[0], 0)
    found = refinement.corrections()
    moved = f"1 camera moved, by {found.turned[0]:.2g}° and {found.shifted[0]:.2%} of the radius"
    assert found.turned[0] > 0.1
    assert found.summary() == f"{moved}; {count - 1} cameras stayed where they were: {why}"
    refinement.outcome[1:3] = UNTRIED
    stayed = f"{count - 3} cameras stayed where they were: {why}"
    assert refinement.corrections().summary() == f"{moved}; {stayed}; 2 cameras not tried yet"


def test_eval_says_which_cameras_moved_and_what_the_second_psnr_is(capsys: pytest.CaptureFixture[str]) -> None:
    still = {"name": "a.png", "degrees": 0.0, "percent": 0.0, "outcome": "refused"}
    _print_poses([still], "1 camera stayed where it was")
    assert capsys.readouterr().out == "poses of training photos: 1 camera stayed where it was\n"
    _print_poses([still, {"name": "b.png", "degrees": 0.25, "percent": 0.5, "outcome": "refused"}], "1 camera moved")
    told = capsys.readouterr().out
    assert "0.250°" in told
    assert "b.png" in told
    assert "a.png" not in told
    assert "refused" not in told
    mean = {"psnr": 20.0, "ssim": 0.5, "lpips": None, "psnr_posed": 21.0}
    for split, words in (
        ("test", "pose of each photo fitted to its left half, measured on its right half: PSNR 21.00 dB"),
        ("train", "corrected pose of each photo, measured on its right half: PSNR 21.00 dB"),
    ):
        _print_metrics({"mean": mean, "split": split, "step": 1}, 1)
        assert words in capsys.readouterr().out


def test_a_photo_of_something_else_moves_no_camera(demo: Scene, good: Trainer) -> None:
    views = demo.split("train")[::12]
    rng = np.random.default_rng(0)
    images = list(demo.images)
    images[views[0]] = rng.integers(0, 65536, images[views[0]].shape).astype(np.uint16)
    images[views[1]] = np.full_like(images[views[1]], 30000)
    scene = replace(demo, photos=Photos.of(images))
    refinement = PoseRefinement(scene, views, 0)
    rounds(refinement, good, 6)
    assert (refinement.poses[:2] == refinement.given[:2]).all()
    assert refinement.outcome[0] == REFUSED
    assert refinement.corrections().stayed >= 2


def test_the_gain_of_a_pose_has_the_error_of_cells_and_needs_a_model_that_explains_the_photo() -> None:
    rng = np.random.default_rng(0)
    colors, noise = rng.uniform(size=(400, 3)), rng.normal(size=(400, 3))
    cells = np.stack([np.arange(400) % 8, np.arange(400) // 8 % 8], -1)

    def off(values: np.ndarray) -> Comparison:
        return Comparison(cells, colors, values, np.zeros((400, 3, 6)), 1.0)

    def certainty(after: np.ndarray, before: np.ndarray = 0.1 * noise) -> float:
        found, error, _ = gain(off(before), off(after))
        return found / error

    assert certainty(0.05 * noise) > 3
    assert gain(off(0.1 * noise), off(0.1 * noise))[:2] == (0, 0)
    assert certainty(0.2 * noise) < -3
    assert abs(certainty(0.1 * rng.permutation(noise))) < 3
    assert gain(off(0.5 * noise), off(0.25 * noise)) == (0, 0, 0)  # a variance of 0.25, of 1/12
    crowded = replace(off(0.1 * noise), cells=np.zeros_like(cells))  # the only sum is 0: it would be certain of all
    assert gain(crowded, replace(crowded, off=0.09 * noise)) == (0, 0, 0)
    # 64 cells that are better or worse as a whole are 64 values, and no more
    size = np.where(rng.normal(size=(8, 8, 1)) > -0.3, 0.08, 0.11)[cells[:, 0], cells[:, 1]]
    scale = np.sqrt((noise**2).mean()) / 10  # of Geman and McClure's cost
    costs = [(x := (s * noise / (2 * scale)) ** 2) / (1 + x) for s in (0.1, size)]
    gains = (costs[0] - costs[1]).mean(1)
    values = gains - gains.mean()
    sums = np.array([values[(cells == cell).all(1)].sum() for cell in product(range(8), repeat=2)])
    found, error, cost = gain(off(0.1 * noise), off(size * noise))
    assert error == pytest.approx(np.sqrt((sums**2).sum()) / 400)
    assert error > 1.5 * values.std() / 20
    assert (found, cost) == pytest.approx((gains.mean(), costs[0].mean()))


def test_photos_are_heard_together_only_once_poses_are_shown_to_be_wrong() -> None:
    hardly = np.tile([1.5, 1.0, 100.0], (16, 1))  # each by 1.5 standard errors, all by 6
    kept, together, wrong = better(hardly, False)
    assert together
    assert not wrong
    assert not kept.any()
    assert better(hardly, True)[0].all()
    kept, together, wrong = better(hardly / (1, 1, 10), False)  # more than a twentieth of the cost
    assert wrong
    assert kept.all()
    one = np.vstack([[4.0, 1.0, 100.0], np.tile([-2.0, 1.0, 100.0], (15, 1))])
    kept, together, wrong = better(one, True)
    assert wrong
    assert not together
    assert kept.tolist() == [True] + 15 * [False]


def test_right_poses_stay(demo: Scene) -> None:
    trainer = trained(demo, 60, changes=SMALL | {"rays": "12288", "first_rays": "12288"})
    found = trainer.corrections
    assert found is not None
    assert found.rounds >= 3
    assert found.stayed > 0.8 * len(found.views)
    assert found.turned.mean() < 0.02


def test_a_model_that_is_not_finite_moves_no_camera(demo: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = trained(demo, 2, refine=False)
    refinement = PoseRefinement(demo, demo.split("train")[:4], 0)
    render = trainer.method.render

    def broken(rays: Rays) -> Rendering:
        drawn = render(rays)
        return replace(drawn, color=torch.full_like(drawn.color, torch.nan))

    monkeypatch.setattr(trainer.method, "render", broken)
    rounds(refinement, trainer, 2)
    assert (refinement.poses == refinement.given).all()


def test_all_photos_of_many_have_their_turn(demo: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerf_core.training.pose_refinement.MOST", 20)
    refinement = PoseRefinement(demo, demo.split("train")[:50], 0)
    seen = np.zeros(50, int)
    for refinement.rounds in range(10):
        chosen = refinement._chosen()
        assert len(np.unique(chosen)) == len(chosen) <= 20
        seen[chosen] += 1
    assert seen.min() >= 3
    assert seen.max() <= 4  # of 200 turns; one that follows itself in a round counts once


def test_a_held_out_photo_is_fitted_by_its_left_half_alone(demo: Scene, good: Trainer) -> None:
    view = demo.split("test")[0]
    wrong = demo.reposed({view: disturbed(demo.poses[view], 3)})
    found = fitted(good.method, wrong, view)
    before, after = (misplaced(demo, [view], p[None], demo.poses[[view]]) for p in (wrong.poses[view], found))
    assert after < 0.5 * before
    images = list(demo.images)
    images[view] = images[view].copy()
    images[view][:, images[view].shape[1] // 2 :] = 0
    blind = replace(wrong, photos=Photos.of(images))
    assert (fitted(good.method, blind, view) == found).all()


def test_what_all_cameras_could_share_is_taken_out(demo: Scene) -> None:
    refinement = PoseRefinement(demo, demo.split("train"), 0)
    turn, shift, scale = rotation(np.array([0.01, -0.02, 0.005])), np.array([0.1, 0.0, -0.2]), 1.01
    middle = refinement.given[:, :, 3].mean(0)
    poses = refinement.given.copy()
    poses[:, :, :3] = turn @ poses[:, :, :3]
    poses[:, :, 3] = middle + scale * (poses[:, :, 3] - middle) @ turn.T + shift
    back = refinement._without_gauge(poses)
    assert np.abs(poses - refinement.given).max() > 0.1
    assert degrees(back, refinement.given).max() < 0.01  # of 1.3°: the turn's second order
    assert np.abs(back[:, :, 3] - refinement.given[:, :, 3]).max() < 0.01
    one = refinement.given.copy()
    one[0] = disturbed(one[0], 0)
    assert degrees(refinement._without_gauge(one)[0], one[0]) < 0.1  # of a single camera's, hardly anything is common


def test_steps_and_their_inverse() -> None:
    rng = np.random.default_rng(0)
    c2w = np.column_stack([rotation(rng.normal(size=3)), rng.normal(size=3)])
    step = rng.normal(size=6)
    np.testing.assert_allclose(between(c2w, moved(c2w, step)), step, atol=1e-9)
    np.testing.assert_allclose(between(c2w, moved(c2w, np.zeros(6))), 0, atol=1e-9)


@pytest.mark.parametrize("among", [False, True], ids=["with the model", "among photos"])
def test_a_resumed_run_goes_on_bit_for_bit(demo: Scene, tmp_path: Path, among: bool) -> None:
    def begin(steps: int) -> Trainer:
        trainer = trained(demo, 1, changes=FEW)
        assert trainer.refinement is not None
        if among:  # as after rounds that have moved cameras, and then brought nothing
            refinement = trainer.refinement
            refinement.poses = refinement.poses + np.array([0.0, 0.0, 0.0, 0.002])
            refinement.rounds, refinement.among = 60, True
            trainer._pose()
        while trainer.step_count < steps:
            trainer.step()
        return trainer

    through, begun = begin(30), begin(17)
    assert begun.refinement is not None
    assert begun.refinement.rounds >= (61 if among else 1)
    checkpoint.save(tmp_path / "a.safetensors", begun.describe(), begun.state())
    resumed = Trainer.resume(demo, *checkpoint.load(tmp_path / "a.safetensors"))
    assert (resumed.scene.poses == begun.scene.poses).all()
    for _ in range(13):
        resumed.step()
    assert through.refinement is not None
    assert through.refinement.rounds > begun.refinement.rounds
    for name, value in through.state().items():
        assert torch.equal(value, resumed.state()[name]), name
    again = resumed.restarted()
    assert again.refinement is not None
    assert again.scene is demo
    older = {k: v for k, v in begun.describe().items() if k != "refine_poses"}  # of a version without corrections
    assert Trainer.resume(demo, older, begun.state()).refinement is None


def test_an_abandoned_round_leaves_all_as_it_was(demo: Scene) -> None:
    trainer = trained(demo, 1, changes=FEW)
    assert trainer.refinement is not None
    while not trainer.refinement.due(16384):
        trainer.step()
    before = {name: value.clone() for name, value in trainer.state().items()}

    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        trainer.step(stop)
    assert all(torch.equal(value, before[name]) for name, value in trainer.state().items())


def test_methods_that_compare_no_poses_are_named(scene: Scene) -> None:
    with pytest.raises(UserError, match="--refine-poses: method nearest-view"):
        Trainer(scene, RunSettings(method="nearest-view", refine_poses=True))
    assert Trainer(scene, RunSettings(method="voxels", changes=FEW)).corrections is None
    with pytest.raises(UserError, match=r"--refine-poses: .* trains on one photo"):
        Trainer(scene, RunSettings(method="voxels", changes=FEW | {"train_images": "1"}, refine_poses=True))


def test_evaluation_reports_the_corrections(demo: Scene) -> None:
    trainer = trained(demo, 13, changes=FEW)
    found = evaluate(trainer, Selection("test", demo.split("test")[:1]))
    assert [row["name"] for row in found["poses"]] == [demo.views[i].name for i in demo.trained(6)]
    assert found["mean"]["psnr_posed"] == found["images"][0]["psnr_posed"]
    assert trainer.corrections is not None
    assert [row["percent"] for row in found["poses"]] == pytest.approx((100 * trainer.corrections.shifted).tolist())
    assert {row["outcome"] for row in found["poses"]} <= {"moved", "refused"}  # a round has looked at each


def test_no_pixel_beside_a_masked_one_is_compared(demo: Scene) -> None:
    """Its gradient would be that of the mask's edge."""
    height, width = demo.images[0].shape[:2]
    mask = np.random.default_rng(0).random((height, width)) > 0.05
    mask[height // 4 : height // 2, width // 4 : width // 2] = False
    target = Target(demo.photos.masked({0: mask}), 0, demo.views[0].camera)
    x, y = target.pixels(np.random.default_rng(1), 400).T
    assert len(x) > 100
    for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        assert mask[y + dy, x + dx].all()
