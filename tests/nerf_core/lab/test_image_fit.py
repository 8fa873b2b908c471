"""The networks that learn a photo: their encodings, what they learn from, and how they are stored and restarted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.lab.image_fit import (
    MAPPINGS,
    TEST,
    TRAINING,
    ImageConfig,
    ImageFit,
    coordinates,
    encode,
    fitted,
    frequencies,
    network,
)
from nerf_core.lab.sample_photo import sample_photo

SMALL = ImageConfig(size=12, batch=16, width=16, features=8, frequencies=3, sigma=2.0)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return sample_photo(128)


def same(a: ImageFit, b: ImageFit, *names: str) -> bool:
    return all(np.array_equal(a.picture(name), b.picture(name)) for name in names or MAPPINGS)


# --- encodings -----------------------------------------------------------------------------------------------------


def encoded(name: str, *places: tuple[float, float], **changes: float) -> list[list[float]]:
    config = replace(ImageConfig(), **changes)
    b = frequencies(name, config, torch.tensor([[1.0, 0.5]]))
    return [[round(value, 5) + 0.0 for value in row] for row in encode(torch.tensor(places), b).tolist()]


def test_encodings_have_the_values_of_the_formula() -> None:
    """sin 2π(½, ¼) = (0, 1), cos 2π(½, ¼) = (−1, 0); twice the frequency gives (0, 0) and (1, −1)."""
    at = (0.5, 0.25)
    assert encoded("none", at) == [[0.5, 0.25]]
    assert encoded("basic", at) == [[0, 1, -1, 0]]
    assert encoded("positional", at, frequencies=2) == [[0, 0, 1, 0, -1, 1, 0, -1]]
    # B = 2 (1, ½): sin 2π(2 · ½ + 1 · ¼) = 1
    assert encoded("gaussian", at, sigma=2.0) == [[1, 0]]


def test_positional_encoding_is_that_of_nerf() -> None:
    """Its Eq. 4, sin 2ᵏπp and cos 2ᵏπp with p = 2v − 1: of k = 0 the signs are opposite, all others are equal."""
    v = torch.rand(20, 2, generator=torch.Generator().manual_seed(1))
    angles = torch.tensor([1.0, 2, 4, 8]) * math.pi * (2 * v - 1)[..., None]
    nerf = torch.tensor([-1.0, 1, 1, 1]) * torch.stack([angles.sin(), angles.cos()], 1)
    ours = encode(v, frequencies("positional", ImageConfig(frequencies=4), torch.empty(0, 2))).reshape(20, 2, 2, 4)
    assert (ours - nerf).abs().max() < 1e-5


def test_gaussian_frequencies_have_the_standard_deviation_sigma() -> None:
    normal = torch.randn(4000, 2, generator=torch.Generator().manual_seed(2))
    b = frequencies("gaussian", ImageConfig(sigma=7.0), normal)
    assert b.std().item() == pytest.approx(7.0, rel=0.03)
    assert b.mean(0).abs().max() < 0.4


def test_coordinates_are_columns_and_rows_over_the_longest_side() -> None:
    assert coordinates(2, 4).tolist() == [[0, 0], [0.25, 0], [0.5, 0], [0.75, 0],
                                          [0, 0.25], [0.25, 0.25], [0.5, 0.25], [0.75, 0.25]]  # fmt: skip


# --- networks and pixels -------------------------------------------------------------------------------------------


def test_networks_have_the_papers_sizes(photo: np.ndarray) -> None:
    """The lecture: from bare coordinates 133,123 parameters, eight times the 128 × 128 pixels."""
    fit = ImageFit(photo, ImageConfig(frequencies=6), seed=0)
    hidden_and_output = 2 * (256 * 256 + 256) + 256 * 3 + 3
    inputs = {"none": 2, "basic": 4, "positional": 24, "gaussian": 512}
    assert {name: fit.parameters(name) for name in MAPPINGS} == {
        name: count * 256 + 256 + hidden_and_output for name, count in inputs.items()
    }
    assert fit.parameters("none") == 133_123
    assert fit.parameters("none") // 128**2 == 8


def test_first_weights_are_glorot_normal() -> None:
    layers = [m for m in network(512, 256, torch.Generator().manual_seed(0)) if isinstance(m, torch.nn.Linear)]
    for layer, inputs, outputs in zip(layers, (512, 256, 256, 256), (256, 256, 256, 3), strict=True):
        assert layer.weight.std().item() == pytest.approx(math.sqrt(2 / (inputs + outputs)), rel=0.05)
    assert torch.cat([layer.bias for layer in layers]).std().item() == pytest.approx(0.01, rel=0.1)


def test_training_pixels_have_even_rows_and_columns_and_test_pixels_odd_ones() -> None:
    shown = np.full((3, 4), ".")
    shown[TRAINING], shown[TEST] = "T", "e"
    assert ["".join(row) for row in shown] == ["T.T.", ".e.e", "T.T."]


def test_only_training_pixels_are_learned(photo: np.ndarray) -> None:
    """A photo with other colours everywhere else gives the same networks."""
    other = 1 - photo[:12, :12]
    other[TRAINING] = photo[:12, :12][TRAINING]
    first, second = ImageFit(photo[:12, :12], SMALL, seed=3), ImageFit(other, SMALL, seed=3)
    for _ in range(3):
        first.step()
        second.step()
    assert same(first, second)
    assert first.psnr("none")[0] == second.psnr("none")[0]
    assert first.psnr("none")[1] != second.psnr("none")[1]


def test_a_large_batch_is_all_training_pixels(photo: np.ndarray) -> None:
    fit = ImageFit(photo, replace(SMALL, batch=36), seed=0)
    error = np.square(fit.picture("basic")[TRAINING] - fit.photo[TRAINING]).mean()
    assert fit.step("basic") == {"basic": pytest.approx(error, rel=1e-5)}


def test_psnr_is_that_of_the_two_grids(photo: np.ndarray) -> None:
    fit = ImageFit(photo, SMALL, seed=0)
    picture = fit.photo.copy()
    picture[TRAINING] += 0.1
    picture[TEST] -= 0.01
    assert fit.psnr("none", picture) == (pytest.approx(20.0, abs=1e-3), pytest.approx(40.0, abs=1e-3))
    assert fit.psnr("none") == fit.psnr("none", fit.picture("none"))


def test_a_photo_is_averaged_to_its_longest_side() -> None:
    stripes = np.zeros((4, 8, 3), np.float32)
    stripes[:, ::2] = 0.5
    small = fitted(stripes, 4)
    assert small.shape == (2, 4, 3)
    assert np.all(small == 0.25)
    assert np.array_equal(fitted(stripes, 100), stripes)


def test_a_photo_that_is_no_square_is_learned(photo: np.ndarray) -> None:
    fit = ImageFit(photo[:40, :72], replace(SMALL, size=18), seed=0)
    fit.step()
    assert fit.picture("gaussian").shape == fit.photo.shape == (10, 18, 3)


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 4), (1, 4, 3)])
def test_what_is_no_photo_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected a photo"):
        ImageFit(np.zeros(shape, np.float32), SMALL, seed=0)


def test_constants_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match="frequencies=17"):
        ImageConfig(frequencies=17)


def test_frequencies_suit_the_size_of_the_photo() -> None:
    """The paper's constants at its size; half the frequencies where there are half the pixels."""
    suited = {size: ImageConfig.suiting(size) for size in (8, 128, 256, 512, 1024)}
    assert {size: c.frequencies for size, c in suited.items()} == {8: 1, 128: 4, 256: 5, 512: 6, 1024: 7}
    assert {size: c.sigma for size, c in suited.items()} == {8: 0.3125, 128: 5, 256: 10, 512: 10, 1024: 10}
    assert suited[128] == ImageConfig()
    assert ImageConfig.suiting(64, sigma=7.0, steps=9) == ImageConfig(size=64, frequencies=3, sigma=7.0, steps=9)


