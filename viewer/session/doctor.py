"""`nerf-viewer --doctor`: report what is installed, what is missing, and what to do about it."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from nerf_core.common.errors import UserError


def examine(say: Callable[[str], None]) -> bool:
    """Print one line per finding. Returns whether training and headless rendering both work."""
    say(f"Python      {platform.python_version()}, {platform.system()} {platform.machine()}")
    checks = (("training", _training), ("headless", _headless), ("window", _window), ("video", _video))
    results = {}
    for name, check in checks:
        try:
            lines, results[name] = check(), True
        except Exception as error:  # the doctor reports every error and goes on
            text = str(error).splitlines()[0] if str(error) else ""
            lines = [text if isinstance(error, UserError) else f"{type(error).__name__}: {text}"]
            results[name] = False
        for number, line in enumerate(lines):
            mark = "ok" if results[name] else "MISSING"
            say(f"{name if number == 0 else '':<11} {mark if number == 0 else '':<8}{line}")
    good = results["training"] and results["headless"]
    say("training and headless rendering work" if good else "training or headless rendering does not work: see above")
    return good


def _training() -> list[str]:
    """Make one real optimiser step on the demo scene with this machine's default method."""
    import torch

    from nerf_core.common.device import describe, fast_precision, pick_device, usable_cores
    from nerf_core.datasets import LoadOptions, load_scene
    from nerf_core.training.settings import RunSettings
    from nerf_core.training.trainer import Trainer

    scene = load_scene(None, LoadOptions(downscale=4))
    trainer = Trainer(scene, RunSettings())
    trainer.step()
    device = pick_device("auto")
    return [
        f"torch {torch.__version__}, {describe(device)}, {fast_precision(device)}",
        f"a step of {trainer.method_name} done",
        f"{usable_cores()} usable cores, CUDA {torch.version.cuda or 'not in this build'}",
    ]


def _headless() -> list[str]:
    from ..window.egl_window import EglWindow

    window = EglWindow((64, 64))
    try:
        info = window.context.info
        return [f"{info['GL_VENDOR']}, {info['GL_RENDERER']}", f"OpenGL {info['GL_VERSION']}"]
    finally:
        window.close()


def _window() -> list[str]:
    names = [f"{name}={os.environ[name]}" for name in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(name)]
    if sys.platform == "linux" and not names:
        raise UserError("no display (DISPLAY and WAYLAND_DISPLAY are unset): use --headless, or a desktop session")
    from ..window.glfw_window import GlfwWindow

    window = GlfwWindow("nerf-viewer", (64, 64), visible=False)
    try:
        return [f"{' '.join(names) or 'native'}, scale {window.scale():g}, {window.context.info['GL_RENDERER']}"]
    finally:
        window.close()


def _video() -> list[str]:
    import numpy as np

    from nerf_core.rendering.video import VideoWriter

    with tempfile.TemporaryDirectory() as folder, VideoWriter(Path(folder) / "a.mp4", 30, 16, 16) as writer:
        writer.add(np.zeros((16, 16, 3), np.uint8))
    import imageio_ffmpeg

    return [f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}, H.264"]
