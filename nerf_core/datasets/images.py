"""Read photos of every kind as sRGB-encoded pixels: 16-bit, grey, palette, CMYK, with profile, rotated, linear."""

from __future__ import annotations

import importlib
import stat
import struct
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageFile

from nerf_core.common.errors import UserError
from nerf_core.common.language import phrases
from nerf_core.datasets.claims import HEAVY_BYTES, Memory, decoding_memory, least_bytes
from nerf_core.datasets.exr import exr_header, exr_pixels
from nerf_core.datasets.profiles import foreign_profile, to_srgb
from nerf_core.datasets.resample import composite

MAX_PIXELS = 200_000_000  # no camera has more: a file that claims more is a decompression bomb
EXR_BYTES = 60  # a pixel: ffmpeg's picture, and the planes in float
MAX_EXR_PIXELS = 50_000_000
HEIC = (".heic", ".heif")
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", *HEIC)
EIGHT_BITS = ("1", "L", "P", "RGB", "CMYK", "YCbCr")  # Pillow's names of opaque pixel types
DEEP_GREY = ("I;16", "I;16B", "I;16L")
DEEP_COLOR = ("RGB;16B", "RGBA;16B")
Convert = Callable[..., np.ndarray]
OPAQUE = 1 - 1.5 / 255  # alpha from here on is that of an opaque pixel, rounded
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
    MemoryError,  # Pillow reads as many bytes as a PNG's part claims to have
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
    memory: what reading it takes.
    eight_bits: whether its colours have 8 bits, also after alpha and profile.
    """

    width: int
    height: int
    orientation: int
    alpha: bool
    memory: Memory
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
        return Header(width, height, 1, alpha, Memory(EXR_BYTES * width * height), False)
    with _opened(path) as image, _damage_named(path):
        pixels = image.width * image.height
        _refuse_bomb(path, pixels)
        compression = image.info.get("compression")
        stored, least = path.stat().st_size, least_bytes(image.format or "", image.mode, pixels, compression)
        if stored < least:
            raise OSError(f"claims {image.width}×{image.height} pixels, which its {stored:,} bytes cannot hold")
        alpha = image.has_transparency_data
        eight_bits = not alpha and image.mode in EIGHT_BITS and ";16" not in _packing(image)
        return Header(*image.size, _orientation(image), alpha, _memory(image, path), eight_bits)


def damage_notes(damaged: Sequence[str]) -> tuple[str, ...]:
    """Return a note about skipped photos, or none. damaged: the messages of UnreadableError."""
    if not damaged:
        return ()
    return (
        phrases(
            "{n} damaged photo is skipped, first {first}",
            "{n} damaged photos are skipped, first {first}",
            len(damaged),
            first=damaged[0],
        ),
    )


def read_photo(
    path: Path,
    size: tuple[int, int],
    background: tuple[float, float, float],
    upright: bool = False,
    *,
    fast: bool = False,
) -> np.ndarray:
    """Read a photo, average it to a size and composite it over a background.

    8-bit and 16-bit values stay exact if the size stays. Photos with a colour profile are converted to sRGB (in 8
    bits), and EXR from linear to sRGB.

    Args:
        path: the file.
        size: (width, height) in pixels.
        background: the sRGB colour behind transparent pixels.
        upright: rotate by the EXIF orientation; otherwise the pixels stay as stored.
        fast: whether a JPEG may be decoded at 1/8, 1/4 or 1/2, to no less than twice the wanted size.

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
        with _damage_named(path):
            turned = upright and _orientation(image) >= 5
            shape = image.size if turned else image.size[::-1]
            heavy = _memory(image, path).peak(shape, size) > HEAVY_BYTES
        with HEAVY if heavy else nullcontext():
            with _damage_named(path):
                pixels = _decoded(image, path, size, upright, heavy or fast)
            return composite(pixels, size, background)


def opaque_pixels(path: Path, upright: bool) -> np.ndarray:
    """Return which pixels of a photo are opaque, (H, W) bool, turned as `read_photo` turns it.

    Raises:
        UnreadableError: for damaged files.
    """
    if path.suffix.lower() == ".exr":
        with HEAVY, _damage_named(path):
            linear = exr_pixels(path)
        return linear[..., 3] >= OPAQUE if linear.shape[2] == 4 else np.ones(linear.shape[:2], bool)
    with HEAVY, _opened(path) as image, _damage_named(path):
        orientation = _orientation(image) if upright else 1
        if not image.has_transparency_data:
            shape = image.size if orientation >= 5 else image.size[::-1]
            return np.ones(shape, bool)
        alpha = np.asarray((image if "A" in image.getbands() else image.convert("RGBA")).getchannel("A"))
    return oriented(alpha >= 255 * OPAQUE, orientation)