def test_a_picture_can_be_given_up(photo: np.ndarray) -> None:
    class Stopped(Exception): ...

    def stop() -> None:
        raise Stopped

    with pytest.raises(Stopped):
        ImageFit(photo, SMALL, seed=0).picture("none", stop)


# --- learning ------------------------------------------------------------------------------------------------------


def test_better_encodings_learn_more_of_the_photo(photo: np.ndarray) -> None:
    """The paper's order, on a small photo: each encoding is better than the one before on pixels it never saw."""
    config = ImageConfig(
        size=64,
        batch=256,
        width=64,
        features=128,
        frequencies=3,
        sigma=3.0,
        learning_rate=3e-3,
        plain_learning_rate=3e-3,
    )
    fit = ImageFit(photo, config, seed=0)
    for _ in range(100):
        fit.step()
    none, basic, positional, gaussian = (fit.psnr(name)[1] for name in MAPPINGS)
    assert none > 10
    assert basic > none + 0.5
    assert positional > basic + 0.5
    assert gaussian > positional + 0.5


def test_one_seed_gives_one_result_whatever_the_order_of_steps(photo: np.ndarray) -> None:
    together, apart, other = (ImageFit(photo, SMALL, seed) for seed in (5, 5, 6))
    for _ in range(4):
        together.step()
        other.step()
    for name in reversed(MAPPINGS):
        for _ in range(4):
            apart.step(name)
    assert together.steps == apart.steps == dict.fromkeys(MAPPINGS, 4)
    assert same(together, apart)
    assert not any(same(together, other, name) for name in MAPPINGS)


