"""Random changes of files, for `fuzzing.py`: of bytes, of numbers and words in texts, of JSON, and of whole files."""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Literal

# What becomes of a file: other bytes, or none (None), a folder, a link to a device, a link to nowhere, a pipe.
Change = bytes | Literal["folder", "device", "nowhere", "pipe"] | None
Tree = Mapping[str, bytes]

EDGES = [b"\0" * 4, b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"[", b"{", b'"']
NUMBERS = [b"0", b"-1", b"99999999", b"1e300", b"-1e300", b"1e-300", b"1e999", b"NaN", b"-Infinity", b"nan", b"inf",
           b"null", b"[]", b"true", b"9" * 5000, b"0x10", b"1_000", "٣".encode()]  # fmt: skip
WORDS = [
    b"../../outside.png", b"/dev/zero", b"/etc/hostname", b"C:\\photos\\a.png", b"..", b"", b" ", b"\xff\xfe.png",
    "é😀\u202e.png".encode(), b"a" * 5000, b"a\\u0000b", b"a\nb", b"images", b"OPENCV_FISHEYE", b"NO_MODEL",
]  # fmt: skip
VALUES: list[Any] = [
    None, True, [], {}, [[]], [0] * 4, "", "x", "a\x00b", "é😀\u202e", "../../outside.png", "/dev/zero",
    "/etc/hostname", "images", "a" * 5000, "OPENCV_FISHEYE", 0, -1, 0.5, 1e-300, 1e300, -1e300, 1e11, 10**400,
    float("nan"), float("inf"), -float("inf"),
]  # fmt: skip
DOUBLES = [0.0, -1.0, 1e300, 1e-300, float("nan"), float("inf"), -float("inf"), 1e12]
TEXTS = (".json", ".jsonl", ".csv", ".xml", ".txt")


def changed(tree: Tree, seed: int) -> dict[str, Change]:
    """Choose a file and what becomes of it: of nine, six times other content, else something is wrong with the file."""
    chance = random.Random(seed)
    names = sorted(tree)
    told = [name for name in names if name.endswith((*TEXTS, ".npy", ".bin"))] or names
    name = chance.choice(told if chance.random() < 0.7 else names)
    if chance.random() < 2 / 3:
        return {name: other_content(name, tree[name], chance)}
    other = chance.choice(names)
    kinds: list[dict[str, Change]] = [
        {name: None}, {name: b""}, {name: "folder"}, {name: "device"}, {name: "nowhere"}, {name: "pipe"},
        {name: tree[other], other: tree[name]}, {name: None, name + "~": tree[name]},
        {name: None, f"é😀 {name.rpartition('/')[2]}": tree[name]}, {name: b"<!DOCTYPE html><html></html>"},
    ]  # fmt: skip
    return chance.choice(kinds)


