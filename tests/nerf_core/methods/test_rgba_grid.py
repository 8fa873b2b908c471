"""The RGBα grid: the law of its opacities, interpolation, gradients, levels, empty space, memory and learning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space
from nerf_core.kernels.choice import packed_kernels
from nerf_core.methods.rgba_grid.config import GridConfig
from nerf_core.methods.rgba_grid.method import RgbaGrid
from nerf_core.methods.rgba_grid.volume import (
    ALPHA,
    RgbaVolume,
    corners_of,
    logit_of,
    neighbours_of,
    opacity,
    optical_depth,
    roughness,
)
from nerf_core.methods.stages import Colors, Pictures
from nerf_core.training.evaluate import evaluate, select
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
KERNELS = packed_kernels(CPU)


def nothing() -> None:
    pass


def volume_of(scene: Scene, side: int, seed: int = 0) -> RgbaVolume:
    """A volume of random logits."""
    logits = 2 * torch.randn(side, side, side, 4, generator=torch.Generator().manual_seed(seed))
    return RgbaVolume(logits, Space.of(scene))


def method_of(scene: Scene, **changes: str) -> RgbaGrid:
    return RgbaGrid(scene, RgbaGrid.configure(scene, "auto", changes, CPU), CPU, 0)


def with_volume(method: RgbaGrid, volume: RgbaVolume) -> RgbaGrid:
    method._begin(0, volume, volume.everything())
    return method


def held_out_psnr(trainer: Trainer) -> float:
    return evaluate(trainer, select(trainer.scene))["mean"]["psnr"]


def rays_of(scene: Scene, count: int) -> tuple[Rays, Tensor]:
    rays = camera_rays(scene.views[0].camera, scene.near, scene.far)
    truth = torch.from_numpy(scene.images[0].reshape(-1, 3).astype(np.float32) / 65535)
    index = torch.randperm(len(rays), generator=torch.Generator().manual_seed(1))[:count]
    return rays[index], truth[index]


# ---- the law of opacities -------------------------------------------------------------------------------------------


def test_two_stretches_absorb_what_both_together_do() -> None:
    logit, first, second = torch.linspace(-8, 5, 40), 0.3, 1.9
    both = 1 - (1 - opacity(logit, first)) * (1 - opacity(logit, second))
    torch.testing.assert_close(opacity(logit, first + second), both, rtol=1e-4, atol=1e-7)


def test_a_cell_length_has_the_stored_opacity_and_others_its_power() -> None:
    alpha = torch.tensor([0.001, 0.2, 0.5, 0.99], dtype=torch.float64)
    torch.testing.assert_close(opacity(alpha.logit(), 1.0), alpha)
    torch.testing.assert_close(opacity(alpha.logit(), 0.5)[1], torch.tensor(1 - 0.8**0.5, dtype=torch.float64))
    torch.testing.assert_close(opacity(alpha.logit(), 3.0), 1 - (1 - alpha) ** 3)


def test_the_logit_of_a_depth_gives_the_depth() -> None:
    depth = torch.tensor([1e-20, 1e-4, 0.7, 30.0, 500.0])
    torch.testing.assert_close(optical_depth(logit_of(depth), 1.0), depth, rtol=1e-4, atol=0)
    assert logit_of(torch.zeros(1)).isfinite().all()


def test_density_is_minus_log_of_what_a_cell_leaves_per_length(scene: Scene) -> None:
    method = method_of(scene, side="5", coarsest="5")
    volume = method.volume
    volume.logits[..., ALPHA] = torch.logit(torch.tensor(0.3))
    h = (scene.far - scene.near) / 4  # the box is as wide as far − near, and has 4 cells
    sigma = method.density(torch.tensor([[0.1, -0.4, 0.3]]))
    torch.testing.assert_close(sigma, torch.tensor([-np.log(0.7) / h], dtype=torch.float32))
    last = method.trace(rays_of(scene, 4)[0]).passes[-1]
    count = int(last.count[0])  # pyright: ignore[reportOptionalSubscript]
    torch.testing.assert_close(last.sigma[0, :count], sigma.expand(count), rtol=1e-4, atol=0)
    torch.testing.assert_close(last.alpha[0, :count], 1 - 0.7 ** (last.delta[0, :count] / h), rtol=1e-4, atol=0)


# ---- interpolation and gradients ------------------------------------------------------------------------------------


def test_interpolation_gives_a_value_found_by_hand(scene: Scene) -> None:
    logits = torch.zeros(2, 2, 2, 4)
    logits[1, 0, 0, 0], logits[0, 1, 0, 0], logits[1, 1, 1, ALPHA] = 8.0, 4.0, -64.0
    volume = RgbaVolume(logits, Space.of(scene))
    found = volume.at(KERNELS, torch.tensor([[0.75, 0.5, 0.25]]))
    red = 8 * 0.75 * 0.5 * 0.75 + 4 * 0.25 * 0.5 * 0.75
    torch.testing.assert_close(found, torch.tensor([[red, 0, 0, -64 * 0.75 * 0.5 * 0.25]]))


def test_vertices_lie_on_the_box_from_face_to_face(scene: Scene) -> None:
    volume = volume_of(scene, 4)
    corner = torch.tensor([[1.0, 1.0, 1.0]])
    torch.testing.assert_close(volume.at(KERNELS, corner)[0], volume.logits[3, 3, 3])
    torch.testing.assert_close(volume.at(KERNELS, corner / 3)[0], volume.logits[1, 1, 1], rtol=1e-4, atol=1e-5)
    center = torch.tensor(scene.center, dtype=torch.float32)[None]
    torch.testing.assert_close(volume.unit(center), torch.full((1, 3), 0.5))


def test_the_gradient_is_that_of_finite_differences(scene: Scene) -> None:
    method = with_volume(method_of(scene, side="5", coarsest="5", step="0.5"), volume_of(scene, 5))
    rays, truth = rays_of(scene, 24)
    offsets = torch.linspace(0, 1, len(rays))
    method._accumulate(rays, offsets, truth)
    gradient = method.gradient.flatten().clone()
    logits = method.volume.logits.view(-1)
    largest = gradient.abs().topk(30).indices
    for at in largest.tolist():
        error, kept = [], float(logits[at])
        for change in (0.02, -0.02):
            logits[at] = kept + change
            error.append(method._accumulate(rays, offsets, truth)[0] / 3)
        logits[at] = kept
        assert (error[0] - error[1]) / 0.04 == pytest.approx(float(gradient[at]), rel=0.02, abs=2e-4)
    assert {c % 4 for c in largest.tolist()} == {0, 1, 2, 3}


def test_roughness_is_the_gradient_of_squared_differences(scene: Scene) -> None:
    logits = volume_of(scene, 4).logits.double().requires_grad_()
    energy = sum(logits.diff(dim=axis).square().sum() for axis in range(3))
    assert isinstance(energy, Tensor)
    (expected,) = torch.autograd.grad(energy / 2, logits)
    rows = torch.arange(0, 64, 3)
    torch.testing.assert_close(roughness(logits.detach(), rows, neighbours_of(rows, 4)), expected.view(-1, 4)[rows])


# ---- levels, empty space, memory ------------------------------------------------------------------------------------


def test_a_finer_grid_is_the_same_field(scene: Scene) -> None:
    coarse = volume_of(scene, 5)
    fine = coarse.refined(KERNELS, 9, nothing)
    same = fine.logits[::2, ::2, ::2]
    torch.testing.assert_close(same[..., :3], coarse.logits[..., :3], rtol=1e-4, atol=1e-5)
    depth = optical_depth(coarse.logits[..., ALPHA], 1.0)
    torch.testing.assert_close(optical_depth(same[..., ALPHA], 2.0), depth, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("side", "coarsest", "sides"), [(128, 32, (32, 64, 128)), (100, 32, (25, 50, 100)), (2, 2, (2,)), (5, 2, (2, 3, 5))]
)
def test_sides_double_from_level_to_level(side: int, coarsest: int, sides: tuple[int, ...]) -> None:
    config = GridConfig(side=side, coarsest=coarsest, level_steps=10)
    assert config.sides() == sides
    begins = [10 * (2**level - 1) for level in range(len(sides))]
    assert [config.level_at(step) for step in begins] == list(range(len(sides)))
    assert [config.level_at(step - 1) for step in begins[1:]] == list(range(len(sides) - 1))
    assert config.level_at(10**6) == len(sides) - 1


def test_the_state_holds_sixteen_bytes_a_vertex(scene: Scene) -> None:
    method = method_of(scene, side="12", coarsest="6", level_steps="1")
    for step in range(2):
        method.train(*rays_of(scene, 20), step, None, nothing)
    logits = method.state()["logits"]
    assert logits.shape == (12, 12, 12, 4)
    assert logits.dtype == torch.float32
    assert logits.nbytes == method.config.volume_bytes == 12**3 * 16
    assert GridConfig().volume_bytes == 33_554_432


def test_cells_with_an_opaque_corner_are_occupied(scene: Scene) -> None:
    volume = RgbaVolume.fog(6, 1e-4, Space.of(scene), CPU)
    assert not bool(torch.isclose(volume.logits[0, 0, 0, ALPHA], torch.tensor(0.0)))
    volume.logits[2, 3, 0, ALPHA] = 4.0
    found = volume.occupied(0.01, nothing).nonzero().tolist()
    assert found == [[i, j, 0] for i in (1, 2) for j in (2, 3)]


def test_where_all_is_alike_every_cell_is_occupied(scene: Scene) -> None:
    assert bool(RgbaVolume.fog(4, 1e-4, Space.of(scene), CPU).occupied(0.01, nothing).all())


def test_corners_are_the_vertices_of_occupied_cells() -> None:
    occupied = torch.zeros(3, 3, 3, dtype=torch.bool)
    occupied[0, 1, 2] = occupied[1, 1, 2] = True
    expected = [(i * 4 + j) * 4 + k for i in (0, 1, 2) for j in (1, 2) for k in (2, 3)]
    assert corners_of(occupied, nothing).tolist() == expected


def test_a_sample_of_a_cell_that_is_no_cube_counts_by_its_length(scene: Scene) -> None:
    views = tuple(
        replace(v, camera=replace(v.camera, c2w=np.array([[1.0, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]])))
        for v, x in zip(scene.views, np.linspace(-1, 1, len(scene.views)), strict=True)
    )
    ndc = Ndc(16, 16, scene.views[0].camera.fx, 1.0, 20.0)
    method = method_of(replace(scene, views=views, ndc=ndc, near=1.0, far=20.0), side="5", coarsest="5", step="0.5")
    voxel = method.volume.voxel
    assert voxel[0] > 1.2 * voxel[2]
    rays = camera_rays(views[0].camera, 1.0, 20.0)
    last = method.trace(rays[100:120]).passes[-1]
    torch.testing.assert_close(
        last.alpha[:, 0], opacity(method.volume.logits[0, 0, 0, ALPHA], last.delta[:, 0] / method.volume.cell),
        rtol=1e-3, atol=0,
    )  # fmt: skip


# ---- the method -----------------------------------------------------------------------------------------------------


def test_it_learns_a_ball(scene: Scene) -> None:
    changes = {"side": "16", "coarsest": "8", "level_steps": "30", "rays": "512", "update_every": "20"}
    changes["smoothness"] = "1e-4"  # five small photos leave much open
    trainer = Trainer(scene, RunSettings(method="rgba-grid", changes=changes, device="cpu", threads=1))
    before = held_out_psnr(trainer)
    for _ in range(120):
        trainer.step()
    assert isinstance(trainer.method, RgbaGrid)
    assert held_out_psnr(trainer) > before + 6
    assert trainer.method.volume.side == 16
    # all cells are occupied at first; what five small photos leave open stays so
    assert float(trainer.method.cells.occupied.float().mean()) < 0.6


def test_a_colour_is_the_same_towards_all_sides(scene: Scene) -> None:
    method = with_volume(method_of(scene, side="5", coarsest="5"), volume_of(scene, 5))
    rgb = method.radiance(torch.tensor([[0.1, 0.2, 0.3], [-0.5, 0.4, 0.0]]), torch.eye(3))
    torch.testing.assert_close(rgb, rgb[:, :1].expand(-1, 3, -1))
    assert not torch.allclose(rgb[0], rgb[1])


def test_the_walk_marks_the_heaviest_sample_in_three_slices(scene: Scene) -> None:
    method = with_volume(method_of(scene, side="9", coarsest="9"), volume_of(scene, 9))
    rays, _ = rays_of(scene, 1)
    samples = method.trace(rays).passes[-1]
    stages = {stage.title: stage for stage in method.explain(rays)}
    (slices,) = stages["Grid"].charts
    assert isinstance(slices, Pictures)
    best = int(samples.weights[0].argmax())
    x, y, z = (method.volume.unit(rays.origins + samples.t[0, best] * rays.directions)[0] * 8).tolist()
    np.testing.assert_allclose(
        slices.marks, [(y + 0.5, 8.5 - z), (x + 0.5, 8.5 - z), (x + 0.5, 8.5 - y)], rtol=0, atol=1e-3
    )
    assert slices.names == (f"x = {round(x)}", f"y = {round(y)}", f"z = {round(z)}")
    vertex = (torch.sigmoid(method.volume.logits[round(x), 2, 3]) * 255 + 0.5).to(torch.uint8).numpy()
    np.testing.assert_array_equal(slices.images[0][8 - 3, 2], vertex)
    colors = stages["Cell"].charts[1]
    assert isinstance(colors, Colors)
    np.testing.assert_allclose(colors.rgb[-1], samples.rgb[0, best], atol=1e-4)
    cell_alpha = stages["Opacity and density"].charts[0].y[best]  # pyright: ignore[reportAttributeAccessIssue]
    assert float(dict(stages["Cell"].rows)["α of a cell's length"]) == pytest.approx(cell_alpha, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("logits", torch.zeros(6, 6, 6, 4)),
        ("mean", torch.zeros(5, 5, 5, 4, dtype=torch.float64)),
        ("occupied", torch.zeros(4, 4, 4, dtype=torch.bool)),
        ("level", torch.tensor(2)),
        ("updates", torch.tensor(-1)),
        ("per_ray", torch.tensor(float("nan"))),
    ],
)
def test_a_state_that_does_not_fit_is_refused(scene: Scene, name: str, value: Tensor) -> None:
    method = method_of(scene, side="10", coarsest="6")
    state = method.state()
    assert name in state
    method.load_state(state)
    with pytest.raises(ValueError, match=r"fit|occupied|level|updates|samples"):
        method.load_state(state | {name: value})


@pytest.mark.parametrize("side", ["1", "513"])
def test_a_side_out_of_range_is_refused(scene: Scene, side: str) -> None:
    with pytest.raises(UserError, match=f"side={side}: must be at (least 2|most 512)"):
        method_of(scene, side=side)


def test_halving_makes_smaller_pieces_and_ends(scene: Scene) -> None:
    method = method_of(scene, side="10", coarsest="6")
    before, halvings = method.piece, 0
    while method.halve():
        halvings += 1
    assert method.piece == before >> halvings
    assert halvings > 0


def test_a_step_yields_in_each_piece(scene: Scene) -> None:
    calls: list[int] = []
    method = method_of(scene, side="10", coarsest="10")
    method.piece = 10 * int(method.samples_per_ray)
    method.train(*rays_of(scene, 64), 0, None, lambda: calls.append(1))
    assert len(calls) == 7 + 1  # of rays, and one of smoothing
