"""Draw icon.png: a ray through the dark, and the lobe of weights where it meets a surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

SIZE, SUPERSAMPLE = 128, 8


def over(canvas: np.ndarray, colour: tuple[float, float, float], coverage: np.ndarray) -> np.ndarray:
    """Paint `colour` over canvas (H, W, 3) where coverage (H, W) says."""
    return canvas + (np.array(colour) - canvas) * coverage[..., None]


def edge(signed: np.ndarray, width: float = 0.004) -> np.ndarray:
    """1 where a signed distance is negative, 0 outside, with a soft edge."""
    return np.clip(0.5 - signed / width, 0, 1)


def draw() -> np.ndarray:
    """The icon (SIZE, SIZE, 4) in [0, 1], straight alpha."""
    axis = (np.arange(SIZE * SUPERSAMPLE) + 0.5) / (SIZE * SUPERSAMPLE)
    x, y = np.meshgrid(axis, 1 - axis)
    corner = np.hypot(*(np.maximum(np.abs(v - 0.5) - 0.26, 0) for v in (x, y))) - 0.21
    canvas = np.array([0.070, 0.080, 0.105]) + 0.075 * np.stack([y, y, 1.15 * y], -1)

    angle = np.radians(14)
    t = (x - 0.48) * np.cos(angle) + (y - 0.31) * np.sin(angle)  # along the ray
    h = -(x - 0.48) * np.sin(angle) + (y - 0.31) * np.cos(angle)  # across it
    peak, spread = 0.04, 0.105
    lobe = 0.50 * np.exp(-0.5 * ((t - peak) / spread) ** 2)
    cold, warm = np.array([0.10, 0.30, 0.80]), np.array([1.00, 0.70, 0.26])
    mix = np.clip((t - peak) / 0.40 + 0.5, 0, 1)[..., None]
    fill = (cold + (warm - cold) * mix) * (0.70 + 0.30 * np.clip(h / 0.42, 0, 1))[..., None]
    near = np.abs(t - peak) < 2.6 * spread  # beyond, the lobe is thinner than its outline
    canvas = canvas + (fill - canvas) * (edge(np.maximum(h - lobe, -h)) * near)[..., None]
    steep = np.sqrt(1 + (lobe * (t - peak) / spread**2) ** 2)  # so that the outline is as wide on the flanks
    canvas = over(canvas, (0.97, 0.95, 0.90), edge(np.abs(h - lobe) / steep - 0.014) * near)
    canvas = over(canvas, (0.62, 0.67, 0.76), edge(np.maximum(np.abs(h) - 0.011, np.abs(t) - 0.40)))
    for sample in (-0.33, -0.20, -0.09, -0.01, 0.06, 0.14, 0.25, 0.36):
        canvas = over(canvas, (1.00, 0.82, 0.45), edge(np.hypot(t - sample, h) - 0.027))

    rgba = np.concatenate([canvas, np.ones_like(canvas[..., :1])], -1) * edge(corner)[..., None]
    mean = rgba.reshape(SIZE, SUPERSAMPLE, SIZE, SUPERSAMPLE, 4).mean((1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-9)  # outside the square colour is zero already
    return mean


if __name__ == "__main__":
    icon = (draw() * 255).round().astype(np.uint8)
    Image.fromarray(icon).save(Path(__file__).resolve().parent / "icon.png", optimize=True)
