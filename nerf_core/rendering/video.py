"""Write videos and pictures completely or not at all.

A file is written beside the target and then moved into its place.
"""

from __future__ import annotations

import math
import os
import subprocess
import tempfile
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import claim_part, replacing, unwritable

CRF = 18  # libx264's constant quality: from about 18 down, the eye cannot tell the video from its source
# By default, ffmpeg converts with BT.601 and does not tag the file. Players assume BT.709 for HD: colours would shift.
BT709 = (
    "-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709",
    "-color_trc", "bt709", "-color_range", "tv",
)  # fmt: skip


class VideoWriter:
    """Writes an H.264 MP4 (yuv420p) frame by frame. `path` changes only when `close` succeeds.

    As a context manager, it closes the video at the end and aborts it if an exception is raised.
    """

    def __init__(self, path: Path, fps: float, width: int, height: int) -> None:
        """Start ffmpeg.

        Args:
            path: the file to write.
            fps: frames per second.
            width, height: size of the frames in pixels. yuv420p needs even sizes: an odd size gets one more pixel at
                the right or bottom, which repeats the edge. Frames are never rescaled.

        Raises:
            UserError: `fps` is not positive, the folder cannot be written, or ffmpeg is missing.
        """
        if not 0 < fps < math.inf:
            raise UserError(f"a video of {fps:g} frames a second cannot be played: take a positive number")
        self.path = path
        self._shape = (height, width, 3)
        self._padding = ((0, height % 2), (0, width % 2), (0, 0))
        ffmpeg = _ffmpeg()
        self._part = claim_part(path)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  no pipe: a full one would block ffmpeg
        size = f"{width + width % 2}x{height + height % 2}"
        rate = str(Fraction(fps).limit_denominator())
        source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-")
        target = ("-c:v", "libx264", "-crf", str(CRF), "-pix_fmt", "yuv420p", "-f", "mp4", str(self._part.path))
        try:
            self._process = subprocess.Popen(
                [ffmpeg, "-y", "-v", "error", *source, *BT709, *target],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                bufsize=0,
                start_new_session=True,  # Ctrl-C reaches the program alone, which then closes or aborts the video
            )
        except OSError as error:
            self._clean()
            raise UserError(f"{path}: cannot start {ffmpeg} ({error.strerror}): reinstall imageio-ffmpeg") from error
        self._open, self._empty = True, True

    def add(self, frame: np.ndarray) -> None:
        """Append a frame. This waits while ffmpeg is busy.

        Args:
            frame: (height, width, 3) uint8, sRGB-encoded.

        Raises:
            ValueError: the frame has another shape or type, or the video is closed.
            UserError: ffmpeg failed.
        """
        if not self._open:
            raise ValueError(f"the video {self.path} is closed")
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(f"a frame of {self.path} is {frame.dtype} {frame.shape}, not uint8 {self._shape}")
        data = memoryview(np.pad(frame, self._padding, mode="edge").tobytes())
        assert self._process.stdin is not None
        try:
            while data:  # an unbuffered pipe may take only a part
                data = data[self._process.stdin.write(data) :]
        except OSError as error:  # a broken pipe: ffmpeg has ended, and its log says why
            raise self._failure() from error
        self._empty = False

    def close(self) -> None:
        """Finish the video and move it to `path`. Raises UserError if this fails; an old file then stays."""
        if not self._open:
            return
        if self._empty:
            self.abort()
            raise UserError(f"cannot write {self.path}: it has no frames; take a camera path of 1 or more")
        assert self._process.stdin is not None
        self._process.stdin.close()
        if self._process.wait() != 0:
            raise self._failure()
        try:
            os.replace(self._part.path, self.path)
        except OSError as error:
            self.abort()
            raise unwritable(self.path, error) from error
        self._open = False
        self._clean()

    def abort(self) -> None:
        """Stop and delete what was written. Does nothing after `close`."""
        if not self._open:
            return
        self._open = False
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._clean()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _failure(self) -> UserError:
        """Clean up after ffmpeg failed. Returns the error with ffmpeg's reason."""
        status = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        self.abort()
        reason = shorten(lines[-1], 160) if lines else f"exit status {status}"
        return UserError(f"cannot write {self.path}: ffmpeg says {reason}; is the disk full?")

    def _clean(self) -> None:
        self._log.close()
        self._part.release()


def write_png(path: Path, array: np.ndarray) -> None:
    """Write a PNG completely or not at all.

    Args:
        path: the file.
        array: (H, W, 3) or (H, W, 4) uint8, sRGB-encoded.

    Raises:
        UserError: the file cannot be written.
        ValueError: the array has another shape or type.
    """
    from PIL import Image

    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (3, 4):
        raise ValueError(f"a picture is uint8 (H, W, 3) or (H, W, 4), not {array.dtype} {array.shape}")
    with replacing(path) as part, part.open("wb") as file:
        Image.fromarray(array).save(file, format="PNG")


def _ffmpeg() -> str:
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise UserError("no ffmpeg was found, which writes the videos: pip install imageio-ffmpeg") from error
