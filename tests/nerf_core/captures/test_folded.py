"""A thing with two sides that look alike is noticed, and its photos are then matched in their order alone."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nerf_core.captures.sfm_program import PAIR_BASE, STRONG, _folded

COUNT = 6


def model(angles: list[float]) -> SimpleNamespace:
    """A model whose photos look in these directions around the z axis, in degrees."""
    images = {}
    for k, angle in enumerate(np.radians(angles)):
        pose = np.eye(3, 4)
        pose[2, :3] = np.cos(angle), np.sin(angle), 0.0
        images[k] = SimpleNamespace(name=f"0/{k}.jpg", has_pose=True, cam_from_world=lambda p=pose: SimpleNamespace(matrix=lambda: p))  # fmt: skip  # noqa: E501
    return SimpleNamespace(images=images)


@pytest.mark.parametrize(
    ("angles", "matches", "folded"),
    [
        ([0, 20, 40, 60, 80, 100], STRONG, False),
        ([0, 20, 40, 240, 260, 280], STRONG, True),  # it jumps to the other side
        ([0, 20, 40, 240, 260, 280], STRONG - 1, False),  # so few matches may be chance
    ],
)
def test_a_jump_between_photos_that_match_is_noticed(
    angles: list[float], matches: int, folded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    base = sqlite3.connect("database.db")
    base.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
    base.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)")
    base.executemany("INSERT INTO images VALUES (?, ?)", [(k + 1, f"0/{k}.jpg") for k in range(COUNT)])
    pairs = [((k + 1) * PAIR_BASE + k + 2, matches) for k in range(COUNT - 1)]
    base.executemany("INSERT INTO two_view_geometries VALUES (?, ?)", pairs)
    base.commit()
    base.close()
    assert _folded(model(angles), {"copies": [f"0/{k}.jpg" for k in range(COUNT)]}) == folded
