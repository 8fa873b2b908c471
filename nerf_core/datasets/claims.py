"""Compare what a photo's header claims with the bytes that its file has, before anything is allocated."""

from __future__ import annotations

DEFLATE = 1032  # the most bytes that one byte of deflate can stand for (zlib.net/zlib_tech.html)
HUFFMAN_PIXELS = 512  # the most pixels per byte of a JPEG: one bit for a block of 64 pixels
HEAVY_BYTES = 400_000_000  # photos that take more while they are decoded are decoded one at a time
PILLOW_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2, "I;16L": 2, "LA": 4}  # all other modes take 4
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


def decoding_bytes(mode: str, pixels: int) -> int:
    """Return the bytes that a photo takes while it is decoded: Pillow's picture, its bytes, and the array of them."""
    size = PILLOW_BYTES.get(mode, 4)
    return 3 * size * pixels