class Strips:
    """A decoded photo, of which only the rows that are asked for are converted and turned upright.

    The whole photo as an array would take two to five times the memory that Pillow's picture of it takes.

    Args:
        images: Pillow's pictures of the photo, all of one size.
        convert: takes the same part of each picture, and returns its pixels (h, w, C), uint8 or uint16, as `composite`
            takes them.
        orientation: of EXIF.
    """

    def __init__(self, images: Sequence[Image.Image], convert: Convert, orientation: int) -> None:
        for image in images:
            image.load()
        self._images, self._convert, self._orientation = images, convert, orientation
        sizes = images[0].size if orientation >= 5 else images[0].size[::-1]
        self.shape = (*sizes, self._part((0, 0, 1, 1)).shape[2])

    def __getitem__(self, rows: slice) -> np.ndarray:
        first, end = rows.start, rows.stop
        if self._orientation in (3, 4, 7, 8):
            first, end = self.shape[0] - end, self.shape[0] - first
        width, height = self._images[0].size
        box = (first, 0, end, height) if self._orientation >= 5 else (0, first, width, end)
        return oriented(self._part(box), self._orientation)

    def _part(self, box: tuple[int, int, int, int]) -> np.ndarray:
        return self._convert(*(image.crop(box) for image in self._images))


def _decoded(image: ImageFile.ImageFile, path: Path, size: tuple[int, int], upright: bool, near: bool) -> Strips:
    """Decode a photo; `near` the wanted size, where its format can and that is asked for."""
    orientation = _orientation(image) if upright else 1
    if near:
        _draft(image, (size[1], size[0]) if orientation >= 5 else size)
    packing, profile = _packing(image), foreign_profile(image)
    if packing in DEEP_COLOR and profile is None:
        return Strips([image, _repacked(path, packing[:-1] + "L")], _both_bytes, orientation)
    if packing == "LA;16B" and profile is None:  # four bytes per pixel, read as if they were RGBA
        return Strips([_repacked(path, "RGBA")], lambda part: np.asarray(part).view(">u2"), orientation)
    if image.mode in DEEP_GREY and profile is None:
        return Strips([image], lambda part: np.asarray(part).astype(np.uint16)[..., None], orientation)
    if image.mode in ("F", "I"):
        raise ValueError(f"pixel type {image.mode!r} has no defined white; save it as PNG or EXR")
    converted = None if profile is None else to_srgb(image.mode, profile)
    return Strips([image], lambda part: _eight_bits(part, converted), orientation)


def _memory(image: ImageFile.ImageFile, path: Path) -> Memory:
    twice = _packing(image) in DEEP_COLOR and foreign_profile(image) is None
    return decoding_memory(image, path.stat().st_size, pictures=2 if twice else 1)


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
        raise UnreadableError(f"{path}: {' '.join(str(error).split()) or 'it is damaged'}") from error


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


def _learn_heic(path: Path) -> None:
    """Let Pillow read HEIC. Raises UserError if the package for that is not installed."""
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError as error:
        raise UserError(
            f"{path} is an HEIC photo: to read it, run `pip install 'nerf-viewer[heic]'`, or save the photos as JPEG"
        ) from error


def _opened(path: Path) -> ImageFile.ImageFile:
    if path.suffix.lower() in HEIC:
        _learn_heic(path)
    try:
        return Image.open(path)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise UserError(
            f"{path} claims more than {MAX_PIXELS // 10**6} million pixels: remove it or save it smaller"
        ) from error
    except BROKEN as error:
        raise UnreadableError(f"{path}: no image that can be read") from error


def _eight_bits(part: Image.Image, profile: ImageCms.ImageCmsTransform | None) -> np.ndarray:
    """The pixels (h, w, 3 or 4) as uint8, converted from their colour profile if there is one."""
    transparent = part.has_transparency_data
    if profile is None:
        return np.asarray(part.convert("RGBA" if transparent else "RGB"))
    alpha = part.convert("RGBA").getchannel("A") if transparent else None
    if part.mode in DEEP_GREY:  # the colour engine only takes 8 bits
        part = Image.fromarray((np.asarray(part) >> 8).astype(np.uint8))
    color = ImageCms.applyTransform(part.convert(profile.input_mode), profile)
    assert color is not None  # None is returned only for conversions in place
    if alpha is not None:
        color.putalpha(alpha)
    return np.asarray(color)


def _both_bytes(high: Image.Image, low: Image.Image) -> np.ndarray:
    """The pixels (h, w, C) as uint16 of a photo with 16 bits per channel.

    Pillow decodes 16-bit colour PNGs to 8 bits. Its unpackers for the two byte orders take the first and the second
    byte of each value, so that decoding with both gives all 16 bits.
    """
    return np.asarray(high).astype(np.uint16) << 8 | np.asarray(low)


def _repacked(path: Path, packing: str) -> Image.Image:
    with _opened(path) as image:
        image.tile = [image.tile[0]._replace(args=packing)]
        image.load()
        return image


def oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate or mirror stored pixels (H, W, …) as EXIF orientation 2 … 8 asks."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels
