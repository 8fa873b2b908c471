"""Read photos of every kind as sRGB-encoded pixels: 16-bit, grey, palette, CMYK, with profile, rotated, linear."""

from __future__ import annotations

import io
import stat
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageFile

from nerf_core.common.errors import UserError
from nerf_core.datasets.claims import HEAVY_BYTES, decoding_bytes, least_bytes
from nerf_core.datasets.exr import exr_header, exr_pixels
from nerf_core.datasets.resample import Rows, composite

MAX_PIXELS = 200_000_000  # no camera has more: a file that claims more is a decompression bomb
EXR_BYTES = 60  # a pixel: ffmpeg's picture, and the planes in float
MAX_EXR_PIXELS = 50_000_000
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")
EIGHT_BITS = ("1", "L", "P", "RGB", "CMYK", "YCbCr")  # Pillow's names of opaque pixel types
DEEP_GREY = ("I;16", "I;16B", "I;16L")
BROKEN = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    AssertionError,
    IndexError,
    KeyError,
    TypeError,
    OverflowError,
    struct.error,
    zlib.error,
)  # what decoders raise on damage

HEAVY = threading.Lock()  # held while a large photo is decoded, so that four threads do not hold four of them

# Pillow warns above this size and refuses above its double; a warning here is a refusal as well.
Image.MAX_IMAGE_PIXELS = MAX_PIXELS
warnings.filterwarnings("error", category=Image.DecompressionBombWarning)
# What else Pillow finds odd in a photo (a damaged tag, say) it reads all the same; what it cannot read is counted.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")


class UnreadableError(Exception):
    """The file is damaged or not an image. The capture is loaded without it, with a note."""


@dataclass(frozen=True)
class Header:
    """A photo's header.

    width, height: the stored size in pixels.
    orientation: of EXIF; 1 is upright.
    alpha: whether it has transparency.
    memory: the bytes that decoding it takes.
    eight_bits: whether its colours have 8 bits, also after alpha and profile.
    """

    width: int
    height: int
    orientation: int
    alpha: bool
    memory: int
    eight_bits: bool


def measure(path: Path) -> Header:
    """Read the header of a photo without decoding its pixels.

    Raises UnreadableError if the file is not a photo, and UserError for devices and decompression bombs.
    """
    _refuse_special(path)
    if path.suffix.lower() == ".exr":
        with _damage_named(path):
            width, height, alpha = exr_header(path)
        _refuse_bomb(path, width * height, MAX_EXR_PIXELS)
        return Header(width, height, 1, alpha, EXR_BYTES * width * height, False)
    with _opened(path) as image, _damage_named(path):
        pixels = image.width * image.height
        _refuse_bomb(path, pixels)
        compression = image.info.get("compression")
        stored, least = path.stat().st_size, least_bytes(image.format or "", image.mode, pixels, compression)
        if stored < least:
            raise OSError(f"claims {image.width}×{image.height} pixels, which its {stored:,} bytes cannot hold")
        alpha = image.has_transparency_data
        eight_bits = not alpha and image.mode in EIGHT_BITS and ";16" not in _packing(image)
        return Header(*image.size, _orientation(image), alpha, decoding_bytes(image.mode, pixels), eight_bits)


def damage_notes(damaged: Sequence[str]) -> tuple[str, ...]:
    """Return a note about skipped photos, or none. damaged: the messages of UnreadableError."""
    if not damaged:
        return ()
    return (f"{len(damaged)} damaged photo{'s are' if len(damaged) > 1 else ' is'} skipped, first {damaged[0]}",)


def read_photo(
    path: Path, size: tuple[int, int], background: tuple[float, float, float], upright: bool = False
) -> np.ndarray:
    """Read a photo, average it to a size and composite it over a background.

    8-bit and 16-bit values stay exact if the size stays. Photos with a colour profile are converted to sRGB (in 8
    bits), and EXR from linear to sRGB.

    Args:
        path: the file.
        size: (width, height) in pixels.
        background: the sRGB colour behind transparent pixels.
        upright: rotate by the EXIF orientation; otherwise the pixels stay as stored.

    Returns:
        uint16 (height, width, 3), sRGB-encoded.

    Raises:
        UnreadableError: for damaged files.
    """
    if path.suffix.lower() == ".exr":
        with HEAVY:
            with _damage_named(path):
                linear = exr_pixels(path)
            return composite(linear, size, background)
    with _opened(path) as image:
        heavy = decoding_bytes(image.mode, image.width * image.height) > HEAVY_BYTES
        with HEAVY if heavy else nullcontext():
            with _damage_named(path):
                pixels = _rows(image, path, size, upright, heavy)
            return composite(pixels, size, background)


def _rows(image: ImageFile.ImageFile, path: Path, size: tuple[int, int], upright: bool, heavy: bool) -> Rows:
    """Decode a photo. A heavy one is decoded near the wanted size where its format can, and copied by rows."""
    orientation = _orientation(image) if upright else 1
    if heavy:
        _draft(image, (size[1], size[0]) if orientation >= 5 else size)
    if heavy and _plain(image) and orientation == 1:
        image.load()
        return Strips(image)
    return _turned(_decoded(image, path), orientation)


class Strips:
    """A decoded photo whose rows are copied only when they are asked for, as an array (n, W, C) of uint8."""

    def __init__(self, image: Image.Image) -> None:
        self.image, self.shape = image, (image.height, image.width, len(image.getbands()))

    def __getitem__(self, rows: slice) -> np.ndarray:
        return np.asarray(self.image.crop((0, rows.start, self.image.width, rows.stop)))


