"""Flatland: exact photos against closed forms, learning by the paper's equations, going on from a file, the film."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from films import decoded

from nerf_core.datasets import LoadOptions
from nerf_core.lab.flatland.course import CAMERA, PIXEL, Course, L
from nerf_core.lab.flatland.film import frame_size, write_film
from nerf_core.lab.flatland.fit import FlatConfig, FlatFit, Truth, truth_of
from nerf_core.lab.flatland.rays import PIXELS, FlatRays, camera_rays, ring
from nerf_core.lab.flatland.world import Shape, World
from nerf_core.lab.job import StudyJob
from nerf_core.lab.studies import flatland
from nerf_core.lab.studies.flatland import Flatland
from nerf_core.lab.study import Subject

RED, BLUE = torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.2, 0.9])
SMALL = FlatConfig(steps=60, cameras=4, coarse=12, fine=8)


def plain(color: torch.Tensor, x: float, half: float, sigma: float) -> Shape:
    """A wall across the x axis."""
    return Shape((x, 0.0), (half, 0.8), sigma, lambda q, d: color.expand(len(q), 3))


@pytest.fixture(scope="module")
def truth() -> Truth:
    found = list(truth_of(World(), SMALL.cameras))
    assert isinstance(found[-1], Truth)
    return found[-1]


def test_a_photo_is_the_closed_form_of_its_slabs() -> None:
    """Through two slabs: C = (1 − e^(−σ₁d₁)) c₁ + e^(−σ₁d₁) ((1 − e^(−σ₂d₂)) c₂ + e^(−σ₂d₂) background)."""
    world = World((plain(RED, 0.4, 0.2, 3.0), plain(BLUE, -0.3, 0.1, 5.0)))
    rays = FlatRays(torch.tensor([[1.4, 0.0]]), torch.tensor([[-1.0, 0.0]]), torch.tensor([0.4]), torch.tensor([2.4]))
    first, second = math.exp(-3.0 * 0.4), math.exp(-5.0 * 0.2)
    expected = (1 - first) * RED + first * ((1 - second) * BLUE + second * world.background)
    torch.testing.assert_close(world.colors(rays)[0], expected, atol=2e-4, rtol=0)


def test_the_glossy_disc_mirrors_its_lamp() -> None:
    """Its colour changes with the direction, and no other shape's does."""
    p = torch.tensor([[0.46 + 0.1, 0.40], [0.42, -0.40]])
    seen = [World().radiance(p, torch.tensor([d, d]))[1] for d in ([-1.0, 0.0], [0.6, 0.8])]
    assert float((seen[0][0] - seen[1][0]).abs().max()) > 0.1
    assert torch.equal(seen[0][1], seen[1][1])


def test_cameras_face_the_middle_and_held_out_ones_stand_between() -> None:
    training, held_out = ring(4)
    np.testing.assert_allclose(held_out, np.array(training) + math.pi / 4)
    rays = camera_rays(training + held_out)
    ends = rays.points(torch.stack([rays.near, rays.far], 1))
    np.testing.assert_allclose(ends.norm(dim=-1), 1.0, atol=1e-5)  # they enter and leave the world's disc
    eye, left = rays.origins[0], rays.directions[0]
    assert float(eye[0] * left[1] - eye[1] * left[0]) < 0  # the first pixel is left of the middle, seen from the camera
    assert len(ring(40)[1]) == 8


def test_the_loss_reaches_both_networks_and_draws_come_from_the_coarse_weights(truth: Truth) -> None:
    fit = FlatFit(World(), truth, SMALL)
    coarse, fine = fit.passes(truth.rays, torch.Generator().manual_seed(0))
    assert coarse.t.shape[1] == 12
    assert fine.t.shape[1] == 20
    loss = sum((one.color - truth.colors).square().mean() for one in (coarse, fine))
    assert isinstance(loss, torch.Tensor)
    loss.backward()
    for network in fit.networks.values():
        assert all(p.grad is not None and float(p.grad.abs().sum()) > 0 for p in network.parameters())
    torch.testing.assert_close(fine.weights.sum(1) + fine.transmittance[:, -1] * (1 - fine.alpha[:, -1]),
                               torch.ones(len(truth.rays)))  # fmt: skip


def test_it_learns_the_photos(truth: Truth) -> None:
    fit = FlatFit(World(), truth, SMALL)
    before = fit.photo(0)
    for _ in range(60):
        fit.step()
    exact = truth.colors[:PIXELS].numpy()
    gain = 10 * math.log10(float(np.square(before - exact).mean() / np.square(fit.photo(0) - exact).mean()))
    assert gain > 4, f"{gain:.1f} dB"


