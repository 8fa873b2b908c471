"""The metrics against independent computations: the formula itself, scikit-image, an LPIPS written with modules."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import nn

from nerf_core.common.errors import UserError
from nerf_core.training.metrics import Lpips, psnr, ssim

WIDTHS = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256} | dict.fromkeys((17, 19, 21, 24, 26, 28), 512)


def pair(height: int, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3)).cumsum(0)
    truth /= truth.max()
    return np.clip(truth + 0.1 * rng.standard_normal(truth.shape), 0, 1).astype(np.float32), truth.astype(np.float32)


def test_psnr_is_the_formula() -> None:
    black, grey = np.zeros((4, 5, 3)), np.full((4, 5, 3), 0.1)
    assert psnr(black, grey) == pytest.approx(20)
    one_channel = black.copy()
    one_channel[..., 0] = 0.1
    assert psnr(one_channel, black) == pytest.approx(20 + 10 * math.log10(3))
    image, truth = pair(13, 17)
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth, image, data_range=1), abs=1e-5)
    assert psnr(truth, truth) == math.inf


@pytest.mark.parametrize(("height", "width"), [(11, 11), (11, 40), (37, 23), (64, 64)])
def test_ssim_agrees_with_scikit_image(height: int, width: int) -> None:
    image, truth = pair(height, width, seed=height)
    theirs: Any = structural_similarity(
        image.astype(np.float64),
        truth.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=2,
    )
    assert ssim(image, truth) == pytest.approx(float(theirs), abs=1e-6)
    assert ssim(truth, image) == pytest.approx(ssim(image, truth), abs=1e-12)
    assert ssim(truth, truth) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_shapes_must_agree(metric: Callable[[np.ndarray, np.ndarray], float]) -> None:
    with pytest.raises(ValueError, match=r"\(12, 12, 3\) and \(12, 13, 3\)"):
        metric(np.zeros((12, 12, 3)), np.zeros((12, 13, 3)))


def test_image_smaller_than_the_window() -> None:
    with pytest.raises(UserError, match="at least 11 pixels a side, not 30 × 10"):
        ssim(np.zeros((10, 30, 3)), np.zeros((10, 30, 3)))


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    """Random VGG16 and heads; scaled so that features neither vanish nor explode, heads ≥ 0 as learned ones are."""
    generator = torch.Generator().manual_seed(0)
    tensors: dict[str, torch.Tensor] = {}
    inputs = 3
    for index, outputs in WIDTHS.items():
        tensors[f"features.{index}.weight"] = (
            torch.randn(outputs, inputs, 3, 3, generator=generator) * (2 / (9 * inputs)) ** 0.5
        )
        tensors[f"features.{index}.bias"] = torch.randn(outputs, generator=generator) * 0.1
        inputs = outputs
    for block, channels in enumerate((64, 128, 256, 512, 512)):
        tensors[f"lin{block}.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return tensors


@pytest.fixture(scope="module")
def file(weights: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "vgg.safetensors"
    save_file(weights, path)
    return path


def straightforward(weights: dict[str, torch.Tensor], image: np.ndarray, truth: np.ndarray) -> float:
    """LPIPS as its authors define it, on torchvision's layers cut after relu1_2, 2_2, 3_3, 4_3 and 5_3."""
    layers: list[nn.Module] = []
    inputs = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width:
            layers += [nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU()]
            inputs = width
        else:
            layers.append(nn.MaxPool2d(2, 2))
    network = nn.Sequential(*layers)
    network.load_state_dict({k.removeprefix("features."): v for k, v in weights.items() if k.startswith("features.")})

    def features(pixels: np.ndarray) -> list[np.ndarray]:
        scaled = (pixels * 2.0 - 1.0 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        x = torch.from_numpy(scaled.transpose(2, 0, 1)[None]).float()
        kept = []
        for index, layer in enumerate(network):
            x = layer(x)
            if index in (3, 8, 15, 22, 29):
                kept.append(x[0].detach().double().numpy())
        return kept

    total = 0.0
    for block, (a, b) in enumerate(zip(features(image), features(truth), strict=True)):
        a_unit, b_unit = (f / np.linalg.norm(f, axis=0) for f in (a, b))
        head = weights[f"lin{block}.weight"].double().numpy().ravel()
        total += float(np.einsum("c,chw->hw", head, (a_unit - b_unit) ** 2).mean())
    return total


@pytest.mark.parametrize(("height", "width"), [(16, 16), (33, 50)])
def test_lpips_is_its_definition(file: Path, weights: dict[str, torch.Tensor], height: int, width: int) -> None:
    image, truth = pair(height, width)
    lpips = Lpips(file)
    assert lpips(image, truth) == pytest.approx(straightforward(weights, image, truth), rel=1e-4)
    assert lpips(truth, image) == pytest.approx(lpips(image, truth), rel=1e-6)
    assert lpips(image, image) == 0
    assert lpips(image, truth) > lpips(0.5 * image + 0.5 * truth, truth) > 0


def test_lpips_of_a_small_image(file: Path) -> None:
    with pytest.raises(UserError, match="at least 16 pixels a side, not 15 × 20"):
        Lpips(file)(np.zeros((20, 15, 3)), np.zeros((20, 15, 3)))


class Payload:
    """Writes a file when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return eval, (f"open({str(self.target)!r}, 'w').close()",)


def test_a_pickle_is_never_loaded(tmp_path: Path) -> None:
    for name in ("plain.pth", "disguised.safetensors"):
        (tmp_path / name).write_bytes(pickle.dumps(Payload(tmp_path / "ran")))
        with pytest.raises(
            UserError, match=r"pickle.*never loaded.*convert them .* with safetensors\.torch\.save_file"
        ):
            Lpips(tmp_path / name)
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "torch.pth")
    with pytest.raises(UserError, match=r"torch\.pth are not a safetensors file"):
        Lpips(tmp_path / "torch.pth")
    assert not (tmp_path / "ran").exists()


def test_files_that_are_not_the_weights(weights: dict[str, torch.Tensor], file: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot read .*none\.safetensors: No such file"):
        Lpips(tmp_path / "none.safetensors")
    (tmp_path / "empty.safetensors").touch()
    with pytest.raises(UserError, match=r"not a safetensors file"):
        Lpips(tmp_path / "empty.safetensors")
    (tmp_path / "short.safetensors").write_bytes(file.read_bytes()[:5000])
    with pytest.raises(UserError, match="damaged"):
        Lpips(tmp_path / "short.safetensors")
    missing = {name: value for name, value in weights.items() if name != "lin3.weight"}
    save_file(missing, tmp_path / "missing.safetensors")
    with pytest.raises(UserError, match=r"missing\.safetensors lack lin3\.weight"):
        Lpips(tmp_path / "missing.safetensors")
    save_file(missing | {"lin3.weight": torch.zeros(1, 64, 1, 1)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match=r"lin3\.weight .* shape \(1, 64, 1, 1\), not \(1, 512, 1, 1\)"):
        Lpips(tmp_path / "other.safetensors")


def test_masked_pixels_are_not_measured() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(size=(30, 40, 3)).astype(np.float32)
    image, mask = truth + np.float32(0.01), np.ones((30, 40), bool)
    mask[:, :10] = False
    broken = np.where(mask[..., None], image, 0)
    assert psnr(broken, truth, mask) == pytest.approx(40, abs=0.01)
    assert ssim(broken, truth, mask) == pytest.approx(ssim(image[:, 10:], truth[:, 10:]), abs=1e-12)
    assert ssim(broken, truth, mask & (np.arange(40) % 10 > 0)) is None
