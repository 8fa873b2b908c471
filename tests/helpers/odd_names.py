"""Names of files that no text holds or that break a line, and a small capture in which everything has one."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from captures import orbit_pose, write_photo

from nerf_core.common.names import UNPRINTABLE

# Latin-1, a new line, an escape sequence, right to left, and the marks of matplotlib's formulas and imgui's formats
ODD = os.fsdecode(b"caf\xe9 \xff\n\x1b[2J\xe2\x80\xaez$^$%s[b]")
SHOWN = r"caf\xe9 \xff\n\x1b[2J\u202ez$^$%s[b]"
PHOTOS = 6

# Other systems hold names in Unicode, and refuse these bytes.
needs_bytes = pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="needs file names of any bytes")


def write_capture(folder: Path) -> Path:
    """Write photos on a circle into a folder with an odd name, in the format of Instant NGP. Returns the folder."""
    capture = folder / ODD
    frames = []
    for k in range(PHOTOS):
        name = f"images/{k}{ODD}.png"
        write_photo(capture / name, seed=k)
        frames.append({"file_path": name, "transform_matrix": orbit_pose(k * 2 * np.pi / PHOTOS).tolist()})
    document = {"camera_angle_x": 0.7, "w": 24, "h": 16, "frames": frames}
    (capture / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    return capture


def assert_printable(text: str) -> None:
    """Check that a text of several lines can be written anywhere, and that no name in it broke a line."""
    text.encode()
    for line in text.split("\n"):
        assert not UNPRINTABLE.search(line), repr(line)
