"""Change valid files at random and read them: every reader accepts or refuses each within limits of time and memory.

The long run: `python tests/helpers/fuzzing.py --mutations 20000`. `--seed S` begins at mutation S, to resume or to
repeat one mutation (`--reader NAME --seed S --mutations 1`). It prints a table. The status is 1 if a reader broke.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from captures import orbit_pose
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.datasets.images import UnreadableError, measure, read_photo

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
    """One reader. file: the valid file that is changed; work: reads it."""

    file: Path
    work: Callable[[], object]


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
        reader.file.write_bytes(mutated(valid, number))
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


def readers(base: Path) -> dict[str, Reader]:  # noqa: PLR0915  a list of readers, one after the other
    """Write one valid file of every kind into `base`. Returns {name: reader}."""
    import torch

    from nerf_core.common.json_files import read_json
    from nerf_core.datasets import DATASETS, LoadOptions
    from nerf_core.datasets.colmap_files import check_model
    from nerf_core.datasets.formats.llff import read_table
    from nerf_core.geometry.camera_files import camera_of
    from nerf_core.training import checkpoint
    from nerf_core.training.run_folder import RunFolder

    found: dict[str, Reader] = {}
    pixels = np.random.default_rng(0).integers(0, 256, (16, 24, 3), dtype=np.uint8)

    def photo(name: str, suffix: str, image: Image.Image, **options: Any) -> None:
        file = base / f"{name}.{suffix}"
        image.save(file, **options)

        def work() -> None:
            header = measure(file)
            read_photo(file, (min(8, header.width), min(8, header.height)), (0, 0, 0))

        found[name] = Reader(file, work)

    image = Image.fromarray(pixels)
    photo("PNG", "png", image)
    photo("palette PNG", "png", image.quantize(16))
    photo("16-bit PNG", "png", Image.fromarray(pixels[..., 0].astype(np.uint16) * 200))
    photo("JPEG", "jpg", image)
    photo("TIFF", "tif", image)
    photo("deflated TIFF", "tif", image, compression="tiff_deflate")
    photo("WebP", "webp", image)
    photo("BMP", "bmp", image)

    for kind in ("transforms", "blender"):
        folder = base / kind
        folder.mkdir()
        image.save(folder / "a.png")
        frames = [{"file_path": "a.png", "transform_matrix": orbit_pose(0.5 * i).tolist()} for i in range(3)]
        document = {"camera_angle_x": 0.7, "frames": frames} | ({"w": 24, "h": 16} if kind == "transforms" else {})
        files = ["transforms.json"] if kind == "transforms" else [f"transforms_{s}.json" for s in ("train", "test")]
        for name in files:
            (folder / name).write_text(json.dumps(document))
        data_set = DATASETS.get(kind)
        found[f"{kind} JSON"] = Reader(folder / files[0], lambda d=data_set, f=folder: d.read(f, LoadOptions()))

    table = base / "poses_bounds.npy"
    np.save(table, np.random.default_rng(0).random((4, 17)))
    found["LLFF table"] = Reader(table, lambda: read_table(table))

    model = base / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 24 16 30 31 12 8\n")
    (model / "images.txt").write_text("# Number of images: 1\n1 1 0 0 0 0 0 2 1 a.png\n1 2 1\n")
    (model / "points3D.txt").write_text("1 0.5 0.5 0.5 9 9 9 0.5 1 0\n")
    for name in ("cameras", "images", "points3D"):
        found[f"COLMAP {name}.txt"] = Reader(model / f"{name}.txt", lambda: check_model(model))

    binary = base / "binary"
    binary.mkdir()
    models = {
        "cameras": struct.pack("<QiiQQ4d", 1, 1, 1, 24, 16, 30, 31, 12, 8),
        "images": struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 2, 1) + b"a.png\0" + struct.pack("<Qddq", 1, 1, 2, 1),
        "points3D": struct.pack("<QQ3d3BdQII", 1, 1, 0.5, 0.5, 0.5, 9, 9, 9, 0.5, 1, 1, 0),
    }
    for name, data in models.items():
        (binary / f"{name}.bin").write_bytes(data)
        found[f"COLMAP {name}.bin"] = Reader(binary / f"{name}.bin", lambda: check_model(binary))

    saved = base / "run.safetensors"
    described = {name: kind() for name, (kind, _) in checkpoint.REQUIRED.items()}
    checkpoint.save(saved, described, {"weights": torch.zeros(8, 8), "more": torch.zeros(3)})
    found["checkpoint"] = Reader(saved, lambda: checkpoint.load(saved))

    camera = base / "camera.json"
    lens = {
        "c2w": orbit_pose(0.5)[:3].tolist(),
        "width": 24,
        "height": 16,
        "fx": 30.0,
        "fy": 30.0,
        "cx": 12.0,
        "cy": 8.0,
    }
    camera.write_text(json.dumps(lens))

    def read_camera() -> None:
        try:
            camera_of(read_json(camera).values)
        except (TypeError, ValueError, OverflowError) as error:  # `picked_camera` names the file
            raise UserError(" ".join(str(error).split())) from None

    found["camera file"] = Reader(camera, read_camera)

    folder = base / "run"
    folder.mkdir()
    log = RunFolder(folder)
    log.log_file.write_text("".join(f'{{"step": {k}, "loss": 0.5}}\n' for k in range(20)))
    found["log.jsonl"] = Reader(log.log_file, lambda: log.rewind(10))
    return found


def main() -> int:
    """Run all readers or one, and print the table."""
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