def other_content(name: str, data: bytes, chance: random.Random) -> bytes:
    """Change the content of a file by the kind of the file."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [mutated]
    if name.endswith(TEXTS):
        ways.append(other_words)
    if name.endswith(".json"):
        ways += [other_values, other_values]
    if name.endswith((".npy", ".bin")):
        ways.append(other_doubles)
    return chance.choice(ways)(data, chance)


def mutated(data: bytes, chance: random.Random) -> bytes:
    """Change a file by one to three random edits: bytes, bits, numbers at their limits, cuts, repeats, other digits."""
    new = bytearray(data)
    for _ in range(chance.randint(1, 3)):
        near_start = chance.random() < 0.5  # headers are short, and hold the counts
        place = chance.randrange(min(len(new), 200) if near_start and new else len(new) + 1) if new else 0
        kind = chance.randrange(7)
        if kind == 0:
            new[place : place + 1] = bytes([chance.randrange(256)])
        elif kind == 1:
            edge = chance.choice(EDGES)
            new[place : place + len(edge)] = edge
        elif kind == 2:
            del new[place : place + chance.choice([1, 8, len(new)])]
        elif kind == 3:
            new[place:place] = new[place : place + 40] * chance.choice([1, 100])
        elif kind == 4:
            new[place:place] = chance.choice([b"[" * 50_000, b"-", b"9" * 5000, b"\n", b"\xfe"])
        elif kind == 5 and place < len(new):
            new[place] ^= 1 << chance.randrange(8)
        else:
            _replace(new, re.finditer(rb"\d+", bytes(new)), NUMBERS[:6], chance)
    if new.startswith(b"\x89PNG") and chance.random() < 0.8:
        _resealed(new)
    return bytes(new)


def other_words(data: bytes, chance: random.Random) -> bytes:
    """Change a number, a word or the lines of a text."""
    new = bytearray(data)
    kind = chance.randrange(5)
    if kind < 2:
        _replace(new, re.finditer(rb"-?\d+(\.\d+)?(e[+-]?\d+)?", data), NUMBERS, chance)
    elif kind == 2:
        _replace(new, re.finditer(rb"[\w./-]*[A-Za-z][\w./-]*", data), WORDS, chance)
    else:
        parts = re.split(rb"(?<=>)(?=<)" if data.lstrip().startswith(b"<") else rb"(?<=\n)", data)
        i, j = chance.randrange(len(parts)), chance.randrange(len(parts))
        if kind == 3:
            parts[i], parts[j] = parts[j], parts[i]
        else:
            parts[i : i + 1] = [parts[i]] * chance.choice([0, 2, 1000])
        new = bytearray(b"".join(parts))
    return bytes(new)


def other_values(data: bytes, chance: random.Random) -> bytes:
    """Change one to three values of a JSON document: another value, none, twice, elsewhere, or deeply nested."""
    document = json.loads(data)
    for _ in range(chance.randint(1, 3)):
        found = _places(document)
        if not found:
            break
        *way, last = chance.choice(found)
        holder: Any = document
        for key in way:
            holder = holder[key]
        kind = chance.randrange(6)
        if kind == 0:
            del holder[last]
        elif kind == 1 and isinstance(holder, list):
            holder.insert(chance.randrange(len(holder) + 1), holder[last])
        elif kind == 2 and isinstance(holder, list):
            chance.shuffle(holder)
        elif kind == 3 and isinstance(holder, dict):
            holder[chance.choice(sorted(holder))] = holder[last]
        elif kind == 4:
            for _ in range(chance.choice([1, 200])):  # json writes no more than some 900
                holder[last] = [holder[last]]
        else:
            holder[last] = chance.choice(VALUES)
    return json.dumps(document, ensure_ascii=chance.random() < 0.5).encode("utf-8", "surrogatepass")


def other_doubles(data: bytes, chance: random.Random) -> bytes:
    """Replace a number of 8 bytes at a multiple of 4 bytes."""
    place = 4 * chance.randrange(max(len(data) // 4 - 1, 1))
    return data[:place] + struct.pack("<d", chance.choice(DOUBLES)) + data[place + 8 :]


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to all values in a document, of which those at most 20 deep count."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    inside = [p for key, child in children for p in _places(child, (*path, key))] if len(path) < 20 else []
    return [path] * bool(path) + inside


def _replace(new: bytearray, found: Any, by: list[bytes], chance: random.Random) -> None:
    matches = list(found)
    if matches:
        match = chance.choice(matches)
        new[match.start() : match.end()] = chance.choice(by)


def _resealed(png: bytearray) -> None:
    """Set the checksums of a PNG's chunks right, because the reader stops at a wrong one."""
    place = 8
    while place + 12 <= len(png):
        end = place + 8 + int.from_bytes(png[place : place + 4], "big")
        if end + 4 > len(png):
            return
        png[end : end + 4] = zlib.crc32(png[place + 4 : end]).to_bytes(4, "big")
        place = end + 4
