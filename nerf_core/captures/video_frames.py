"""Choose the frames of a video that structure from motion needs: sharp ones, with the camera moved in between."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.common.language import marked
from nerf_core.common.text import counted

SMALL = 192  # the longer side of the frames that are looked at: motion and blur show at this size
PER_SECOND, FEWEST, MOST = 3.0, 30, 120  # frames that are taken: as many as fit the time, between these bounds
LEAST_TILE = 8  # pixels: a narrower picture shows no motion
STILL = 0.004  # of the picture's side: a smaller motion between two frames is noise
LONGEST = 3600.0  # seconds of video
LOOKING, WRITING = marked("looking at frames"), marked("writing frames")
QUALITY = 95  # of JPEG: its artefacts are then below SIFT's noise


@dataclass(frozen=True)
class Looked:
    """What is known of each of N frames. sharpness: (N,). path: (N,) how far the picture has moved since the first."""

    sharpness: np.ndarray
    path: np.ndarray


def write_frames(video: Path, folder: Path, count: int, progress: Callable[[str, int, int], None]) -> tuple[Path, ...]:
    """Write the chosen frames of a video as JPEG.

    Args:
        video: any that ffmpeg reads; it is turned upright.
        folder: where the files go; it must exist.
        count: how many frames; 0 chooses by the video's length.
        progress: called as (what is done, frames done, frames in all); it may raise to cancel.

    Returns:
        The files, in the order of the video.

    Raises:
        UserError: if the video cannot be read, or shows too little.
    """
    looked, seconds = _look(video, progress)
    if len(looked.path) < 2:
        raise UserError(
            f"{video} has {counted(len(looked.path), 'frame')}: photograph from many sides, or film while walking"
        )
    wanted = count or int(np.clip(round(PER_SECOND * seconds), FEWEST, MOST))
    chosen = choose(looked, wanted)
    files: list[Path] = []
    for k, frame in enumerate(_frames(video, True, None)):
        if k in chosen:
            files.append(folder / f"frame_{k:06d}.jpg")
            Image.fromarray(frame).save(files[-1], quality=QUALITY, subsampling=0)
            progress(WRITING, len(files), len(chosen))
    return tuple(files)


def choose(looked: Looked, count: int) -> set[int]:
    """Choose `count` frames at most: evenly along the picture's motion, the sharpest in each part.

    Where the camera stands still the path does not grow, so that it gives one frame however long it stands.
    """
    end = float(looked.path[-1])
    if end <= 0:
        return {int(looked.sharpness.argmax())}
    part = np.minimum((looked.path / end * count).astype(int), count - 1)
    chosen = set[int]()
    for k in range(count):
        members = np.flatnonzero(part == k)
        if len(members):
            chosen.add(int(members[looked.sharpness[members].argmax()]))
    return chosen


def _look(video: Path, progress: Callable[[str, int, int], None]) -> tuple[Looked, float]:
    total, seconds = _length(video)
    if seconds > LONGEST:
        raise UserError(f"{video} is {seconds / 60:,.0f} minutes long, {LONGEST / 60:.0f} are allowed: cut it")
    sharpness, path = list[float](), list[float]()
    kept: np.ndarray | None = None  # the last frame that had moved: slow motion adds up until it shows
    for k, frame in enumerate(_frames(video, False, SMALL)):
        picture = frame.astype(np.float32)
        sharpness.append(_sharpness(picture))
        moved = 0.0 if kept is None else motion(kept, picture)
        path.append((path[-1] if path else 0.0) + (moved if moved > STILL else 0.0))
        if kept is None or moved > STILL:
            kept = picture
        if k % 10 == 0:
            progress(LOOKING, min(k, total), max(total, 1))
    return Looked(np.array(sharpness), np.array(path)), seconds or len(sharpness) / 30.0


def _sharpness(picture: np.ndarray) -> float:
    """The variance of the Laplacian (Pech-Pacheco et al., ICPR 2000)."""
    inner = picture[1:-1, 1:-1]
    laplacian = picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def motion(a: np.ndarray, b: np.ndarray) -> float:
    """How far the content has moved between two pictures (H, W), as a share of the longer side.

    The median over 3 × 3 tiles of the shift with the best phase correlation (Kuglin and Hines, 1975).
    """
    high, wide = (side // 3 for side in a.shape)
    if min(high, wide) < LEAST_TILE:
        return 0.0
    window = np.outer(np.hanning(high), np.hanning(wide))
    shifts = []
    for y in range(3):
        for x in range(3):
            part = np.s_[y * high : (y + 1) * high, x * wide : (x + 1) * wide]
            spectra = [np.fft.rfft2((v[part] - v[part].mean()) * window) for v in (a, b)]
            cross = spectra[0] * spectra[1].conj()
            peak = np.fft.irfft2(cross / (np.abs(cross) + 1e-6), s=(high, wide))  # 1e-6: a tile without texture
            dy, dx = np.unravel_index(int(peak.argmax()), peak.shape)
            shifts.append(np.hypot(min(dy, high - dy), min(dx, wide - dx)))
    return float(np.median(shifts)) / max(a.shape)


def _length(video: Path) -> tuple[int, float]:
    """The number of frames and the seconds of a video. Raises UserError if it is none."""
    import imageio_ffmpeg

    try:
        frames, seconds = imageio_ffmpeg.count_frames_and_secs(f"file:{video.absolute()}")
        return int(frames or 0), float(seconds or 0.0)
    except (OSError, RuntimeError, ValueError, subprocess.SubprocessError) as error:
        raise UserError(
            f"{video} cannot be read as a video: it is damaged or has no pictures: copy it again, or convert it to MP4"
        ) from error


def _frames(video: Path, color: bool, side: int | None) -> Iterator[np.ndarray]:
    """The frames of a video, upright, uint8 (H, W, 3) or grey (H, W), of its size or with a longer side of `side`."""
    import imageio_ffmpeg

    # Each frame as a PPM or PGM file, which says its size. passthrough: each once, also where their times are uneven.
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-protocol_whitelist",
        "file",
        "-i",
        f"file:{video.absolute()}",
        "-an",
    ]
    command += ["-fps_mode", "passthrough", "-f", "image2pipe", "-vcodec", "ppm" if color else "pgm"]
    command += ["-pix_fmt", "rgb24" if color else "gray"]  # 10 bits, as phones film in HDR, become 8
    command += [] if side is None else ["-vf", f"scale={side}:{side}:force_original_aspect_ratio=decrease"]
    command += ["-"]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert child.stdout is not None
    try:
        while (head := child.stdout.readline()) in (b"P5\n", b"P6\n"):
            width, height = map(int, child.stdout.readline().split())
            assert child.stdout.readline() == b"255\n"  # the largest value
            channels = 3 if head == b"P6\n" else 1
            data = child.stdout.read(width * height * channels)
            if len(data) < width * height * channels:
                return  # the video breaks off here
            yield np.frombuffer(data, np.uint8).reshape((height, width, 3) if channels == 3 else (height, width))
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
