"""Change valid captures and files at random and read them: every reader opens or refuses each, and harms nothing.

The long run: `python tests/helpers/fuzzing.py --mutations 1000`. `--seed S` begins at mutation S, to resume or to
repeat one mutation (`--reader NAME --seed S --mutations 1`). It prints a table. The status is 1 if anything was wrong.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from changes import Change, changed, other_content

from nerf_core.common.errors import UserError
from nerf_core.datasets.capture import Capture
from nerf_core.datasets.images import UnreadableError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene

SECONDS, MEGABYTES = 2.0, 200.0  # the most of a processor and of memory that reading one changed capture may take
RUNAWAY = 4_000_000_000  # bytes of address space that a reader may take, threads and all
LONGEST = 1500  # characters of a message: one with two long paths is shorter


@dataclass(frozen=True)
class Reader:
    """One reader.

    place: the valid file, or the folder of the valid capture, that is changed.
    work: reads it.
    change: (the file's bytes, a source of chance) → other bytes, where not any change will do.
    cost: of a run's mutations one of so many is done, because each takes long.
    megabytes: the most memory that one may take.
    """

    place: Path
    work: Callable[[], object]
    change: Callable[[bytes, random.Random], bytes] | None = None
    cost: int = 1
    megabytes: float = MEGABYTES


@dataclass
class Result:
    """What became of a reader's mutations. wrong: seed and fault of each that was neither opened nor refused well."""

    done: int = 0
    opened: int = 0
    refused: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    wrong: list[str] = field(default_factory=list)


def run(reader: Reader, mutations: int, seed: int = 0) -> Result:
    """Read `mutations` changed captures, or fewer by the reader's cost. What is valid is put back after each."""
    base = reader.place if reader.place.is_dir() else reader.place.parent
    whole = [f for f in reader.place.rglob("*") if f.is_file()] if base is reader.place else [reader.place]
    valid = {f.relative_to(base).as_posix(): f.read_bytes() for f in whole}
    result = Result()
    reader.work()  # what is valid is opened; imports are made here, outside the measurement
    start = _megabytes(reset=True)
    with limited_memory():
        _run(reader, result, base, valid, range(seed, seed - (-mutations // reader.cost)))
    result.megabytes = _megabytes() - start
    if result.megabytes > reader.megabytes:
        result.wrong.append(f"{result.megabytes:.0f} MB of memory")
    return result


def _run(reader: Reader, result: Result, base: Path, valid: dict[str, bytes], numbers: Iterable[int]) -> None:
    for number in numbers:
        chance = random.Random(number)
        changes: dict[str, Change]
        if reader.change is not None:
            changes = {name: reader.change(data, chance) for name, data in valid.items()}
        elif base is not reader.place:
            changes = {name: other_content(name, data, chance) for name, data in valid.items()}
        else:
            changes = dict(changed(valid, number))
        for name, change in changes.items():
            _put(base / name, change)
        before = _listing(reader.place)
        fault = _read(reader, result, [*valid, base.name])
        if not fault and _listing(reader.place) != before:
            fault = "something was written into the capture"
        if fault:
            result.wrong.append(f"seed {number} ({', '.join(changes)}): {fault}")
        for name in changes:
            _put(base / name, valid.get(name))


@contextmanager
def limited_memory() -> Iterator[None]:
    """Let a reader without bounds, as of a device, fail with MemoryError before the machine does."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + RUNAWAY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _read(reader: Reader, result: Result, names: Iterable[str]) -> str:
    """Read what was changed, and count it. Returns what is wrong; empty: nothing."""
    began, fault = _seconds(), ""
    result.done += 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Pillow's remarks on odd tags are ignored where it is used (`images`)
            warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")
            found = reader.work()
        result.opened += 1
        if not all(np.isfinite(_numbers(camera)).all() for camera in _cameras(found)):
            fault = "a camera with numbers that are not finite was accepted"
    except (UserError, UnreadableError) as error:
        result.refused += 1
        said = str(error)
        if "\n" in said or len(said) > LONGEST:
            fault = f"a message of several lines or {len(said)} characters: {said}"
        elif not any(part in said for name in names for part in name.split("/")):
            fault = f"a message that names no file: {said}"
    except Exception:
        fault = traceback.format_exc()
    took = _seconds() - began
    result.seconds = max(result.seconds, took)
    return fault or (f"{took:.1f} s" if took > SECONDS else "")


def _cameras(found: object) -> list[Camera]:
    if isinstance(found, Scene):
        return [view.camera for view in found.views]
    return [photo.camera for photo in found.photos] if isinstance(found, Capture) else []


def _numbers(camera: Camera) -> np.ndarray:
    return np.array([*camera.intrinsics(), *camera.c2w.ravel()], float)


def _put(file: Path, change: Change) -> None:
    """Give a file its new content, or make it something else than a file."""
    if file.is_dir() and not file.is_symlink():
        shutil.rmtree(file)
    else:
        file.unlink(missing_ok=True)
    if isinstance(change, bytes):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(change)
    elif change == "folder":
        file.mkdir()
    elif change == "pipe":
        os.mkfifo(file)
    elif change is not None:
        file.symlink_to("/dev/zero" if change == "device" else "/no such place")


def _listing(place: Path) -> list[tuple[str, int, int]]:
    """The files of a capture, with size and time of change. A single file's reader may write beside it, as to a log."""
    if not place.is_dir():
        return []
    return sorted((str(f), s.st_size, s.st_mtime_ns) for f in place.rglob("*") for s in [f.lstat()])


def _seconds() -> float:
    """The time of processors that this process and its children have taken."""
    return sum(os.times()[:4])


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
    parser.add_argument("--mutations", type=int, default=1000, help="of each reader; fewer of those that take long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", help="one reader's name; all by default")
    options = parser.parse_args()
    print("| reader | mutations | opened | refused | wrong | most seconds | MB |\n|---|---|---|---|---|---|---|")
    wrong: list[str] = []
    total = Result()
    began = time.process_time()
    with tempfile.TemporaryDirectory() as base:
        for name, reader in readers(Path(base)).items():
            if options.reader in (None, name):
                r = run(reader, options.mutations, options.seed)
                print(f"| {name} | {r.done:,} | {r.opened:,} | {r.refused:,} | {len(r.wrong)} | {r.seconds:.2f} | "
                      f"{max(r.megabytes, 0):.0f} |", flush=True)  # fmt: skip
                wrong += [f"{name}: {fault}" for fault in r.wrong[:5]]
                total.done += r.done
                total.opened, total.refused = total.opened + r.opened, total.refused + r.refused
    print(f"| all | {total.done:,} | {total.opened:,} | {total.refused:,} | {len(wrong)} | | |")
    print("\n".join([f"{time.process_time() - began:.0f} s of a processor", *wrong]))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
