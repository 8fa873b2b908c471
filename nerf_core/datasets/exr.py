"""Read OpenEXR photos with the ffmpeg that also writes videos."""

from __future__ import annotations

import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.subprograms import run_limited
from nerf_core.datasets.claims import DEFLATE
from nerf_core.datasets.resample import srgb_encoded

MAGIC = b"\x76\x2f\x31\x01"
HEADER_BYTES = 1_000_000  # headers, even with previews, are much shorter; the rest is pixels
SECONDS = 120  # for one photo, because ffmpeg may hang on a damaged one


def exr_header(path: Path) -> tuple[int, int, bool]:
    """Return width and height of the display window, and whether there is alpha. Raises OSError for damaged files.

    A file begins with magic number and version. Attributes follow (name, 0, type, 0, size, data) up to an empty name
    (openexr.com, "OpenEXR File Layout").
    """
    with path.open("rb") as file:
        data = file.read(HEADER_BYTES)
    if not data.startswith(MAGIC):
        raise OSError("no EXR image")
    attributes: dict[bytes, bytes] = {}
    rest = data[8:]
    while rest and rest[0]:
        name, kind_and_more = _split(rest)
        _, rest = _split(kind_and_more)
        (size,) = struct.unpack_from("<i", rest)
        if not 0 <= size <= len(rest) - 4:
            raise OSError("EXR header breaks off")
        attributes[name], rest = rest[4 : 4 + size], rest[4 + size :]
    if not {b"displayWindow", b"channels"} <= attributes.keys():
        raise OSError("EXR header has no size or no channels")
    left, top, right, bottom = struct.unpack("<4i", attributes[b"displayWindow"])
    if right < left or bottom < top:
        raise OSError("EXR image without pixels")
    channels = attributes[b"channels"]
    # A damaged header may claim any size. Not even the best compression brings the channels into fewer bytes.
    least = (right - left + 1) * (bottom - top + 1) * _pixel_bytes(channels)
    ratio = 1 if attributes.get(b"compression") == b"\0" else DEFLATE
    stored = path.stat().st_size
    if least > ratio * stored:
        raise OSError(f"claims {right - left + 1}×{bottom - top + 1} pixels, which its {stored:,} bytes cannot hold")
    return right - left + 1, bottom - top + 1, channels.startswith(b"A\0")  # channels are sorted by name


def exr_pixels(path: Path) -> np.ndarray:
    """Read a photo as (H, W, 4) float32, sRGB-encoded with straight alpha.

    EXR stores linear colour premultiplied by alpha, and the sRGB curve applies to straight colour. Colour where alpha
    is 0 (pure glow) has no straight form and is dropped.
    Raises OSError for damaged files and UserError without ffmpeg.
    """
    width, height, _ = exr_header(path)
    data = _decoded(path)
    if len(data) != 16 * width * height:
        raise OSError("no EXR image that can be read")
    green, blue, red, alpha = np.frombuffer(data, np.float32).reshape(4, height, width)
    if not all(np.isfinite(plane).all() for plane in (red, green, blue, alpha)):
        raise OSError("holds pixels that are not finite")
    alpha = np.clip(alpha, 0, 1)
    inverse = np.divide(1, alpha, out=np.zeros_like(alpha), where=alpha > 1e-6)  # with less alpha nothing is visible
    return np.dstack([srgb_encoded(plane * inverse) for plane in (red, green, blue)] + [alpha])


def exr_plane(path: Path) -> np.ndarray:
    """Read the one channel of an EXR image that has no other, (H, W) float32, as it is stored.

    Its channel may be called R, as in Record3D's depth maps. ffmpeg decodes one channel only if it is called Y, and
    knows no other way to ask for it, so it gets the file with this letter changed.
    Raises OSError for damaged files and other channels, and UserError without ffmpeg.
    """
    width, height, _ = exr_header(path)
    data = path.read_bytes()
    begin = data.index(b"channels\0chlist\0") + 16  # then 4 bytes of size, and entries of a letter, 0 and 16 bytes
    if data[begin + 5 : begin + 6] != b"\0" or data[begin + 4 + 18 : begin + 4 + 19] != b"\0":
        raise OSError("has several channels, or one with a longer name: a depth map has one")
    renamed = data[: begin + 4] + b"Y" + data[begin + 5 :]
    with tempfile.NamedTemporaryFile(suffix=".exr") as copy:
        copy.write(renamed)
        copy.flush()
        plane = _decoded(Path(copy.name), "grayf32le")
    if len(plane) != 4 * width * height:
        raise OSError("no EXR image that can be read")
    return np.frombuffer(plane, np.float32).reshape(height, width)


def _pixel_bytes(channels: bytes) -> float:
    """The bytes per pixel of a channel list: name, 0, type (1 is half), linear, sampling in x and y; it ends with 0."""
    total = 0.0
    while channels and channels[0]:
        _, rest = _split(channels)
        kind, _, across, down = struct.unpack_from("<4i", rest)
        total += (2 if kind == 1 else 4) / max(1, across * down)
        channels = rest[16:]
    return total


def _split(data: bytes) -> tuple[bytes, bytes]:
    text, zero, rest = data.partition(b"\0")
    if not zero:
        raise OSError("EXR header breaks off")
    return text, rest


def _decoded(path: Path, layout: str = "gbrapf32le") -> bytes:
    """The planes green, blue, red and alpha as float32 bytes, linear and premultiplied.

    layout: another of ffmpeg's pixel formats.
    """
    import imageio_ffmpeg

    try:
        ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"{path}: EXR photos need ffmpeg, which is missing: install it or save them as PNG") from error
    command = [ffmpeg, "-v", "error", "-f", "exr_pipe", "-i", f"file:{path.absolute()}", "-frames:v", "1"]
    try:
        return run_limited([*command, "-f", "rawvideo", "-pix_fmt", layout, "-"], SECONDS).output
    except subprocess.TimeoutExpired as error:
        raise OSError(f"decoding took longer than {SECONDS} s") from error
