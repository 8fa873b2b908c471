"""Videos decode to what was written, and a failed one leaves nothing."""

from __future__ import annotations

import os
import re
import resource
import stat
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from films import decoded
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.rendering.video import VideoWriter, write_png


def frames(count: int, height: int, width: int) -> np.ndarray:
    """Smooth pictures, told apart by their brightness: H.264 keeps them almost exactly."""
    ramp = np.linspace(40, 160, width)[None, None, :, None] * np.ones((count, height, 1, 3))
    return (ramp + 10 * np.arange(count)[:, None, None, None] * [1, 0.5, 0]).astype(np.uint8)


def described(path: Path) -> str:
    """What ffmpeg says of a file."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False).stderr


@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 21), (64, 21), (1, 1)])
def test_decodes_to_what_was_written(tmp_path: Path, width: int, height: int) -> None:
    path = tmp_path / "made" / "a film ü.mp4"
    written = frames(7, height, width)
    with VideoWriter(path, 24, width, height) as video:
        for frame in written:
            video.add(frame)
    assert os.listdir(path.parent) == [path.name]
    padded = np.pad(written, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    read = decoded(path, *padded.shape[1:3])
    assert read.shape == padded.shape
    assert np.abs(read.astype(int) - padded).mean() < 3
    text = described(path)
    assert "h264" in text
    assert "yuv420p(tv, bt709" in text
    assert re.search(rf"\b{padded.shape[2]}x{padded.shape[1]}\b.* 24 fps", text)


def test_colours_survive(tmp_path: Path) -> None:
    """BT.601 read as BT.709 would move pure colours by tens of levels."""
    colours = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [128, 128, 128]], np.uint8)
    frame = np.repeat(np.repeat(colours[None], 32, 0), 32, 1)
    with VideoWriter(tmp_path / "c.mp4", 30, 128, 32) as video:
        video.add(frame)
    read = decoded(tmp_path / "c.mp4", 32, 128)[0]
    assert np.abs(read[16, 16::32].astype(int) - colours).max() <= 6


def test_fractional_rate(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "f.mp4", 30000 / 1001, 16, 16) as video:
        for frame in frames(3, 16, 16):
            video.add(frame)
    assert "29.97 fps" in described(tmp_path / "f.mp4")


def test_permissions_are_those_of_any_file(tmp_path: Path) -> None:
    (tmp_path / "other").touch()
    write_png(tmp_path / "p.png", np.zeros((2, 2, 3), np.uint8))
    assert stat.S_IMODE((tmp_path / "p.png").stat().st_mode) == stat.S_IMODE((tmp_path / "other").stat().st_mode)


def test_abort_and_exception_leave_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(b"old")
    video = VideoWriter(path, 30, 16, 16)
    video.add(frames(1, 16, 16)[0])
    video.abort()
    video.abort()
    with pytest.raises(ZeroDivisionError), VideoWriter(path, 30, 16, 16) as video:
        video.add(frames(1, 16, 16)[0] // (1 // 0))
    assert os.listdir(tmp_path) == ["v.mp4"]
    assert path.read_bytes() == b"old"


def test_abort_after_close_keeps_the_video(tmp_path: Path) -> None:
    video = VideoWriter(tmp_path / "v.mp4", 30, 16, 16)
    video.add(frames(1, 16, 16)[0])
    video.close()
    video.abort()
    assert (tmp_path / "v.mp4").stat().st_size > 0
    with pytest.raises(ValueError, match="closed"):
        video.add(frames(1, 16, 16)[0])


def test_no_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"v\.mp4: it has no frames"):
        VideoWriter(tmp_path / "v.mp4", 30, 16, 16).close()
    assert os.listdir(tmp_path) == []


def test_full_disk(tmp_path: Path) -> None:
    """A limit on file sizes ends ffmpeg in the middle of a frame, as a full disk does."""
    path = tmp_path / "v.mp4"
    path.write_bytes(b"old")
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, old[1]))
    try:
        video = VideoWriter(path, 30, 256, 256)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    noise = np.random.default_rng(0).integers(0, 256, (100, 256, 256, 3), dtype=np.uint8)

    def encode() -> None:
        with video:
            for frame in noise:
                video.add(frame)

    with pytest.raises(UserError, match=r"cannot write .*v\.mp4: ffmpeg .*disk full"):
        encode()
    assert os.listdir(tmp_path) == ["v.mp4"]
    assert path.read_bytes() == b"old"


def test_target_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").mkdir()
    with pytest.raises(UserError, match=r"cannot write .*v\.mp4"), VideoWriter(tmp_path / "v.mp4", 30, 16, 16) as video:
        video.add(frames(1, 16, 16)[0])
    with pytest.raises(UserError, match=r"cannot write .*v\.mp4"):
        write_png(tmp_path / "v.mp4", np.zeros((2, 2, 3), np.uint8))
    assert os.listdir(tmp_path) == ["v.mp4"]


def test_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "v.mp4", Path("/proc/v.mp4")):
        with pytest.raises(UserError, match=r"cannot write .*v\.mp4: .*; choose a folder"):
            VideoWriter(path, 30, 16, 16)


@pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf")])
def test_impossible_rate(tmp_path: Path, fps: float) -> None:
    with pytest.raises(UserError, match="frames a second"):
        VideoWriter(tmp_path / "v.mp4", fps, 16, 16)


@pytest.mark.parametrize("exe", ["/nowhere/ffmpeg", "/dev/null"])
def test_broken_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exe: str) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", exe)
    with pytest.raises(UserError, match=rf"cannot start {exe}"):
        VideoWriter(tmp_path / "v.mp4", 30, 16, 16)
    assert os.listdir(tmp_path) == []


def test_wrong_frame(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="uint8"), VideoWriter(tmp_path / "v.mp4", 30, 16, 16) as video:
        video.add(np.zeros((16, 17, 3), np.uint8))
    with pytest.raises(ValueError, match="float64"):
        write_png(tmp_path / "p.png", np.zeros((2, 2, 3)))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("channels", [3, 4])
def test_png_is_exact(tmp_path: Path, channels: int) -> None:
    image = np.random.default_rng(1).integers(0, 256, (5, 7, channels), dtype=np.uint8)
    write_png(tmp_path / "frames" / "p.png", image)
    with Image.open(tmp_path / "frames" / "p.png") as read:
        np.testing.assert_array_equal(np.asarray(read), image)
    assert os.listdir(tmp_path / "frames") == ["p.png"]
