"""Small real captures on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from captures import orbit_pose, write_photo

from nerf_core.datasets import DATASETS, LoadOptions

Document = dict[str, Any]
DATASETS.names()  # formats are imported here, not inside the first example that hypothesis measures


def write_json(file: Path, document: Document) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(document), encoding="utf-8")


def frames(names: list[str]) -> list[Document]:
    return [{"file_path": n, "transform_matrix": orbit_pose(0.3 + 0.5 * i).tolist()} for i, n in enumerate(names)]


@pytest.fixture(autouse=True)
def tiny_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let --downscale leave any pixel: photos here have 24×16, so that they are written quickly."""
    monkeypatch.setattr("nerf_core.datasets.loading.LEAST_SIDE", 1)


@pytest.fixture
def transforms_folder(tmp_path: Path) -> tuple[Path, Document]:
    """Ten photos of 24×16 with transforms.json: the folder, and its document to change and write again."""
    names = [f"images/{i:04}.png" for i in range(10)]
    for i, name in enumerate(names):
        write_photo(tmp_path / name, seed=i)
    document: Document = {"fl_x": 30.0, "fl_y": 31.0, "cx": 12.5, "cy": 7.5, "w": 24, "h": 16, "frames": frames(names)}
    write_json(tmp_path / "transforms.json", document)
    return tmp_path, document


@pytest.fixture
def blender_folder(tmp_path: Path) -> tuple[Path, dict[str, Document]]:
    """Blender's format with 4, 2 and 3 RGBA photos of 16×16: the folder, and its documents by split."""
    documents = {}
    for split, count in (("train", 4), ("val", 2), ("test", 3)):
        for i in range(count):
            write_photo(tmp_path / split / f"r_{i}.png", (16, 16), "RGBA", seed=i)
        documents[split] = {"camera_angle_x": 0.7, "frames": frames([f"./{split}/r_{i}" for i in range(count)])}
        write_json(tmp_path / f"transforms_{split}.json", documents[split])
    return tmp_path, documents


@pytest.fixture
def read_transforms(transforms_folder: tuple[Path, Document]) -> Callable[[Document], Any]:
    """Writes a changed document beside the ten photos and reads the capture."""

    def read(document: Document) -> Any:
        write_json(transforms_folder[0] / "transforms.json", document)
        return DATASETS.get("transforms").read(transforms_folder[0], LoadOptions())

    return read