def test_networks_of_other_frequencies_learn_the_same_noisy_photos(truth: Truth) -> None:
    first, second, other = (
        FlatFit(World(), truth, FlatConfig(frequencies=count, noise=0.1, seed=seed)).photos
        for count, seed in ((0, 0), (8, 0), (8, 1))
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert float((first - truth.colors[: len(first)]).std()) == pytest.approx(0.1, rel=0.1)


def test_without_directions_a_point_looks_the_same_from_all_sides(truth: Truth) -> None:
    p, d = torch.zeros(2, 2), torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    for directions in (0, 3):
        network = FlatFit(World(), truth, FlatConfig(directions=directions)).networks["fine"]
        sigma, rgb = network(p, d)
        torch.testing.assert_close(sigma[0], sigma[1])
        assert torch.allclose(rgb[0], rgb[1], atol=1e-5) == (directions == 0)


# ---- the study ---------------------------------------------------------------------------------------------------


def job(folder: Path, seed: int = 0, fine: int = 4) -> StudyJob:
    study = Flatland(steps=6, cameras=2, coarse=8, fine=fine, seed=seed)
    return StudyJob(study, Subject(None, LoadOptions(), None, "cpu"), folder)


def frames_of(film: Path) -> np.ndarray:
    wide, high = frame_size()
    return decoded(film, high, wide)


def through(job: StudyJob) -> str:
    while job.advance():
        pass
    return (job.folder / "results.json").read_text(encoding="utf-8")


@pytest.mark.parametrize("fine", [4, 0])  # without fine samples, the fine network has no gradients
def test_a_study_that_was_interrupted_ends_as_if_it_had_not_been(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fine: int
) -> None:
    monkeypatch.setattr(flatland, "draw_figure", lambda results, pictures: b"")  # it takes a second
    whole = through(job(tmp_path / "whole", fine=fine))
    assert through(job(tmp_path / "again", fine=fine)) == whole
    assert through(job(tmp_path / "seed", seed=1, fine=fine)) != whole
    for pieces in (3, 11):
        parts = job(tmp_path / f"parts {pieces}", fine=fine)
        for _ in range(pieces):
            parts.advance()
        parts.cancel()
        assert (parts.folder / "runs" / "complete" / "course.safetensors").exists() == (pieces == 11)
        assert through(job(parts.folder, fine=fine)) == whole
    result = json.loads(whole)["complete"]["result"]
    assert result["curve"][0] == [0, 6]
    assert result["psnr"] == pytest.approx(result["curve"][1][-1])
    film = tmp_path / "whole" / "pictures" / "complete" / "flatland.mp4"
    assert len(frames_of(film)) > 7


def test_frames_show_the_field_beside_the_world(tmp_path: Path) -> None:
    red, blue = (np.full((8, 8, 3), c, np.uint8) for c in ((220, 30, 20), (20, 40, 200)))
    for _ in write_film(tmp_path / "film.mp4", [red], [red[0]], (blue, blue[0]), ["step 0"]):
        pass
    first = frames_of(tmp_path / "film.mp4")[0]
    high, wide = first.shape[:2]
    np.testing.assert_allclose(first[high // 2, wide // 4], red[0, 0], atol=12)
    np.testing.assert_allclose(first[high // 2, 3 * wide // 4], blue[0, 0], atol=12)


def test_a_window_sees_the_chosen_ray_and_a_knob_begins_anew() -> None:
    turned: dict[str, float] = {CAMERA: 3.0, PIXEL: 20.0}
    course = Course(SMALL, turned, watched=True)
    pieces = course.pieces()
    view = next(piece.flat for piece in pieces if piece.flat is not None and piece.flat.ray is not None)
    assert view.ray is not None
    assert (view.ray.camera, view.ray.pixel, view.training) == (3, 20, 4)
    assert [(one.name, len(one.t)) for one in view.ray.passes] == [("coarse", 12), ("fine", 20)]
    np.testing.assert_allclose(view.ray.passes[-1].color,
                               view.learnt[3, 20] / 255, atol=1 / 255)  # fmt: skip
    while course.fit is None or course.fit.steps < 5:
        next(pieces)
    fit, turned["fine"] = course.fit, 0.0
    later = next(piece.flat for piece in pieces if piece.flat is not None and piece.flat.ray is not None
                 and len(piece.flat.ray.passes) == 1)  # fmt: skip
    assert course.fit is fit  # samples go elsewhere, and the network goes on
    assert later.step > view.step
    turned[L] = 0.0
    while course.fit is fit:
        next(pieces)
    assert course.fit is None or course.fit.steps == 0
    assert course.config.frequencies == 0
