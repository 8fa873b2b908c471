"""Compare what a photo's header claims with the bytes that its file has, before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import ImageFile, JpegImagePlugin, TiffImagePlugin

from nerf_core.datasets.resample import composite_bytes

DEFLATE = 1032  # the most bytes that one byte of deflate can stand for (zlib.net/zlib_tech.html)
HUFFMAN_PIXELS = 512  # the most pixels per byte of a JPEG: one bit for a block of 64 pixels
HEAVY_BYTES = 400_000_000  # photos that take more while they are read are read one at a time
PILLOW_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2, "I;16L": 2, "LA": 4}  # all other modes take 4
BUFFER_BYTES = 5_000_000  # of the file, of codes, of rows in work, whatever the photo's size
HEIF_BYTES = 6  # a pixel: the decoder's planes, their conversion to RGB, and the bytes that it hands to Pillow
WEBP_BYTES = 12  # a pixel: the decoder's canvases, and the bytes that it hands to Pillow
PACKED_BITS = {"I;16": 16, "LA": 16, "RGB": 24, "RGBA": 32}  # grey and palettes may take one bit a pixel


# The most bytes that a stored byte can stand for, by Pillow's names of the compressions of TIFF and BMP. A code of LZW
# has 9 bits or more and stands for 4,096 bytes at most. Fax compressions have no bound.
MOST_PER_BYTE: dict[object, int] = {
    "raw": 1,
    "packbits": 64,
    "tiff_lzw": 3641,
    "tiff_adobe_deflate": DEFLATE,
    "tiff_deflate": DEFLATE,
    0: 1,
}


def least_bytes(kind: str, mode: str, pixels: int, compression: object = None) -> int:
    """Return the fewest bytes that a sound file can have, or 0 where the format has no such bound.

    Args:
        kind: Pillow's name of the format.
        mode: Pillow's name of the pixel type. Grey and palettes may be stored with one bit a pixel.
        pixels: width times height.
        compression: Pillow's name of the compression, for formats that have several.
    """
    stored = pixels * PACKED_BITS.get(mode, 1) // 8
    if kind == "PNG":
        return stored // DEFLATE
    if kind in ("TIFF", "BMP") and compression in MOST_PER_BYTE:
        return stored // (2 if kind == "BMP" else 1) // MOST_PER_BYTE[compression]  # a BMP packs colour into 16 bits
    return pixels // HUFFMAN_PIXELS if kind == "JPEG" else 0


@dataclass(frozen=True)
class Memory:
    """The bytes that reading a photo takes, at most.

    held: the decoded photo, and what its decoder keeps as long as the photo is open.
    decoder: what its decoder holds besides, until all is decoded.
    """

    held: int
    decoder: int = 0

    def peak(self, shape: tuple[int, ...], size: tuple[int, int]) -> int:
        """Return the bytes that it takes to decode the photo and to average it.

        Args:
            shape: (rows, columns) of the photo.
            size: (width, height) that is wanted.
        """
        return BUFFER_BYTES + self.held + max(self.decoder, composite_bytes(shape, size))


def decoding_memory(image: ImageFile.ImageFile, stored: int, pictures: int) -> Memory:
    """Return the memory that a photo takes.

    Args:
        image: an opened photo, whose pixels need not be decoded.
        stored: the file's size in bytes.
        pictures: how many pictures of it are held at once.
    """
    pixels = image.width * image.height
    held, decoder = PILLOW_BYTES.get(image.mode, 4) * pictures * pixels, 0
    if image.format == "HEIF":
        held += HEIF_BYTES * pixels + stored
    elif image.format == "WEBP":
        held += WEBP_BYTES * pixels + stored
    elif isinstance(image, JpegImagePlugin.JpegImageFile) and "progressive" in image.info:
        areas = [across * down for _, across, down, _ in image.layer]  # chroma has fewer pixels
        decoder = 2 * pixels * sum(areas) // max(areas)  # all coefficients, of 16 bits, until the last scan is read
    elif isinstance(image, TiffImagePlugin.TiffImageFile) and image.info.get("compression") != "raw":
        tags = image.tag_v2
        rows = int(tags.get(TiffImagePlugin.ROWSPERSTRIP, image.height))
        part = int(tags.get(TiffImagePlugin.TILEWIDTH, image.width)) * int(tags.get(TiffImagePlugin.TILELENGTH, rows))
        raw = sum(tags.get(TiffImagePlugin.BITSPERSAMPLE, (1,))) * pixels // 8
        decoder = int(min(part / pixels, 1) * (raw + stored))  # one strip or tile, packed and unpacked
    return Memory(held, decoder)
