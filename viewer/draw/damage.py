"""What of a window has changed between two frames: only that has to be drawn again.

Software GL takes its time by pixels. In most frames a part of one panel has changed, or the picture alone.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from math import ceil, floor, isfinite
from typing import NamedTuple

import numpy as np
from imgui_bundle import imgui

VERTEX = np.dtype([("place", "<f4", 2), ("uv", "<f4", 2), ("color", "<u4")])
assert VERTEX.itemsize == imgui.VERTEX_SIZE
INDEX = np.dtype(f"<u{imgui.INDEX_SIZE}")
DEAR = 8192  # pixels: see `_add`. With 0 or 32,768, frames under the microscope took longer in software GL


class Box(NamedTuple):
    """A rectangle in pixels, y down; right and bottom are outside. An empty one is false."""

    left: int
    top: int
    right: int
    bottom: int

    def __bool__(self) -> bool:
        return self.left < self.right and self.top < self.bottom

    @property
    def area(self) -> int:
        """Its pixels, if it is not empty."""
        return (self.right - self.left) * (self.bottom - self.top)

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
    first, length: of its indices; the length is a multiple of 3, and not 0.
    """

    box: Box
    texture: tuple[int, Hashable, bool]
    first: int
    length: int


class Command(NamedTuple):
    """A draw command with what it draws. Equal ones draw the same pixels.

    box, texture: of the part.
    origin: of the window.
    indices: INDEX, from the first of its vertices on.
    vertices: VERTEX.
    """

    box: Box
    texture: tuple[int, Hashable, bool]
    origin: tuple[float, float]
    indices: bytes
    vertices: bytes

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return its indices (3 T,), and its vertices as words (V, 5): structured arrays are slow to compare."""
        words = np.frombuffer(self.vertices, np.uint32).reshape(-1, VERTEX.itemsize // 4)
        return np.frombuffer(self.indices, INDEX), words

    def from_the_end(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `arrays` in the opposite order, as if the last vertex were the first."""
        indices, words = self.arrays()
        return len(words) - 1 - indices[::-1], words[::-1]

    def around(self, used: np.ndarray | slice = slice(None)) -> Box:
        """Return a rectangle outside of which triangles between some of its vertices, by number, draw nothing."""
        places = self.arrays()[1][used, :2].T.copy().view(np.float32)
        if not places.size:
            return EMPTY
        (left, top), (right, bottom) = (places.min(1) - self.origin).tolist(), (places.max(1) - self.origin).tolist()
        if not isfinite(left + top + right + bottom):  # a plot without a range makes such; the GPU draws what it likes
            return self.box
        return self.box.common(Box(floor(left), floor(top), ceil(right), ceil(bottom)))


@dataclass(frozen=True)
class Drawn:
    """The draw commands of one imgui window, in order.

    vertices: as imgui has them, VERTEX.
    indices: as imgui has them, INDEX.
    parts: the commands.
    origin: the place of the framebuffer's first pixel.
    """

    vertices: bytes
    indices: bytes
    parts: tuple[Part, ...]
    origin: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def commands(self) -> tuple[Command, ...]:
        """The commands with what they draw."""
        indices, size = np.frombuffer(self.indices, INDEX), VERTEX.itemsize
        found: list[Command] = []
        for part in self.parts:
            own = indices[part.first : part.first + part.length]
            first, end = int(own.min()), int(own.max()) + 1  # mostly nothing else lies between them
            own, vertices = (own - own.dtype.type(first)).tobytes(), self.vertices[first * size : end * size]
            found.append(Command(part.box, part.texture, self.origin, own, vertices))
        return tuple(found)


NOTHING = Drawn(b"", b"", ())


def damage(before: Sequence[Drawn], now: Sequence[Drawn]) -> list[Box]:
    """Return the rectangles outside of which two frames are alike. No two of them overlap.

    Triangles that have changed, or that came or went, are drawn again where they were and where they are.
    """
    found: list[Box] = []
    for old, new in zip_longest(before, now, fillvalue=NOTHING):
        if old != new:
            for box in filter(None, _changed(old, new)):
                _add(found, box)
    return found


def _changed(old: Drawn, new: Drawn) -> list[Box]:
    """Where two frames of a window differ."""
    gone, came = _between(old.commands, new.commands)
    if len(gone) != len(came):
        return [one.around() for one in (*gone, *came)]
    found: list[Box] = []
    for a, b in zip(gone, came, strict=True):
        if a != b:
            found += _moved(a, b) if a[:3] == b[:3] else (a.around(), b.around())
    return found


def _between(old: Sequence[Command], new: Sequence[Command]) -> tuple[Sequence[Command], Sequence[Command]]:
    """Return the commands from the first that differs to the last that does."""
    count = min(len(old), len(new))
    first = next((k for k in range(count) if old[k] != new[k]), count)
    last = next((k for k in range(count - first) if old[-1 - k] != new[-1 - k]), count - first)
    return old[first : len(old) - last], new[first : len(new) - last]


def _moved(old: Command, new: Command) -> tuple[Box, Box]:
    """Where two commands differ that have the same texture and may draw to the same place."""
    (before, words), (now, new_words) = one, other = old.arrays(), new.arrays()
    if old.indices == new.indices:
        differ = (words != new_words).any(1)[before].reshape(-1, 3).any(1).repeat(3)
        return old.around(before[differ]), new.around(now[differ])
    first = _alike(one, other)
    last = min(_alike(old.from_the_end(), new.from_the_end()), min(len(before), len(now)) - first)
    return old.around(before[first : len(before) - last]), new.around(now[first : len(now) - last])


def _alike(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> int:
    """Return the number of leading indices, of whole triangles, that draw the same in both."""
    (indices, words), (others, other_words) = one, other
    shared = min(len(words), len(other_words))
    vertices = int(np.append((words[:shared] != other_words[:shared]).any(1), True).argmax())
    shared = min(len(indices), len(others))
    differ = (indices[:shared] != others[:shared]) | (indices[:shared] >= vertices)
    return int(np.append(differ, True).argmax()) // 3 * 3


def _add(found: list[Box], box: Box) -> None:
    """Add a rectangle, joined with those that it overlaps: what lies in two of them would be blended twice.

    It is joined with those that are near as well, since a rectangle more takes as long as DEAR pixels more.
    """
    k = 0
    while k < len(found):
        both = box.around(found[k])
        if both.area <= box.area + found[k].area + DEAR or box.common(found[k]):
            found.pop(k)
            box, k = both, 0
        else:
            k += 1
    found.append(box)
