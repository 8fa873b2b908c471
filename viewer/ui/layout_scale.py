"""Fit a stored layout of the docks to another size of text. imgui stores lengths in pixels."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

Size = tuple[float, float]  # width, height in pixels
READABLE_EM = 23.0, 17.5  # a panel beside the picture, and one under it; they also are the default layout's
SHORT_OF_ROOM = 0.49  # the default layout gives a panel half of a window that is too small
LINE = re.compile(r"[ \t]*Dock(?:Space|Node) +ID=(\w+)(?: .*)?", re.MULTILINE)
PAIR = re.compile(r"(?<=[ \n])(Pos|Size|SizeRef)=(-?\d+),(-?\d+)")
SIZE = re.compile(r"\b(Size|SizeRef)=(-?\d+),(-?\d+)")
SPLIT, PARENT = re.compile(r"\bSplit=([XY])"), re.compile(r"\bParent=(\w+)")
MOST_PIXELS = 32767  # imgui keeps lengths in 16 bits
EMS = range(7, 100)  # of scales from 0.5 to 6


@dataclass
class _Node:
    """A node of the tree of docks. size: stored; of the two halves of a split only the proportion counts."""

    size: Size
    split: str  # X: the halves lie beside each other, Y: one above the other
    root: bool  # no half of another
    central: bool  # holds the picture, which takes what the others leave
    halves: list[_Node] = field(default_factory=list)


def fitted(text: str, old_em: float, em: float, window: Size) -> str:
    """Return a stored layout for text of another size.

    Panels beside and under the picture keep their size in em, up to half of the space, and so do panels that lie beside
    each other. Panels above each other keep their proportion.

    text: what imgui stores.
    old_em: the size of text when it was stored, in pixels.
    em: the size now.
    window: the window's size now, in pixels.
    """
    ratio = em / old_em

    def scaled(match: re.Match[str]) -> str:
        name, *numbers = match.groups()
        x, y = (ratio * float(number) for number in numbers)
        if name == "Size":
            x, y = min(x, window[0]), min(y, window[1])
        return f"{name}={_pixels(x)},{_pixels(y)}"

    nodes = _nodes(text)
    for node in nodes.values():
        if node.root:
            whole = window if node.central else (ratio * node.size[0], ratio * node.size[1])
            _fit(node, node.size, whole, ratio, em)
    return LINE.sub(lambda match: _with_size(match[0], nodes[match[1]]), PAIR.sub(scaled, text))


def em_of_menu(text: str) -> float | None:
    """Return the size of text with which a layout was stored, in pixels, from the height of the menu above the docks.

    Earlier versions did not store it. None: the height is of no known size.
    """
    space = re.search(r"DockSpace .*Pos=\d+,(\d+)", text)
    height = int(space[1]) if space else 0
    return next((float(em) for em in EMS if em + 2 * max(1, round(0.25 * em)) == height), None)


def _nodes(text: str) -> dict[str, _Node]:
    """Read the docks' nodes, by their ids. imgui writes parents before their children."""
    nodes: dict[str, _Node] = {}
    parents: dict[str, str] = {}
    for match in LINE.finditer(text):
        line, number = match[0], match[1]
        if number in nodes:
            continue  # the first one counts, so that no node lies below itself
        size, split, above = SIZE.search(line), SPLIT.search(line), PARENT.search(line)
        parent, central = above[1] if above else "", "CentralNode=1" in line
        extent = (float(size[2]), float(size[3])) if size else (0.0, 0.0)
        nodes[number] = _Node(extent, split[1] if split else "", parent not in parents, central)
        if parent in parents:
            nodes[parent].halves.append(nodes[number])
        parents[number] = parent
        while central and parent in nodes:
            nodes[parent].central = True
            parent = parents[parent]
    return nodes


def _fit(node: _Node, old: Size, new: Size, ratio: float, em: float) -> None:
    """Set the sizes of a node and of all below it. old, new: what it had and gets on the screen."""
    node.size = new
    if len(node.halves) != 2:
        return
    axis = 0 if node.split == "X" else 1
    lengths = [half.size[axis] for half in node.halves]
    if node.halves[0].central or node.halves[1].central:
        side = 1 if node.halves[0].central else 0
        before = min(lengths[side], old[axis])
    else:
        side = 0 if lengths[0] < 0.9 * lengths[1] else 1  # the first of two halves grows
        before = old[axis] * lengths[side] / max(sum(lengths), 1.0)
    share = before / max(old[axis], 1.0)
    after = share * new[axis]
    if axis == 0 or node.central:
        after = ratio * before
        if share > SHORT_OF_ROOM:  # with more room it would have been larger
            after = max(after, READABLE_EM[axis] * em)
        after = min(after, max(share, 0.5) * new[axis])
    for place, half in enumerate(node.halves):
        extents = [list(old), list(new)]
        for extent, length in zip(extents, (before, after), strict=True):
            extent[axis] = length if place == side else extent[axis] - length
        _fit(half, (extents[0][0], extents[0][1]), (extents[1][0], extents[1][1]), ratio, em)


def _with_size(line: str, node: _Node) -> str:
    return SIZE.sub(lambda match: f"{match[1]}={_pixels(node.size[0])},{_pixels(node.size[1])}", line)


def _pixels(length: float) -> int:
    return round(max(-MOST_PIXELS, min(length, MOST_PIXELS)))
