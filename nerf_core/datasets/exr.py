"""OpenEXR photos, decoded by the ffmpeg that videos are written with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.datasets.resample import srgb_encoded
from nerf_core.errors import UserError


def exr_header(path: Path) -> tuple[int, int, bool]:
    """Width, height and whether there is alpha. Raises OSError for damaged files."""
    with _frames(path) as (header, _):
        width, height = header["size"]
        return width, height, header["pix_fmt"].startswith(("gbrap", "rgba", "ya"))


def exr_pixels(path: Path) -> np.ndarray:
    """(H, W, 4) float32, sRGB-encoded, straight alpha. Raises OSError for damaged files.

    EXR stores linear light premultiplied by alpha; the curve belongs to the straight colour. Colour without
    alpha (pure glow) has no straight counterpart and is dropped.
    """
    with _frames(path) as (header, frames):
        width, height = header["size"]
        data = next(frames)
    green, blue, red, alpha = np.frombuffer(data, np.float32).reshape(4, height, width)
    if not all(np.isfinite(plane).all() for plane in (red, green, blue, alpha)):
        raise OSError("holds pixels that are not finite")
    alpha = np.clip(alpha, 0, 1)
    inverse = np.divide(1, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return np.dstack([srgb_encoded(plane * inverse) for plane in (red, green, blue)] + [alpha])


@contextmanager
def _frames(path: Path) -> Iterator[tuple[dict[str, Any], Iterator[bytes]]]:
    import imageio_ffmpeg

    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"{path}: EXR photos need ffmpeg, which is missing: install it or save them as PNG") from error
    frames = imageio_ffmpeg.read_frames(str(path.absolute()), pix_fmt="gbrapf32le", bits_per_pixel=128)
    try:
        header: dict[str, Any] = next(frames)  # pyright: ignore[reportAssignmentType] the first item, by its contract
        yield header, frames  # pyright: ignore[reportReturnType]
    except (RuntimeError, StopIteration, KeyError) as error:
        raise OSError("no EXR image that can be read") from error
    finally:
        frames.close()
