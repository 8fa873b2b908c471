"""Change valid files at random and read them: every reader accepts or refuses each within limits of time and memory.

The long run: `python tests/helpers/fuzzing.py --mutations 20000`. `--seed S` begins at mutation S, to resume or to
repeat one mutation (`--reader NAME --seed S --mutations 1`). It prints a table. The status is 1 if a reader broke.
"""

from __future__ import annotations

import argparse
import random
import re
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.datasets.images import UnreadableError

SECONDS, MEGABYTES = 5.0, 1000.0  # the most that reading one changed file may take
EDGES = [
    b"\0" * 4,
    b"\xff" * 4,
    b"\xff" * 8,
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"[",
    b"{",
    b'"',
    b"NaN",
    b"1e999",
]


@dataclass(frozen=True)
class Reader:
    """One reader. file: the valid file that is changed; work: reads it; change: (its bytes, seed) → changed bytes."""

    file: Path
    work: Callable[[], object]
    change: Callable[[bytes, int], bytes] | None = None


@dataclass
class Result:
    """What became of a reader's mutations. broken: seed and traceback of each that neither passed nor was refused."""

    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    broken: list[str] = field(default_factory=list)


def mutated(data: bytes, seed: int) -> bytes:
    """Change a file by one to three random edits: bytes, numbers at their limits, cuts, repeats, other digits."""
    chance = random.Random(seed)
    new = bytearray(data)
    for _ in range(chance.randint(1, 3)):
        near_start = chance.random() < 0.5  # headers are short, and hold the counts
        place = chance.randrange(min(len(new), 200) if near_start and new else len(new) + 1) if new else 0
        kind = chance.randrange(6)
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
        else:
            numbers = list(re.finditer(rb"\d+", bytes(new)))
            if numbers:
                found = chance.choice(numbers)
                new[found.start() : found.end()] = chance.choice([b"0", b"-1", b"99999999", b"1e300", b"null", b"[]"])
    if new.startswith(b"\x89PNG") and chance.random() < 0.8:
        _resealed(new)
    return bytes(new)


def _resealed(png: bytearray) -> None:
    """Set the checksums of a PNG's chunks right, because the reader stops at a wrong one."""
    place = 8
    while place + 12 <= len(png):
        end = place + 8 + int.from_bytes(png[place : place + 4], "big")
        if end + 4 > len(png):
            return
        png[end : end + 4] = zlib.crc32(png[place + 4 : end]).to_bytes(4, "big")
        place = end + 4


def run(reader: Reader, mutations: int, seed: int = 0) -> Result:
    """Read `mutations` changed files. The valid file is put back at the end."""
    valid, result = reader.file.read_bytes(), Result()
    reader.work()  # the valid file is accepted; imports are made here, outside the measurement
    start = _megabytes(reset=True)
    for number in range(seed, seed + mutations):
        reader.file.write_bytes((reader.change or mutated)(valid, number))
        began = time.perf_counter()
        try:
            reader.work()
            result.accepted += 1
        except (UserError, UnreadableError) as error:
            result.refused += 1
            if "\n" in str(error):
                result.broken.append(f"seed {number}: a message of several lines: {error}")
        except Exception:
            result.broken.append(f"seed {number}: {traceback.format_exc()}")
        result.seconds = max(result.seconds, time.perf_counter() - began)
    result.megabytes = _megabytes() - start
    reader.file.write_bytes(valid)
    return result


def _megabytes(reset: bool = False) -> float:
    """The peak of this process's resident memory since the last reset (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def main() -> int:
    """Run all readers or one, and print the table."""
    from fuzzed_readers import readers

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutations", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", help="one reader's name; all by default")
    options = parser.parse_args()
    row = "{:<22}{:>10}{:>10}{:>10}{:>9}{:>10}{:>8}".format
    print(row("reader", "mutations", "accepted", "refused", "worst s", "worst MB", "broken"))
    broken: list[str] = []
    with tempfile.TemporaryDirectory() as base:
        for name, reader in readers(Path(base)).items():
            if options.reader in (None, name):
                r = run(reader, options.mutations, options.seed)
                cost = f"{r.seconds:.2f}", f"{r.megabytes:.0f}"
                print(row(name, options.mutations, r.accepted, r.refused, *cost, len(r.broken)), flush=True)
                broken += [f"{name}: {fault}" for fault in r.broken[:3]]
                if r.seconds > SECONDS or r.megabytes > MEGABYTES:
                    broken.append(f"{name}: took {r.seconds:.1f} s and {r.megabytes:.0f} MB")
    print("\n".join(broken))
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
