"""What of a window has changed between two frames: only that has to be drawn again.

Software GL takes its time by pixels. In most frames one panel has changed, or the picture alone.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from imgui_bundle import imgui

VERTEX = np.dtype([("place", "<f4", 2), ("uv", "<f4", 2), ("color", "<u4")])
assert VERTEX.itemsize == imgui.VERTEX_SIZE


class Box(NamedTuple):
    """A rectangle in pixels, y down; right and bottom are outside. An empty one is false."""

    left: int
    top: int
    right: int
    bottom: int

    def __bool__(self) -> bool:
        return self.left < self.right and self.top < self.bottom

    def common(self, other: Box) -> Box:
        """Return what lies in both."""
        return Box(
            max(self.left, other.left), max(self.top, other.top),
            min(self.right, other.right), min(self.bottom, other.bottom),
        )  # fmt: skip

    def around(self, other: Box) -> Box:
        """Return the smallest rectangle that has both in it."""
        return Box(
            min(self.left, other.left), min(self.top, other.top),
            max(self.right, other.right), max(self.bottom, other.bottom),
        )  # fmt: skip

    def for_gl(self, height: int) -> tuple[int, int, int, int]:
        """Return x, y, width and height in a framebuffer of this height, whose y goes up."""
        return self.left, height - self.bottom, self.right - self.left, self.bottom - self.top


EMPTY = Box(0, 0, 0, 0)


class Part(NamedTuple):
    """A draw command.

    box: what it may draw to; not empty.
    texture: the texture's name, then what stands for its content, and whether it is opaque.
    first, length: of its indices.
    """

    box: Box
    texture: tuple[int, Hashable, bool]
    first: int
    length: int


class Drawn(NamedTuple):
    """The draw commands of one imgui window, in order.

    vertices: as imgui has them, VERTEX.
    indices: as imgui has them.
    parts: the commands.
    origin: the place of the framebuffer's first pixel.
    """

    vertices: bytes
    indices: bytes
    parts: tuple[Part, ...]
    origin: tuple[float, float] = (0.0, 0.0)

    def covered(self) -> Box:
        """Return a rectangle outside of which nothing is drawn; an empty one if nothing is drawn at all."""
        if not self.parts:
            return EMPTY
        clipped = self.parts[0].box
        for part in self.parts[1:]:
            clipped = clipped.around(part.box)
        places = np.frombuffer(self.vertices, VERTEX)["place"] - np.array(self.origin, np.float32)
        if not np.isfinite(places).all():  # a plot without a range makes such vertices; the GPU draws what it likes
            return clipped
        (left, top), (right, bottom) = np.floor(places.min(0)), np.ceil(places.max(0))
        return clipped.common(Box(int(left), int(top), int(right), int(bottom)))


NOTHING = Drawn(b"", b"", ())


def damage(before: Sequence[Drawn], now: Sequence[Drawn]) -> list[Box]:
    """Return the rectangles outside of which two frames are alike. No two of them overlap.

    A window that has changed is drawn again as a whole, where it was and where it is.
    """
    found: list[Box] = []
    for old, new in zip_longest(before, now, fillvalue=NOTHING):
        if old != new:
            for box in filter(None, (old.covered(), new.covered())):
                _add(found, box)
    return found


def _add(found: list[Box], box: Box) -> None:
    """Add a rectangle, joined with those that it overlaps: what lies in two of them would be blended twice."""
    while overlapped := [one for one in found if one.common(box)]:
        for one in overlapped:
            found.remove(one)
            box = box.around(one)
    found.append(box)
