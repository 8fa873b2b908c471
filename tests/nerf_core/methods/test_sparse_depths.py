"""The voxel method's loss of depth: towards points of the ball that few photos show."""

from __future__ import annotations

from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.photos import DAMAGED, WAITING
from nerf_core.geometry.scene import Scene
from nerf_core.kernels import numba_depths, voxel_kernels
from nerf_core.methods.voxels.config import DEPTH_WEIGHT, VoxelConfig
from nerf_core.methods.voxels.method import Voxels
from nerf_core.methods.voxels.sparse_depths import SparseDepths
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

SMALL = {"rays": "512", "first_rays": "512", "start": "12", "pixels": "0.5", "level_steps": "6"}


def with_points(scene: Scene) -> Scene:
    """The scene whose photos know which of 400 points of the unit ball they see."""
    points = np.random.default_rng(0).normal(size=(400, 3))
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    views = [replace(v, sighted=points[points @ v.camera.c2w[:, 3] > 1.2]) for v in scene.views]
    return replace(scene, views=tuple(views))


def trained(scene: Scene, steps: int, **changes: object) -> Voxels:
    words = SMALL | {name: str(value) for name, value in changes.items()}
    trainer = Trainer(scene, RunSettings(method="voxels", changes=words, seed=0, threads=1))
    for _ in range(steps):
        trainer.step()
    assert isinstance(trainer.method, Voxels)
    return trainer.method


def around(scene: Scene) -> Scene:
    """The ball as a place, in contracted space."""
    return replace(scene, synthetic=False)


def test_the_constant_of_the_compiled_loop_is_that_of_the_interface() -> None:
    assert float(numba_depths.OUTLIER) == pytest.approx(voxel_kernels.OUTLIER)


@pytest.mark.parametrize("place", [lambda scene: scene, around], ids=["world", "contracted"])
def test_depths_of_a_held_out_photo_are_nearer_to_the_points(scene: Scene, place) -> None:
    scene = place(with_points(scene))
    aim = SparseDepths.of(replace(scene, splits={"train": scene.split("test")}), 0)
    errors = []
    for weight in (0, 10):
        method = trained(scene, 150, train_images=2, depth_weight=weight)
        depth = method.render(aim.rays).depth.nan_to_num(nan=scene.far)
        errors.append(float((depth - aim.t).abs().median()))
    assert errors[1] < 0.7 * errors[0], errors


def test_without_a_weight_points_change_nothing(scene: Scene) -> None:
    rows = [trained(s, 8, depth_weight=0).grid.rows for s in (scene, with_points(scene))]
    assert torch.equal(*rows)
    assert scene.identity() == with_points(scene).identity()


def test_points_count_unless_the_weight_is_said_to_be_0(scene: Scene) -> None:
    assert trained(scene, 0).config.depth_weight == 0
    assert trained(with_points(scene), 0).config.depth_weight == DEPTH_WEIGHT
    assert trained(with_points(scene), 0, depth_weight=0).config.depth_weight == 0


def test_points_do_not_count_while_poses_are_refined(scene: Scene) -> None:
    """They were placed with the poses that are doubted."""
    for refine, weight in ((False, DEPTH_WEIGHT), (True, 0)):
        trainer = Trainer(with_points(scene), RunSettings(method="voxels", refine_poses=refine))
        assert trainer.describe()["config"]["depth_weight"] == weight
    with pytest.raises(UserError, match="and no --refine-poses"):
        Trainer(with_points(scene), RunSettings(method="voxels", refine_poses=True, changes={"depth_weight": "1"}))


def test_a_run_with_depths_is_the_same_each_time(scene: Scene) -> None:
    first, second, off = (trained(with_points(scene), 8, depth_weight=w).grid.rows for w in (10, 10, 0))
    assert torch.equal(first, second)
    assert not torch.equal(first, off)


def test_rays_meet_the_points_in_every_space(scene: Scene, facing: Scene) -> None:
    ahead = [replace(v, camera=v.camera.moved(v.camera.c2w - [[0] * 4, [0] * 4, [0, 0, 0, 4.0]])) for v in facing.views]
    points = np.random.default_rng(1).uniform((-1, -1, -9), (1, 1, -2), (50, 3)).astype(np.float32)
    ahead = tuple(replace(v, sighted=points) for v in ahead)
    ndc = replace(facing, views=ahead, ndc=Ndc(16, 16, ahead[0].camera.fx, 1.0, 20.0), near=1.0, far=20.0)
    for case in (with_points(scene), around(with_points(scene)), ndc):
        method = trained(case, 1, depth_weight=1)
        known, space = method.sparse_depths, method.space
        distance = space.world_t(known.rays, known.t[:, None])
        met = known.rays.origins + distance * known.rays.directions
        every = torch.from_numpy(
            np.concatenate([p for i in case.split("train") if (p := case.views[i].sighted) is not None])
        )
        assert len(met) > 100
        assert float((met[:, None] - every).norm(dim=-1).amin(1).max()) < 1e-4
        boxed = space.rays(known.rays)
        at = boxed.origins + known.t[:, None] * boxed.directions
        if space.kind == "ndc":
            torch.testing.assert_close(at, space.points(met), atol=1e-4, rtol=0)
        assert bool(((known.t > boxed.near) & (known.t < boxed.far)).all())


def test_points_behind_a_mask_beside_the_photo_and_before_the_near_bound_are_left_out(scene: Scene) -> None:
    camera = scene.views[0].camera
    ray = -camera.c2w[:, 2]
    points = camera.c2w[:, 3] + np.array([[3.0], [-3.0], [1.0]]) * ray  # seen, behind the camera, nearer than `near`
    points = np.concatenate([points, points[:1] + 9 * camera.c2w[:, 0]]).astype(np.float32)  # beside the picture
    one = replace(scene, views=(replace(scene.views[0], sighted=points), *scene.views[1:]))
    known = SparseDepths.of(one, 0)
    assert known.t.tolist() == pytest.approx([3.0])
    mask = np.ones((16, 16), bool)
    mask[8, 8] = False
    with pytest.raises(UserError, match="depth_weight"):
        SparseDepths.of(replace(one, photos=one.photos.masked({0: mask})), 0)


def test_a_scene_without_points_is_refused_in_one_line(capture) -> None:
    scene = load_scene(capture, LoadOptions())
    with pytest.raises(UserError) as caught:
        trained(scene, 0, depth_weight=1)
    assert "depth_weight needs sparse points" in str(caught.value)
    assert "blender" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError):  # only test photos see points
        trained(replace(with_points(scene), splits={"train": (0,), "test": (5,)}, views=tuple(
            replace(v, sighted=None) if k == 0 else v for k, v in enumerate(with_points(scene).views)
        )), 0, depth_weight=1)  # fmt: skip


def test_configurations_of_earlier_versions_have_no_loss_of_depth() -> None:
    earlier = asdict(VoxelConfig())
    del earlier["depth_weight"]
    assert VoxelConfig.restore(earlier).depth_weight == 0


def test_points_do_not_depend_on_which_photos_are_known_to_be_damaged(scene: Scene) -> None:
    """Photos of a large capture are found to be damaged while training goes on."""
    counts = []
    for state in (WAITING, DAMAGED):
        filling = SimpleNamespace(state=np.full(len(scene.views), state))
        photos = replace(scene.photos, filling=filling, ids=np.arange(len(scene.views)))
        counts.append(len(SparseDepths.of(replace(with_points(scene), photos=photos), 0).t))
    assert counts[0] == counts[1] > 0
