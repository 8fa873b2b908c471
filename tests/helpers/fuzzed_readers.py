"""A valid file of every kind, and what reads it, for `fuzzing.py`; the captures are in `fuzzed_captures.py`."""

from __future__ import annotations

import json
import random
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import torch
from captures import orbit_pose
from changes import mutated, other_values
from fuzzed_captures import captures
from fuzzing import Reader
from PIL import Image
from safetensors.torch import save
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.images import measure, read_photo
from nerf_core.geometry.camera_files import camera_values, picked_camera
from nerf_core.geometry.scene import Scene
from nerf_core.live import pin_files
from nerf_core.training import checkpoint
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Trainer

OLD_RUN = Path(__file__).parents[1] / "fixtures" / "before_packages" / "voxels"


def readers(base: Path) -> dict[str, Reader]:
    """Write one valid file of every kind into `base`. Returns {name: reader}."""
    found: dict[str, Reader] = {}
    pixels = np.random.default_rng(0).integers(0, 256, (16, 24, 3), dtype=np.uint8)

    def photo(name: str, suffix: str, image: Image.Image, **options: Any) -> None:
        file = base / f"{name}.{suffix}"
        image.save(file, **options)

        def work() -> None:
            header = measure(file)
            read_photo(file, (min(8, header.width), min(8, header.height)), (0, 0, 0))

        # a changed header may claim a larger picture, which is then decoded
        found[name] = Reader(file, work, megabytes=1000)

    image = Image.fromarray(pixels)
    photo("PNG", "png", image)
    photo("palette PNG", "png", image.quantize(16))
    photo("16-bit PNG", "png", Image.fromarray(pixels[..., 0].astype(np.uint16) * 200))
    photo("JPEG", "jpg", image)
    photo("TIFF", "tif", image)
    photo("deflated TIFF", "tif", image, compression="tiff_deflate")
    photo("WebP", "webp", image)
    photo("BMP", "bmp", image)
    found["EXR"] = _exr(base / "a.exr", pixels)

    found |= captures(base)
    saved = base / "run.safetensors"
    described = {name: kind() for name, (kind, _) in checkpoint.REQUIRED.items()}
    checkpoint.save(saved, described, {"weights": torch.zeros(8, 8), "more": torch.zeros(3)})
    found["checkpoint"] = Reader(saved, lambda: checkpoint.load(saved))

    scene = load_scene(None, LoadOptions(max_size=16))
    found["model"] = _model(base / "model.safetensors", scene)
    found["camera file"] = _camera_file(base / "camera.json", scene)
    folder = base / "run"
    folder.mkdir()
    log = RunFolder(folder)
    log.log_file.write_text("".join(f'{{"step": {k}, "loss": 0.5}}\n' for k in range(20)))
    found["log.jsonl"] = Reader(log.log_file, lambda: log.rewind(10))
    log.config_file.write_bytes((OLD_RUN / "config.json").read_bytes())
    found["config.json"] = Reader(log.config_file, log.config)
    return found


def _exr(file: Path, pixels: np.ndarray) -> Reader:
    """A half-float EXR with runs of equal bytes, which is how ffmpeg compresses it."""
    height, width, _ = pixels.shape
    planes = (pixels[..., [1, 2, 0]].transpose(2, 0, 1) / np.float32(255)).astype(np.float32)
    command = f"-v error -y -f rawvideo -pix_fmt gbrpf32le -s {width}x{height} -i - -frames:v 1 -compression rle"
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *command.split(), str(file)], input=planes.tobytes(), check=True)

    def work() -> None:
        header = measure(file)
        read_photo(file, (min(8, header.width), min(8, header.height)), (0, 0, 0))

    return Reader(file, work, cost=4)


def _camera_file(file: Path, scene: Scene) -> Reader:
    camera = {"width": 24, "height": 16, "fx": 30.0, "fy": 30.0, "cx": 12.0, "cy": 8.0}
    file.write_text(json.dumps({"c2w": orbit_pose(0.5)[:3].tolist()} | camera))
    return Reader(file, lambda: picked_camera(scene, str(file)))


def _model(file: Path, scene: Scene) -> Reader:
    """A checkpoint with a pinned ray, whose changes carry the right checksum: a stranger's file, not a damaged one."""
    _, description, tensors, _ = checkpoint.newest(OLD_RUN)
    camera = camera_values(scene.views[0].camera)
    pin = {"name": "a", "color": 0, "hidden": False, "pixel": [5, 6], "camera": camera}
    history = {
        name: torch.zeros([2 if n == pin_files.N else n for n in shape]) for name, shape in pin_files.SHAPES.items()
    }
    history |= {"edges": torch.arange(float(len(history["edges"]))), "steps": torch.tensor([3, 9])}
    description |= {"session": {"pins": [pin]}, pin_files.FIELD: [{"camera": camera, "pixel": [5, 6]}]}
    tensors = tensors | {f"{pin_files.FIELD}.0.{name}": value for name, value in history.items()}
    file.write_bytes(_sealed(json.dumps(description), tensors))

    def change(_: bytes, chance: random.Random) -> bytes:
        changed: dict[str, Tensor | None] = dict(tensors)
        if chance.random() < 0.5:
            name = chance.choice(sorted(tensors))
            changed[name] = chance.choice(CHANGES)(tensors[name])
        text = json.dumps(description)
        if len(changed) == len(tensors) and chance.random() < 0.8:
            text = chance.choice([mutated, other_values])(text.encode(), chance).decode("utf-8", "replace")
        return _sealed(text, {name: value for name, value in changed.items() if value is not None})

    def work() -> None:
        found, state = checkpoint.load(file)
        with checkpoint.named(file):
            if not scene.is_of(found):
                raise UserError(scene.difference(found))
            trainer = Trainer.resume(scene, found, state, "cpu")
            pin_files.with_histories(pin_files.restored_pins(found), found, state)
        trainer.notes(found)

    return Reader(file, work, change, cost=8)


def _other_numbers(values: Tensor) -> Tensor:
    if values.is_floating_point():
        return torch.full_like(values, float("nan"))
    return ~values if values.dtype == torch.bool else values - 100


CHANGES: list[Callable[[Tensor], Tensor | None]] = [
    lambda _: None,
    lambda values: values.flatten()[:-1],
    lambda values: values[None],
    _other_numbers,
    lambda values: values.double() if values.dtype != torch.float64 else values.long(),
    lambda _: torch.zeros(0),
    lambda values: torch.full_like(values, 2**31 - 1) if values.dtype == torch.int64 else values * 1000,
]


def _sealed(text: str, tensors: Mapping[str, Tensor]) -> bytes:
    """A checkpoint's bytes with this text for its description, as `checkpoint.save` would write them."""
    arrays = {name: value.contiguous() for name, value in tensors.items()}
    version = str(checkpoint.VERSION)
    digest = checkpoint._digest(version, text, arrays)  # pyright: ignore[reportPrivateUsage]  a forger computes it too
    return save(arrays, metadata={"nerf": text, "version": version, "sha256": digest})