def _plain(image: ImageFile.ImageFile) -> bool:
    """Whether Pillow's pixels are those that `composite` takes: 8-bit sRGB, with or without alpha."""
    return (
        image.mode in ("RGB", "RGBA")
        and "transparency" not in image.info
        and ";16" not in _packing(image)
        and _foreign_profile(image) is None
    )


def _packing(image: ImageFile.ImageFile) -> str:
    """How a PNG stores a pixel, in Pillow's words ("RGB;16B"); empty for other formats."""
    return str(image.tile[0].args) if image.format == "PNG" and image.tile else ""


def _draft(image: ImageFile.ImageFile, wanted: tuple[int, int]) -> None:
    """Let a JPEG decode at 1/8, 1/4 or 1/2 where that divides its size, to no less than twice the wanted size."""
    for scale in (8, 4, 2):
        size = image.width // scale, image.height // scale
        whole = image.width % scale == 0 == image.height % scale
        if whole and size[0] >= 2 * wanted[0] and size[1] >= 2 * wanted[1]:
            image.draft(None, size)
            return


def _orientation(image: Image.Image) -> int:
    if image.format == "PNG" and not {"exif", "Raw profile type exif"} & image.info.keys():
        return 1  # Pillow would decode the whole photo to look for EXIF after the pixels, where no program writes it
    value = image.getexif().get(ExifTags.Base.Orientation, 1)
    return value if value in range(1, 9) else 1


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except BROKEN as error:
        raise UnreadableError(f"{path}: {error}") from error


def _refuse_special(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise UnreadableError(f"{path}: {error.strerror}") from error
    if not stat.S_ISREG(mode):
        raise UserError(f"{path} is a device, pipe or folder, not a photo: list regular image files only")


def _refuse_bomb(path: Path, pixels: int, most: int = MAX_PIXELS) -> None:
    if pixels > most:
        raise UserError(
            f"{path} claims {pixels / 1e6:,.0f} million pixels, {most // 10**6} are allowed: remove it or "
            "save it smaller"
        )


def _opened(path: Path) -> ImageFile.ImageFile:
    try:
        return Image.open(path)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise UserError(
            f"{path} claims more than {MAX_PIXELS // 10**6} million pixels: remove it or save it smaller"
        ) from error
    except BROKEN as error:
        raise UnreadableError(f"{path}: no image that can be read") from error


def _decoded(image: ImageFile.ImageFile, path: Path) -> np.ndarray:
    """The pixels (H, W, C), uint8 or uint16, in the form that `composite` takes."""
    profile = _foreign_profile(image)
    deep = _deep(image, path)
    if deep is not None and profile is None:
        return deep
    if image.mode in ("F", "I"):
        raise ValueError(f"pixel type {image.mode!r} has no defined white; save it as PNG or EXR")
    if _plain(image):
        return np.asarray(image)
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    plain = image
    if image.mode in DEEP_GREY:  # grey with a profile: the colour engine only takes 8 bits
        plain = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    color = plain.convert("RGB") if profile is None else _to_srgb(plain, profile)
    if alpha is not None:
        color.putalpha(alpha)
    return np.asarray(color)


def _deep(image: ImageFile.ImageFile, path: Path) -> np.ndarray | None:
    """The pixels (H, W, C) as uint16 of a photo with 16 bits per channel; None for all others.

    Pillow decodes 16-bit colour PNGs to 8 bits. Its unpackers for the two byte orders take the first and the second
    byte of each value, so that decoding with both gives all 16 bits.
    """
    if image.mode in DEEP_GREY:
        return np.asarray(image).astype(np.uint16)[..., None]
    packing = _packing(image)
    if packing in ("RGB;16B", "RGBA;16B"):
        high = np.asarray(image)
        return high.astype(np.uint16) << 8 | _repacked(path, packing[:-1] + "L")
    if packing == "LA;16B":  # four bytes per pixel, read as if they were RGBA
        return _repacked(path, "RGBA").view(">u2").astype(np.uint16)
    return None


def _repacked(path: Path, packing: str) -> np.ndarray:
    with _opened(path) as image:
        image.tile = [image.tile[0]._replace(args=packing)]
        return np.asarray(image)


def _foreign_profile(image: Image.Image) -> ImageCms.ImageCmsProfile | None:
    """The embedded colour profile. None for sRGB itself, because a conversion would only lose precision."""
    data = image.info.get("icc_profile")
    if not data:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        return None if "sRGB" in ImageCms.getProfileDescription(profile) else profile
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(f"its colour profile is broken ({error}); save it without one") from error


def _to_srgb(image: Image.Image, profile: ImageCms.ImageCmsProfile) -> Image.Image:
    """Convert from the embedded profile to sRGB (relative colorimetric), 8-bit RGB."""
    space = profile.profile.xcolor_space.strip()  # pyright: ignore[reportAttributeAccessIssue] stubs lack it
    mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}.get(space)
    if mode is None or (mode == "CMYK") != (image.mode == "CMYK"):
        raise ValueError(f"its colour profile is for {space}, its pixels are {image.mode}; save it without one")
    try:
        converted = ImageCms.profileToProfile(
            image.convert(mode),
            profile,
            ImageCms.createProfile("sRGB"),
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            outputMode="RGB",
        )
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(f"its colour profile is broken ({error}); save it without one") from error
    assert converted is not None  # None is returned only for conversions in place
    return converted


def _turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate or mirror stored pixels as EXIF orientation 2 … 8 asks."""
    if orientation >= 5:
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels
