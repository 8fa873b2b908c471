"""nerfstudio's nerfacto (https://docs.nerf.studio, on PyPI) on a CPU, with its fields in plain torch.

The file is also the script that nerfstudio's Python runs: it must not import nerf_core.
"""

from __future__ import annotations

import functools
import importlib
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

NAME, UNIT, FIRST = "nerfacto", "iterations", 10
OPTION, HELP = "nerfacto", "the python of an environment with nerfstudio (pip install nerfstudio)"


def missing(given: str) -> str:
    python = shutil.which(given or "python3")
    code = "import nerfstudio.models.nerfacto"
    if python and not subprocess.run([python, "-c", code], capture_output=True, check=False).returncode:
        return ""
    return "pip install nerfstudio in an environment, then --nerfacto PYTHON"


def command(photos: Path, folder: Path, amount: float, given: str) -> list[str]:
    """Train for `amount` iterations, over which its learning rates decay."""
    return [given or "python3", __file__, "train", str(photos), str(folder), str(max(2, round(amount)))]


def render(photos: Path, folder: Path, given: str) -> list[np.ndarray]:
    """Draw the held-out views, float (H, W, 3) in [0, 1], in the order of test_filenames."""
    subprocess.run([given or "python3", __file__, "render", str(photos), str(folder), "0"], check=True)
    with np.load(folder / "pictures.npz") as pictures:
        return [pictures[str(i)] for i in range(len(pictures.files))]


def train(photos: Path, folder: Path, iterations: int) -> None:
    """Run ns-train."""
    without_lpips()
    words = {
        "data": photos, "output-dir": folder, "experiment-name": "run", "timestamp": "now", "vis": "tensorboard",
        "machine.device-type": "cpu", "mixed-precision": False, "max-num-iterations": iterations,
        "pipeline.model.implementation": "torch",
        "steps-per-eval-batch": 0, "steps-per-eval-image": 0, "steps-per-eval-all-images": 0,
        "optimizers.fields.scheduler.max-steps": iterations,
        "optimizers.proposal-networks.scheduler.max-steps": iterations,
    }  # fmt: skip
    options = [word for name, value in words.items() for word in (f"--{name}", str(value))]
    sys.argv = ["ns-train", "nerfacto", *options, "nerfstudio-data", "--downscale-factor", "1"]
    importlib.import_module("nerfstudio.scripts.train").entrypoint()


def draw(folder: Path) -> None:
    """Write the held-out views to pictures.npz."""
    without_lpips()
    torch: Any = importlib.import_module("torch")
    torch.load = functools.partial(torch.load, weights_only=False)  # its own checkpoint, from a moment ago
    setup = importlib.import_module("nerfstudio.utils.eval_utils").eval_setup
    _, pipeline, _, _ = setup(folder / "run" / "nerfacto" / "now" / "config.yml", test_mode="test")
    cameras = pipeline.datamanager.eval_dataset.cameras
    found = {}
    with torch.no_grad():
        for i in range(len(cameras)):
            found[str(i)] = pipeline.model.get_outputs_for_camera(cameras[i : i + 1])["rgb"].cpu().numpy()
    np.savez(folder / "pictures.npz", **found)


def without_lpips() -> None:
    """Leave LPIPS out: nerfacto would download its weights before it trains, and it is not asked for here."""

    def none(**_: Any) -> Any:
        return importlib.import_module("torch").nn.Identity()

    metrics: Any = importlib.import_module("torchmetrics.image.lpip")
    metrics.LearnedPerceptualImagePatchSimilarity = none


if __name__ == "__main__":
    task, photos_folder, run_folder, count = sys.argv[1:]
    if task == "train":
        train(Path(photos_folder), Path(run_folder), int(count))
    else:
        draw(Path(run_folder))
