"""Metrics of a rendered image against its photo. Images are float (H, W, 3) in [0, 1], sRGB-encoded."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import utf8_path

SSIM_TAPS, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # (K L)² with K = 0.01, 0.03 and L = 1

# VGG16's convolutions in five blocks, as N of torchvision's `features.N` and output channels. Poolings lie between the
# blocks.
VGG_BLOCKS = (
    ((0, 64), (2, 64)),
    ((5, 128), (7, 128)),
    ((10, 256), (12, 256), (14, 256)),
    ((17, 512), (19, 512), (21, 512)),
    ((24, 512), (26, 512), (28, 512)),
)
VGG_SMALLEST = 16  # pixels: four poolings halve the image
# LPIPS' own input scaling: ImageNet's mean and deviation for images in [−1, 1].
LPIPS_SHIFT = (-0.030, -0.088, -0.188)
LPIPS_SCALE = (0.458, 0.448, 0.450)
LPIPS_EPS = 1e-10  # the official code's; it keeps the division defined for a pixel whose features are all 0


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB: 20 log₁₀(MAX / √MSE) with MAX = 1.

    Args:
        image, truth: (H, W, 3). The squared error is averaged over pixels and channels.
        mask: (H, W) bool, the pixels that count, at least one; None: all.

    Returns:
        The PSNR; math.inf for identical images.

    Raises:
        ValueError: the shapes differ, or are not (H, W, 3).
    """
    _check(image, truth)
    if mask is not None:
        image, truth = image[mask], truth[mask]
    error = float(np.mean((image.astype(np.float64) - truth.astype(np.float64)) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Return the structural similarity (Wang et al. 2004, Eq. 13), in [−1, 1].

        (2 μx μy + C1)(2 σxy + C2) / ((μx² + μy² + C1)(σx² + σy² + C2))

    Means and biased variances are taken under a Gaussian of 11 × 11 taps and σ = 1.5. The result is averaged over
    channels and over the pixels whose window lies inside the image.

    Args:
        image, truth: (H, W, 3).
        mask: (H, W) bool, the pixels that count; None: all. A window that has others does not count either.

    Returns:
        The similarity; None if no window counts.

    Raises:
        UserError: the images are smaller than the window.
        ValueError: the shapes differ, or are not (H, W, 3).
    """
    _check(image, truth)
    height, width = image.shape[:2]
    if min(height, width) < SSIM_TAPS:
        raise UserError(f"SSIM needs images of at least {SSIM_TAPS} pixels a side, not {width} × {height}")
    x, y = (torch.from_numpy(v.astype(np.float64)).permute(2, 0, 1) for v in (image, truth))
    offsets = torch.arange(SSIM_TAPS, dtype=torch.float64) - SSIM_TAPS // 2
    window = torch.softmax(-(offsets**2) / (2 * SSIM_SIGMA**2), 0)  # a Gaussian with the sum 1
    maps = torch.stack([x, y, x * x, y * y, x * y])
    flat = maps.reshape(-1, 1, height, width)
    flat = functional.conv2d(functional.conv2d(flat, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))
    mx, my, xx, yy, xy = flat.reshape(*maps.shape[:2], *flat.shape[2:])
    numerator = (2 * mx * my + SSIM_C1) * (2 * (xy - mx * my) + SSIM_C2)
    denominator = (mx * mx + my * my + SSIM_C1) * (xx - mx * mx + yy - my * my + SSIM_C2)
    if mask is None:
        return float((numerator / denominator).mean())
    whole = functional.max_pool2d(torch.from_numpy(~mask)[None, None].float(), SSIM_TAPS, 1)[0, 0] == 0
    return float((numerator / denominator)[:, whole].mean()) if whole.any() else None


def psnr_matched(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Return the PSNR of the right half in dB, after a gain and an offset per channel were fitted to the left half.

    A photo's own exposure is not known to a model that was not trained on it. Half of the photo tells it, and the other
    half is measured (as in NeRF in the Wild, arXiv:2008.02268).

    Args:
        image, truth: (H, W, 3).
        mask: (H, W) bool, the pixels that count; None: all.

    Returns:
        The PSNR, math.inf for identical halves; None if no pixel of a half counts.

    Raises:
        ValueError: the shapes differ, or are not (H, W, 3).
    """
    _check(image, truth)
    mask = np.ones(image.shape[:2], bool) if mask is None else mask
    left, right = (mask & (half == (np.arange(mask.shape[1]) >= mask.shape[1] // 2)) for half in (False, True))
    if not left.any() or not right.any():
        return None
    x, y = (v[left].astype(np.float64) for v in (image, truth))
    spread = x.var(0)
    gain = np.where(spread > 1e-9, ((x - x.mean(0)) * (y - y.mean(0))).mean(0) / np.maximum(spread, 1e-9), 1.0)
    offset = y.mean(0) - gain * x.mean(0)
    return psnr(np.clip(gain * image + offset, 0, 1), truth, right)


class Lpips:
    """Learned perceptual image patch similarity, version 0.1 with VGG16 (Zhang et al. 2018, Eq. 1, arXiv:1801.03924).

    The user supplies the weights as one .safetensors file. It has torchvision's vgg16 keys `features.N.weight` and
    `features.N.bias` (N = 0, 2, 5, … 28) and the learned heads `lin0.weight` … `lin4.weight`, (1, C, 1, 1) each. A
    pickle is never loaded, because loading one can run code.
    """

    def __init__(self, path: Path, device: torch.device | None = None) -> None:
        """Load the weights.

        Args:
            path: the file.
            device: where to compute; None: the CPU.

        Raises:
            UserError: the file cannot be read, or lacks a tensor.
        """
        self._weights = {name: value.to(device) for name, value in _load(path).items()}
        self._shift = torch.tensor(LPIPS_SHIFT, device=device).view(1, 3, 1, 1)
        self._scale = torch.tensor(LPIPS_SCALE, device=device).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, image: np.ndarray, truth: np.ndarray) -> float:
        """Return the distance of two images; 0 for equal ones.

        It is Σ over blocks of the spatial mean of Σ_c lin_c (x̂_c − ŷ_c)², where x̂ and ŷ are the features of a pixel,
        normalised to unit length over the channels c.

        Args:
            image, truth: (H, W, 3).

        Raises:
            UserError: the images are smaller than 16 pixels on a side.
            ValueError: the shapes differ, or are not (H, W, 3).
        """
        _check(image, truth)
        height, width = image.shape[:2]
        if min(height, width) < VGG_SMALLEST:
            raise UserError(f"LPIPS needs images of at least {VGG_SMALLEST} pixels a side, not {width} × {height}")
        both = torch.from_numpy(np.stack([image, truth]).astype(np.float32)).permute(0, 3, 1, 2)
        features = (both.to(self._shift.device) * 2 - 1 - self._shift) / self._scale
        distance = 0.0
        for block, convolutions in enumerate(VGG_BLOCKS):
            if block:
                features = functional.max_pool2d(features, 2)
            for index, _ in convolutions:
                weight, bias = (self._weights[f"features.{index}.{kind}"] for kind in ("weight", "bias"))
                features = functional.conv2d(features, weight, bias, padding=1).relu()
            x, y = features / (features.square().sum(1, keepdim=True).sqrt() + LPIPS_EPS)
            distance += float(functional.conv2d((x - y).square()[None], self._weights[f"lin{block}.weight"]).mean())
        return distance


def _check(image: np.ndarray, truth: np.ndarray) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"images to compare are both (H, W, 3), not {image.shape} and {truth.shape}")


def _shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor of an LPIPS file, by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 3
    for block, convolutions in enumerate(VGG_BLOCKS):
        for index, outputs in convolutions:
            shapes[f"features.{index}.weight"] = (outputs, inputs, 3, 3)
            shapes[f"features.{index}.bias"] = (outputs,)
            inputs = outputs
        shapes[f"lin{block}.weight"] = (1, inputs, 1, 1)
    return shapes


def _load(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError, safe_open

    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as error:
        raise UserError(f"cannot read the LPIPS weights {path}: {error.strerror}") from error
    if start[8:] != b"{":  # a safetensors file is 8 bytes of length, then JSON
        raise UserError(
            f"the LPIPS weights {path} are not a safetensors file (a .pth is a pickle, which can run code: it is never "
            "loaded): convert them once, where you trust them, with safetensors.torch.save_file(tensors, FILE), "
            "named features.N.weight, features.N.bias and lin0.weight … lin4.weight"
        )
    weights: dict[str, Tensor] = {}
    try:
        with utf8_path(path) as readable, safe_open(readable, framework="pt") as file:
            present = set(file.keys())
            for name, shape in _shapes().items():
                if name not in present:
                    raise UserError(f"the LPIPS weights {path} lack {name}: put VGG16 and the five heads in one file")
                value = file.get_tensor(name)
                if tuple(value.shape) != shape:
                    raise UserError(
                        f"{name} in the LPIPS weights {path} has the shape {tuple(value.shape)}, not {shape}"
                    )
                weights[name] = value.float()
    except (SafetensorError, OSError) as error:
        raise UserError(f"the LPIPS weights {path} are damaged ({shorten(str(error))}): convert them again") from error
    return weights
