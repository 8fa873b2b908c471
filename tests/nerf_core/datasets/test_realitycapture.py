"""RealityCapture's table: what its angles mean, and wrong rows."""

from pathlib import Path

import numpy as np
import pytest
from captures import write_photo
from exports import HEADER, reality_text, write_realitycapture

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions, load_scene
from nerf_core.geometry.lens import Lens


def read(folder: Path, text: str | None = None) -> Capture:
    return DATASETS.get("realitycapture").read(write_realitycapture(folder, text).parent, LoadOptions())


@pytest.mark.parametrize(
    ("angles", "forward", "top"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),  # a drone that looks down, its photo's top to the north
        ((90, 0, 0), (0, 0, -1), (1, 0, 0)),  # the same, its top to the east
        ((0, 90, 0), (0, 1, 0), (0, 0, 1)),  # level, to the north
        ((90, 90, 0), (1, 0, 0), (0, 0, 1)),  # level, to the east
    ],
)
def test_angles_are_those_of_a_compass(
    tmp_path: Path, angles: tuple[float, ...], forward: tuple[float, ...], top: tuple[float, ...]
) -> None:
    heading, pitch, roll = angles
    c2w = read(tmp_path, reality_text(heading=heading, pitch=pitch, roll=roll)).photos[0].camera.c2w
    np.testing.assert_allclose(-c2w[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(c2w[:, 1], top, atol=1e-12)


def test_the_longer_side_counts_and_the_file_itself_is_read(tmp_path: Path) -> None:
    file = write_realitycapture(tmp_path, "#cameras,4\n" + reality_text())
    write_photo(tmp_path / "images/a_0.png", (16, 24))
    camera = DATASETS.get("realitycapture").read(file, LoadOptions()).photos[0].camera
    assert camera.intrinsics()[:6] == pytest.approx((16, 24, 30, 30, 8.5, 11.5))
    assert camera.lens == Lens(-0.02, 0.01, -0.003)
    assert load_scene(file, LoadOptions()).format == "realitycapture"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (HEADER, "has no rows"),
        (HEADER.replace(",k3", ""), "has no column k3"),
        (HEADER + "\na,1,2", "line 2 has 3 values, 16 are needed"),
        (reality_text(f="x"), "line 2: f is 'x': a number"),
        (reality_text(x="inf"), "line 2: x is 'inf': a number"),
        (reality_text(x="1_0"), "line 2: x is '1_0': a number"),
        (reality_text(f="0"), "focal length 0"),
        (reality_text(k4="0.1"), "k4 = 0.1, which is not known"),
        (reality_text(t1="0.1"), "t1 = 0.1, which is not known"),
        (HEADER + "\n" + "a" * 200_000, "no CSV .*field larger"),
        (reality_text(**{"#name": "/dev/null"}), "a device or a pipe"),
    ],
)  # fmt: skip
def test_wrong_rows_are_named(tmp_path: Path, text: str, error: str) -> None:
    with pytest.raises(UserError, match=rf"poses\.csv.*{error}") as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)
