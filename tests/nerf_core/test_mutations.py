"""Changed captures and files of every kind are opened or refused with one line, within limits of time and memory."""

import pytest
from fuzzed_readers import readers
from fuzzing import Reader, run

from nerf_core.datasets import DATASETS

NAMES = [
    "PNG", "palette PNG", "16-bit PNG", "JPEG", "TIFF", "deflated TIFF", "WebP", "BMP", "EXR", "blender", "transforms",
    "transforms, fisheye", "transforms, panoramas", "masks", "llff", "colmap, text", "colmap, binary", "poses.json",
    "polycam", "record3d", "metashape", "realitycapture", "raw photos", "video", "checkpoint", "model", "camera file",
    "log.jsonl", "config.json",
]  # fmt: skip
TOLERANT = ("log.jsonl", "raw photos")  # damaged lines of a log are dropped, and damaged photos are left out
FEW = 40  # some 1,000 mutations together; tests/helpers/fuzzing.py makes as many as are asked for


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reader]:
    return readers(tmp_path_factory.mktemp("valid"))


def test_every_reader_is_fuzzed(fuzzed: dict[str, Reader]) -> None:
    assert list(fuzzed) == NAMES
    for kind in set(DATASETS.names()) - {"demo"}:  # which is installed, and nobody changes
        assert any(name.split(",")[0] == kind for name in NAMES), kind


@pytest.mark.parametrize("name", NAMES)
def test_changed_files(name: str, fuzzed: dict[str, Reader]) -> None:
    result = run(fuzzed[name], FEW)
    assert result.wrong == []
    assert result.opened + result.refused == result.done == -(-FEW // fuzzed[name].cost)
    assert result.refused > 0 or name in TOLERANT