@pytest.mark.parametrize("replaced", [False, True])
def test_a_restored_fit_goes_on_as_if_never_stopped(photo: np.ndarray, replaced: bool) -> None:
    whole, later = ImageFit(photo, SMALL, seed=1), ImageFit(photo, SMALL, seed=2)
    if replaced:
        whole.replace("positional", 5)
        whole.replace("gaussian", 4.5)
    for _ in range(3):
        whole.step()
    stored = {name: value.clone() for name, value in whole.state().items()}
    later.load_state(stored)
    assert later.config == whole.config
    assert later.steps == whole.steps
    for _ in range(3):
        assert later.step() == whole.step()
    assert same(whole, later)


def test_a_state_before_the_first_step_is_restored(photo: np.ndarray) -> None:
    first, second = ImageFit(photo, SMALL, seed=1), ImageFit(photo, SMALL, seed=2)
    second.step()
    second.load_state(first.state())
    assert second.step() == first.step()
    assert same(first, second)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda state: state.pop("gaussian.b"),
        lambda state: state.update({"none.0.weight": torch.zeros(3, 3)}),
        lambda state: state.update({"gaussian.b": torch.zeros(5, 2)}),
        lambda state: state.update({"frequencies": torch.tensor(99.0)}),
    ],
)
def test_a_state_that_does_not_fit_changes_nothing(
    photo: np.ndarray, spoil: Callable[[dict[str, torch.Tensor]], object]
) -> None:
    fit, untouched = ImageFit(photo, SMALL, seed=1), ImageFit(photo, SMALL, seed=1)
    other = ImageFit(photo, SMALL, seed=2)
    other.step()
    state = other.state()
    spoil(state)
    with pytest.raises((KeyError, RuntimeError, ValueError, UserError)):
        fit.load_state(state)
    assert same(fit, untouched)
    assert fit.step() == untouched.step()


@pytest.mark.parametrize(("name", "value"), [("positional", 5), ("gaussian", 4.5)])
def test_a_replaced_mapping_starts_again_with_the_new_constant(photo: np.ndarray, name: str, value: float) -> None:
    constant = {"positional": "frequencies", "gaussian": "sigma"}[name]
    fresh = ImageFit(photo, replace(SMALL, **{constant: value}), seed=1)
    fit = ImageFit(photo, SMALL, seed=1)
    fit.step()
    fit.replace(name, value)
    assert fit.config == fresh.config
    assert fit.steps == {other: int(other != name) for other in MAPPINGS}
    for _ in range(2):
        assert fit.step(name) == fresh.step(name)
    assert same(fit, fresh, name)


def test_a_mapping_without_a_constant_cannot_be_replaced(photo: np.ndarray) -> None:
    with pytest.raises(KeyError):
        ImageFit(photo, SMALL, seed=1).replace("basic", 2)
