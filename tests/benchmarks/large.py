"""Open a capture of 10,000 photos of 12 megapixels in a window, and measure what that takes.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/large.py

The capture is made in a temporary folder: some different JPEGs of 3 to 4 MB, hard-linked under many names, and a
transforms.json with a camera each. So the disk holds few bytes, which lie in memory when they are decoded; a real
capture is read from the disk as well. The cache is a temporary folder, too. Prints

- how long opening can be cancelled after a second of it,
- the time until the scene is open, until the first picture of the model, and how many photos were read at the end,
- the frame times of the window meanwhile: while it opens, while it trains, and with all cameras shown,
- the memory of the process: what the kernel cannot take back (anonymous), and pages of the cache file, which it can,
- what the cache takes on the disk, and the load of the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from window import _print_times, _Stopwatch, _window

from nerf_core.common import cache
from nerf_core.common.text import size
from nerf_core.datasets.capture import LoadOptions
from nerf_core.live.messages import CancelLoading, OpenScene
from nerf_core.live.worker import Worker
from nerf_core.training.settings import RunSettings
from viewer.app.app import App

KINDS = 24  # different photos
SIZE = 4000, 3000
OCTAVES = ((8, 60), (32, 40), (128, 30), (512, 22), (2000, 12))  # pixels across and amplitude: like a photo's spectrum


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=60.0, help="of training in the window")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="make the capture and its cache here, or find them again")
    parser.add_argument("--offscreen", action="store_true", help="draw through EGL instead of in a window")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        home = args.keep or Path(scratch)
        if not (home / "capture" / "transforms.json").exists():
            make_capture(home / "capture", args.photos)
        cache.cache_folder = lambda: home / "cache"
        measure(home / "capture", LoadOptions(downscale=args.downscale), args.seconds, args.offscreen)


def make_capture(folder: Path, count: int) -> None:
    """Write KINDS photos under `count` names, on a spiral around a ball."""
    (folder / "kinds").mkdir(parents=True)
    (folder / "images").mkdir()
    width, height = SIZE
    for kind in range(KINDS):
        rng, picture = np.random.default_rng(kind), np.full((height, width, 3), 120, np.float32)
        for across, amplitude in OCTAVES:
            coarse = Image.fromarray(rng.integers(0, 256, (across * height // width, across, 3), dtype=np.uint8))
            fine = np.asarray(coarse.resize(SIZE, Image.Resampling.BICUBIC), np.float32)
            picture += (fine - 128) / 128 * amplitude
        picture += rng.normal(0, 3, (height, width, 1))  # a sensor's noise, of which JPEG keeps some
        Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(folder / "kinds" / f"{kind}.jpg", quality=92)
    frames = []
    for i in range(count):
        name, turn, z = f"images/{i:05d}.jpg", 2 * np.pi * i / 200, -0.8 + 1.6 * i / count
        os.link(folder / "kinds" / f"{i * 7 % KINDS}.jpg", folder / name)
        back = np.array([np.cos(turn) * np.sqrt(1 - z * z), np.sin(turn) * np.sqrt(1 - z * z), z])
        right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(back, right), back, 4 * back])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"w": width, "h": height, "fl_x": 3200.0, "fl_y": 3200.0, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


def measure(folder: Path, load: LoadOptions, seconds: float, offscreen: bool) -> None:
    settings = RunSettings(load=load)
    window = _window(offscreen)
    worker = Worker(settings, wake=window.wake)
    worker.start()
    link = _Stopwatch(worker)
    app = App(window, link)
    peaks = {"RssAnon": 0, "RssFile": 0}

    def until(done: Callable[[], bool], most: float = 1e9) -> float:
        begin = time.perf_counter()
        while not done() and time.perf_counter() - begin < most:
            turn = time.perf_counter() + 0.05
            app.run(lambda turn=turn: time.perf_counter() > turn)
            held = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text("ascii").splitlines())
            for name, peak in peaks.items():
                peaks[name] = max(peak, 1024 * int(held[name].split()[0]))
        return time.perf_counter() - begin

    until(lambda: worker.snapshot().status == "empty" and len(link.frames) > 5)
    link.frames.clear()
    worker.send(OpenScene(folder, settings, train=True))
    until(lambda: False, 1.0)
    worker.send(CancelLoading())
    print(f"cancelled after {1e3 * until(lambda: not worker.snapshot().loading):.0f} ms")
    worker.send(OpenScene(folder, settings, train=True))
    print(f"opened after {(opened := until(lambda: worker.snapshot().scene is not None)):.1f} s")
    _print_times("frames while it opens", link.frames)
    print(f"memory then: {', '.join(f'{name} {size(peak)}' for name, peak in peaks.items())}")
    link.frames.clear()
    print(f"first picture after {opened + until(lambda: worker.snapshot().preview is not None):.1f} s")
    until(lambda: False, seconds)
    _print_times("frames while it trains", link.frames)
    link.frames.clear()
    app.state.show_cameras = True
    until(lambda: False, 10)
    _print_times("frames with cameras", link.frames)
    snapshot = worker.snapshot()
    assert snapshot.scene is not None
    print("\n".join(snapshot.scene.notes))
    print(f"step {snapshot.step}, photos read: {snapshot.scene.photos.reading()}")
    print(f"peaks: {', '.join(f'{name} {size(peak)}' for name, peak in peaks.items())}")
    print(f"cache on the disk: {size(sum(entry.bytes for entry in cache.entries()))}; load {os.getloadavg()[0]:.1f}")
    app.close()
    worker.stop()
    window.close()


if __name__ == "__main__":
    main()
