"""The figure of what the encodings learned."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from nerf_core.lab import image_figure
from nerf_core.lab.image_figure import Learned, detail, draw_figure


def learned(name: str, picture: np.ndarray, psnr: float) -> Learned:
    steps = np.array([1, 10, 100])
    return Learned(name, "in words", picture, steps, psnr + np.log(steps), psnr + np.log(steps) / 2)


@pytest.fixture
def photo() -> np.ndarray:
    return np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)


def test_the_detail_is_where_the_last_encoding_gains_most(photo: np.ndarray) -> None:
    plain = np.full_like(photo, 0.5)
    better = plain.copy()
    better[12:16, 24:28] = photo[12:16, 24:28]
    results = [learned("none", plain, 10), learned("gaussian", better, 20)]
    assert detail(photo, results) == (12, 24, 4)


def test_names_that_would_overlap_are_moved_apart() -> None:
    assert image_figure._spread(np.array([3.0, 1.0, 3.1]), 0.5).tolist() == [3.0, 1.0, 3.5]


def test_the_figure_shows_every_picture(photo: np.ndarray) -> None:
    """Each column has its picture's colours where its picture lies."""
    colors = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.8, 0.7, 0.1))
    names = ("none", "basic", "positional", "gaussian")
    noise = (photo - 0.5) * 0.02
    results = [
        learned(name, np.array(color, np.float32) + noise, 10.0 + k)
        for k, (name, color) in enumerate(zip(names, colors, strict=True))
    ]
    page = image_figure._Page(photo, results)
    image = np.asarray(Image.open(io.BytesIO(draw_figure(photo, results))).convert("RGB")) / 255
    assert image.shape[1] == round(image_figure.WIDTH * image_figure.DOTS)
    assert image.shape[0] == pytest.approx(page.height * image_figure.DOTS, abs=1)
    for row in (image_figure.TOP + 0.1 * page.tall, image_figure.TOP + page.tall + image_figure.GAP + 0.5 * page.side):
        for k, color in enumerate(colors, 1):
            left = image_figure.LEFT + k * (page.side + image_figure.GAP) + 0.05 * page.side
            x, y = (round(v * image_figure.DOTS) for v in (left, row))
            assert np.abs(image[y, x] - color).max() < 0.03
