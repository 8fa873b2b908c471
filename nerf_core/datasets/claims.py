"""Compare what a photo's header claims with the bytes that its file has, before anything is allocated."""

from __future__ import annotations

DEFLATE = 1032  # the most bytes that one byte of deflate can stand for (zlib.net/zlib_tech.html)
HUFFMAN_PIXELS = 512  # the most pixels per byte of a JPEG: one bit for a block of 64 pixels
HEAVY_BYTES = 400_000_000  # photos that take more while they are decoded are decoded one at a time
PILLOW_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2, "I;16L": 2, "LA": 4}  # all other modes take 4
PACKED_BITS = {"I;16": 16, "LA": 16, "RGB": 24, "RGBA": 32}  # grey and palettes may take one bit a pixel


def least_bytes(kind: str, mode: str, pixels: int) -> int:
    """Return the fewest bytes that a sound file can have, or 0 where the format has no such bound.

    Args:
        kind: Pillow's name of the format.
        mode: Pillow's name of the pixel type. Grey and palettes may be stored with one bit a pixel.
        pixels: width times height.
    """
    if kind == "PNG":
        return pixels * PACKED_BITS.get(mode, 1) // 8 // DEFLATE
    return pixels // HUFFMAN_PIXELS if kind == "JPEG" else 0


def decoding_bytes(mode: str, pixels: int) -> int:
    """Return the bytes that a photo takes while it is decoded: Pillow's picture, its bytes, and the array of them."""
    size = PILLOW_BYTES.get(mode, 4)
    return 3 * size * pixels
