"""How close a rendered image comes to the photo. Images are float (H, W, 3), sRGB-encoded, in [0, 1]."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.common.errors import UserError, shorten

SSIM_TAPS, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # (K L)² with K = 0.01, 0.03 and L = 1

# VGG16's convolutions (torchvision's `features.N`, its output channels), a pooling between the five blocks.
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
LPIPS_EPS = 1e-10  # the official one: a pixel whose features are all zero has no direction


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """20 log10(MAX / √MSE) in dB with MAX = 1, the mean over pixels and channels; math.inf for identical images.

    Raises ValueError when the shapes differ.
    """
    _check(image, truth)
    error = float(np.mean((image.astype(np.float64) - truth.astype(np.float64)) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004, Eq. 13), in [−1, 1].

    (2 μx μy + C1)(2 σxy + C2) / ((μx² + μy² + C1)(σx² + σy² + C2)) under an 11-tap Gaussian of σ = 1.5 with biased
    variances, averaged over the pixels whose window lies inside the image, and over channels.
    Raises UserError for images smaller than the window, ValueError when the shapes differ.
    """
    _check(image, truth)
    height, width = image.shape[:2]
    if min(height, width) < SSIM_TAPS:
        raise UserError(f"SSIM needs images of at least {SSIM_TAPS} pixels a side, not {width} × {height}")
    x, y = (torch.from_numpy(v.astype(np.float64)).permute(2, 0, 1) for v in (image, truth))
    offsets = torch.arange(SSIM_TAPS, dtype=torch.float64) - SSIM_TAPS // 2
    window = torch.softmax(-(offsets**2) / (2 * SSIM_SIGMA**2), 0)  # a Gaussian whose taps sum to 1
    maps = torch.stack([x, y, x * x, y * y, x * y])
    flat = maps.reshape(-1, 1, height, width)
    flat = functional.conv2d(functional.conv2d(flat, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))
    mx, my, xx, yy, xy = flat.reshape(*maps.shape[:2], *flat.shape[2:])
    numerator = (2 * mx * my + SSIM_C1) * (2 * (xy - mx * my) + SSIM_C2)
    denominator = (mx * mx + my * my + SSIM_C1) * (xx - mx * mx + yy - my * my + SSIM_C2)
    return float((numerator / denominator).mean())


class Lpips:
    """Learned perceptual image patch similarity, version 0.1 with VGG16 (Zhang et al. 2018, Eq. 1).

    The weights come from the user as one .safetensors file with torchvision's vgg16 keys `features.N.weight` and
    `features.N.bias` (N = 0, 2, 5, … 28) and the learned heads `lin0.weight` … `lin4.weight`, (1, C, 1, 1) each.
    Raises UserError for a file that is not that; a pickle is never loaded, since loading one can run code.
    """

    def __init__(self, path: Path, device: torch.device | None = None) -> None:
        self._weights = {name: value.to(device) for name, value in _load(path).items()}
        self._shift = torch.tensor(LPIPS_SHIFT, device=device).view(1, 3, 1, 1)
        self._scale = torch.tensor(LPIPS_SCALE, device=device).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, image: np.ndarray, truth: np.ndarray) -> float:
        """Σ over blocks of the spatial mean of Σ_c lin_c (x̂_c − ŷ_c)², x̂ being features of unit length; 0 is equal.

        Raises UserError for images under 16 pixels, ValueError when the shapes differ.
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
    """Name → shape of every tensor that an LPIPS file holds."""
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
        with safe_open(path, framework="pt") as file:
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
