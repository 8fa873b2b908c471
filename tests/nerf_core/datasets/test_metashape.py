"""Metashape's cameras: its own lens formulas, kinds of sensors, components, and XML that is no calibration."""

import math
from pathlib import Path

import numpy as np
import pytest
from exports import COUNT, metashape_text, write_metashape

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, Capture, LoadOptions, load_scene
from nerf_core.geometry.lens import EQUIRECTANGULAR, FISHEYE, Lens


def read(folder: Path, text: str | None = None) -> Capture:
    return DATASETS.get("metashape").read(write_metashape(folder, text).parent, LoadOptions())


def test_points_are_projected_as_the_manual_says(tmp_path: Path) -> None:
    camera = read(tmp_path).photos[0].camera
    local = np.random.default_rng(0).uniform([-0.3, -0.2, 1], [0.3, 0.2, 2], (100, 3))  # y down, z forward
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k1, k2, k3, p1, p2, f, b1 = -0.02, 0.01, -0.003, 0.001, -0.002, 31.0, -1.0
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    bent_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    expected = np.stack([12 + 0.5 + bent_x * (f + b1), 8 - 0.5 + bent_y * f], -1)
    world = (local * (1, -1, -1)) @ camera.c2w[:, :3].T + camera.c2w[:, 3]
    np.testing.assert_allclose(camera.project(world)[0], expected, atol=1e-9)


def test_fisheye_and_spherical_sensors(tmp_path: Path) -> None:
    fisheye = metashape_text('type="fisheye"', "<k4>0.1</k4>").replace("<p1>0.001</p1><p2>-0.002</p2>", "")
    assert read(tmp_path, fisheye).photos[0].camera.lens == Lens(-0.02, 0.01, -0.003, k4=0.1, kind=FISHEYE)
    spherical = metashape_text('type="spherical"')
    begin, end = spherical.index("<calibration"), spherical.index("</sensor>")
    camera = read(tmp_path, spherical[:begin] + spherical[end:]).photos[0].camera
    assert camera.intrinsics() == pytest.approx((24, 16, 12 / math.pi, 16 / math.pi, 12, 8, *[0] * 8, EQUIRECTANGULAR))


def test_the_file_itself_and_a_chunk_without_component_are_read(tmp_path: Path) -> None:
    text = metashape_text()
    begin, end = text.index("<components"), text.index("</components>") + len("</components>")
    inner = text[text.index("<transform><rotation") : text.index("</component>")]
    moved = text[:begin] + inner + text[end:]
    whole, chunk = (load_scene(write_metashape(tmp_path, t), LoadOptions()) for t in (text, moved))
    np.testing.assert_array_equal(whole.poses, chunk.poses)
    bare = read(tmp_path, text[:begin] + text[end:])
    assert np.linalg.norm(bare.photos[0].camera.c2w[:, 3] - whole.poses[0, :, 3]) > 1


def test_cameras_without_a_pose_are_left_out(tmp_path: Path) -> None:
    more = (
        '<group label="g"><camera id="7" sensor_id="0" component_id="0" label="DJI_0009.JPG"/></group>'
        '<camera id="8" sensor_id="0" component_id="3" label="DJI_0003.JPG"><transform>1</transform></camera>'
    )
    capture = read(tmp_path, metashape_text(cameras=more))
    assert len(capture.photos) == COUNT
    assert f"{COUNT + 2 - 4} of {COUNT + 2} cameras left out" in capture.notes[0]


LAUGHS = '<!DOCTYPE d [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
OUTSIDE = '<!DOCTYPE d [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("<document", LAUGHS + "<document", "declares a document type"),
        ("<document", OUTSIDE + "<document", "declares a document type"),
        ("<cameras>", "<cameras>&a;", "no XML at line 3 .undefined entity"),
        ("</sensors>", "", "no XML at line 3 .mismatched tag"),
        ("<cameras>", "<a>" * 200, "nested too deeply"),
        ("<k1>-0.02</k1>", "<k4>0.1</k4>", "has k4 = 0.1, which is not known"),
        ("<k1>-0.02</k1>", "<b2>0.1</b2>", "has b2 = 0.1, which is not known"),
        ("<k1>-0.02</k1>", "<k1>nan</k1>", "k1 is 'nan': a number"),
        ("<f>31</f>", "", "focal length -1"),
        ("<f>31</f>", "<f>x</f>", "f is 'x': a number"),
        ('type="frame"', 'type="cylindrical"', "type 'cylindrical'; known are frame"),
        ('width="24"', "", "width is None: a number"),
        ('width="24"', 'width="0.5"', "no resolution of whole pixels"),
        ('sensor_id="0"', 'sensor_id="5"', "sensor '5', which is not in the file"),
        ('label="DJI_0000.JPG"', "", "a camera has no label"),
        ("<scale>2.5", "<scale>0", "scale 0: a number above 0"),
        ("<translation>100.0 ", "<translation>", "translation is .*3 numbers are needed"),
        ("<rotation locked=\"true\">0.0", "<rotation locked=\"true\">1.0", "sheared, singular or mirrored"),
        ("<transform>", "<transform>1 ", "transform is .*16 numbers"),
        ("<transform>", "<nothing>", "mismatched tag"),
        ("encoding=\"UTF-8\"", "encoding=\"KOI-7\"", "no XML"),
    ],
)  # fmt: skip
def test_wrong_files_are_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    with pytest.raises(UserError, match=rf"cameras\.xml.*{text}") as caught:
        read(tmp_path, metashape_text().replace(old, new))
    assert "\n" not in str(caught.value)
