"""Changed files of every kind are accepted or refused with one line, within limits of time and memory."""

from pathlib import Path

import pytest
from fuzzed_readers import readers
from fuzzing import MEGABYTES, SECONDS, run

NAMES = [
    "PNG", "palette PNG", "16-bit PNG", "JPEG", "TIFF", "deflated TIFF", "WebP", "BMP", "EXR",
    "transforms JSON", "blender JSON", "polycam file", "record3d file", "metashape file", "realitycapture file",
    "LLFF table", "COLMAP cameras.txt", "COLMAP images.txt", "COLMAP points3D.txt",
    "COLMAP cameras.bin", "COLMAP images.bin", "COLMAP points3D.bin", "checkpoint", "model", "camera file", "log.jsonl",
    "config.json",
]  # fmt: skip
# Damaged lines of a log are dropped, and COLMAP's own reader, a process, refuses what the check before it lets pass.
TOLERANT = ("log.jsonl", "COLMAP cameras.txt", "COLMAP points3D.txt")


@pytest.mark.filterwarnings("ignore::UserWarning:PIL.TiffImagePlugin")  # as in `images`: odd tags are no damage
@pytest.mark.parametrize("name", NAMES)
def test_changed_files(tmp_path: Path, name: str) -> None:
    found = readers(tmp_path)
    assert list(found) == NAMES
    result = run(found[name], 300)
    assert result.broken == []
    assert result.accepted + result.refused == 300
    assert result.refused > 0 or name in TOLERANT
    assert result.seconds < SECONDS
    assert result.megabytes < MEGABYTES
