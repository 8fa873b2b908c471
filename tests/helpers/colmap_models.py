"""Small COLMAP models with a photo for each kind of camera, and COLMAP's reader in a process that is started once."""

from __future__ import annotations

import atexit
import json
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
from captures import orbit_pose
from exports import quaternion

from nerf_core.common.subprograms import Finished
from nerf_core.datasets import colmap_reader

SIZE = (24, 16)
PARAMETERS = {  # {camera model: its number in COLMAP's files, and parameters of a small lens}
    "SIMPLE_PINHOLE": (0, [30, 12, 8]),
    "PINHOLE": (1, [30, 31, 12, 8]),
    "SIMPLE_RADIAL": (2, [30, 12, 8, 0.02]),
    "RADIAL": (3, [30, 12, 8, 0.02, -0.01]),
    "OPENCV": (4, [30, 31, 12, 8, 0.02, -0.01, 0.001, 0.002]),
    "OPENCV_FISHEYE": (5, [20, 21, 12, 8, 0.02, -0.01, 0.003, 0.001]),
    "FULL_OPENCV": (6, [30, 31, 12, 8, 0.02, -0.01, 0.001, 0.002, 0.001, 0.01, 0.0, 0.0]),
    "SIMPLE_RADIAL_FISHEYE": (8, [20, 12, 8, 0.02]),
    "RADIAL_FISHEYE": (9, [20, 12, 8, 0.02, -0.01]),
}
NAMES = tuple(f"{kind.lower()}.png" for kind in PARAMETERS)
POINTS = np.random.default_rng(0).normal(0, 0.5, (5, 3))
SERVER = f"""
import json, os, signal, sys
sys.path.insert(0, {str(Path(colmap_reader.__file__).parent)!r})
import pycolmap, colmap_reader
for line in sys.stdin:
    model, out, seconds = json.loads(line)
    child = os.fork()
    if not child:
        signal.alarm(seconds)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            colmap_reader.main(model, out)
        except BaseException:
            os._exit(1)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def _poses() -> list[list[float]]:
    """Rotation (w, x, y, z) and translation of each photo, from the world to the camera."""
    found = []
    for k in range(len(NAMES)):
        pose = orbit_pose(0.3 + 0.6 * k)
        rotation = pose[:3, :3].T * np.array([[1], [-1], [-1]])
        x, y, z, w = quaternion(rotation)
        found.append([float(v) for v in (w, x, y, z, *(-rotation @ pose[:3, 3]))])
    return found


def write_text(folder: Path) -> None:
    """Write the model as text. Each of the first three photos shows all points."""
    folder.mkdir(parents=True)
    cameras = [f"{k + 1} {kind} 24 16 {' '.join(map(str, v))}\n" for k, (kind, (_, v)) in enumerate(PARAMETERS.items())]
    (folder / "cameras.txt").write_text("# Camera list\n" + "".join(cameras))
    seen = " ".join(f"1 2 {k + 1}" for k in range(len(POINTS)))
    images = [
        f"{k + 1} {' '.join(map(str, pose))} {k + 1} {NAMES[k]}\n{seen if k < 3 else ''}\n"
        for k, pose in enumerate(_poses())
    ]
    (folder / "images.txt").write_text(f"# Number of images: {len(NAMES)}\n" + "".join(images))
    points = [f"{k + 1} {x} {y} {z} 9 9 9 0.5 1 {k} 2 {k} 3 {k}\n" for k, (x, y, z) in enumerate(POINTS)]
    (folder / "points3D.txt").write_text("".join(points))


def write_binary(folder: Path) -> None:
    """Write the same model as COLMAP 3 does: https://colmap.github.io/format.html."""
    folder.mkdir(parents=True)
    cameras = [
        struct.pack(f"<IiQQ{len(values)}d", k + 1, number, *SIZE, *values)
        for k, (number, values) in enumerate(PARAMETERS.values())
    ]
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(cameras))
    images = []
    for k, pose in enumerate(_poses()):
        seen = [struct.pack("<ddQ", 1, 2, j + 1) for j in range(len(POINTS))] if k < 3 else []
        head = struct.pack("<I7dI", k + 1, *pose, k + 1) + NAMES[k].encode() + b"\0"
        images.append(head + struct.pack("<Q", len(seen)) + b"".join(seen))
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    points = [
        struct.pack("<Q3d3BdQ6I", k + 1, *point, 9, 9, 9, 0.5, 3, 1, k, 2, k, 3, k) for k, point in enumerate(POINTS)
    ]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(points))


@cache
def _server() -> subprocess.Popen[str]:
    child = subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def end() -> None:
        child.communicate()  # closes its input, at which it ends

    atexit.register(end)
    return child


def read_forked(command: list[str], seconds: float) -> Finished:
    """Do what `run_limited` does for `colmap_reader`, in a fork of a process that has pycolmap: 10 ms instead of 500.

    Raises AssertionError if it hangs: a damaged model must be refused before pycolmap sees it.
    """
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    server.stdin.write(json.dumps([*command[-2:], 5]) + "\n")
    server.stdin.flush()
    status = int(server.stdout.readline())
    assert status != -14, "pycolmap hangs"  # SIGALRM
    return Finished(b"", f"crash {status}" if status else "")
