"""The `nerf-core` command: what it writes, what it prints, and its exit status."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import pytest
import torch
from desk import PATIENCE
from PIL import Image

import nerf_core
from nerf_core.cli import main
from nerf_core.commands import COMMANDS
from nerf_core.datasets import DATASETS, LoadOptions
from nerf_core.methods import METHODS
from nerf_core.rendering.export.models import EXPORTS
from nerf_core.training import checkpoint
from nerf_core.training.autosaves import left_off
from nerf_core.training.run_folder import RunFolder

TINY = [
    "--method", "nerf", "--device", "cpu", "--threads", "1", "--set", "coarse_samples=8",
    "--set", "fine_samples=8", "--set", "depth=2", "--set", "width=16",
]  # fmt: skip


ORDERED = sorted(COMMANDS.names(), key=lambda name: COMMANDS.get(name).order)
SUBCOMMANDS = f"{{{', '.join(ORDERED)}}}"


def train(capture: Path, out: Path, *more: str, rays: int = 32) -> list[str]:
    return ["train", str(capture), "--out", str(out), *TINY, "--set", f"rays={rays}", *more]


def command(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "nerf_core.cli", *arguments]


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed to stderr: an error of one line."""
    text = capsys.readouterr().err
    assert text.startswith("nerf-core: ")
    assert text.count("\n") == 1
    return text


def test_train_eval_render(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(train(capture, out, "--steps", "3")) == 0
    told = capsys.readouterr().out
    assert "finished: step 3 after" in told
    assert "no --steps" not in told
    assert sorted(p.name for p in out.iterdir()) == [".lock", "checkpoints", "config.json", "log.jsonl"]

    assert main(train(capture, out, "--steps", "3")) == 2
    assert f"{out}: holds a run already" in error_line(capsys)

    assert main(train(capture, out, "--steps", "5", "--resume")) == 0
    told = capsys.readouterr().out
    assert f"continuing {out} at step 3" in told
    assert "finished: step 5" in told

    assert main(["eval", str(out)]) == 0
    assert "LPIPS not computed" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert set(metrics) == {"mean", "images", "split", "method", "step", "seconds"}
    assert set(metrics["mean"]) == {"psnr", "ssim", "lpips"}
    assert [set(image) for image in metrics["images"]] == [{"name", "psnr", "ssim", "lpips"}]
    assert (metrics["split"], metrics["step"]) == ("test", 5)
    assert (out / "eval" / metrics["images"][0]["name"]).is_file()

    film = tmp_path / "orbit.mp4"
    assert main(["render", str(out), "--out", str(film), "--frames", "3", "--fps", "10", "--png-frames"]) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(film))[0] == 3
    assert len(list((tmp_path / "orbit_frames").iterdir())) == 3


def test_resumed_by_the_command_is_bit_identical(capture: Path, tmp_path: Path) -> None:
    straight, parts = tmp_path / "straight", tmp_path / "parts"
    assert main(train(capture, straight, "--steps", "6")) == 0
    # The time limit ends the first part after any number of steps. Its schedule spans 6 all the same.
    assert main(train(capture, parts, "--steps", "6", "--seconds", "0.0001")) == 0
    assert RunFolder(parts).checkpoints()[-1].stem < "step_00000006"
    assert main(["train", "--out", str(parts), "--resume"]) == 0
    one, other = (checkpoint.newest(path) for path in (straight, parts))
    assert one[1]["step"] == other[1]["step"] == 6
    assert [name for name, value in one[2].items() if not value.equal(other[2][name])] == []


def test_the_demo_scene_needs_no_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *TINY, "--set", "rays=32", "--max-size", "20", "--steps", "1"]) == 0
    assert "training nerf on demo" in capsys.readouterr().out
    assert (tmp_path / "runs" / "demo-nerf" / "config.json").is_file()
    quick = ["--max-size", "20", "--steps", "1", "--set", "rays=64", "--device", "cpu"]
    assert main(["train", *quick]) == 0
    assert "training voxels (auto: it is the fast one on a CPU) on demo" in capsys.readouterr().out
    assert (tmp_path / "runs" / "demo-voxels" / "config.json").is_file()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--steps", "0"], "--steps 0"),
        (["--set", "rays"], "--set 'rays': write NAME=VALUE"),
        (["--set", "wings=2"], "--set 'wings': method voxels has no such constant"),
        (["--method", "magic"], f"--method 'magic': choose from auto, {', '.join(METHODS.names())}"),
        (["--method", "voxel"], "--method 'voxel' (did you mean voxels?): choose from auto, "),
        (["--format", "doc"], f"--format 'doc': choose from auto, {', '.join(DATASETS.names())}"),
        (["--downscale", "0"], "--downscale is 0"),
        (["--device", "abacus"], "--device abacus: choose auto, cpu, cuda or cuda:N"),
        (["--save-every", "0"], "--save-every 0.0: give a number above 0"),
        (["--resume"], "not a run: it has no config.json"),
    ],
)
def test_wrong_options_give_an_error_of_one_line(
    options: list[str], text: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(capture), "--out", str(tmp_path / "run"), *options]) == 2
    assert text in error_line(capsys)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["eval", "none"], "none: not a run: it has no config.json"),
        (["render", "none", "--out", "a.gif"], "--out a.gif: only MP4 is written"),
        (
            ["render", "none", "--out", "a.mp4", "--path", "test", "--radius", "2"],
            "--radius belongs to --path orbit, not to test",
        ),
        (["fly"], f"nerf-core: unknown command 'fly': choose one of {', '.join(COMMANDS.names())}"),
        (["poses"], "nerf-core: unknown command 'poses' (did you mean pose?): choose one of "),
        (
            ["export", "none", "a.ply"],  # a command as soon as a model export is registered
            "none: not a run" if EXPORTS.names() else "nerf-core: unknown command 'export'",
        ),
        (["train", "none", "--out", "out"], "none does not exist: name the folder of a dataset"),
    ],
)
def test_wrong_arguments_give_an_error_of_one_line(
    arguments: list[str],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert text in error_line(capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["train", "--steps", "many"],
            "nerf-core: --steps: cannot be read: 'many': a whole number is needed; nerf-core",
        ),
        (["train", "--wings"], "nerf-core: --wings: no such option; "),
        (["train", "x", "--stpes", "100"], "nerf-core: --stpes: no such option (did you mean --steps?); "),
        (["train", "x", "--save_evry=3"], "nerf-core: --save_evry: no such option (did you mean --save-every?); "),
        (["train", "-steps", "3"], "nerf-core: -steps: no such option (did you mean --steps?); "),
        (["probe", "run", "--pixl", "3", "4"], "nerf-core: --pixl: no such option (did you mean --pixel?); "),
        (["lab", "image", "--stpes", "3"], "nerf-core: --stpes: no such option (did you mean --steps?); "),
        (["train", "--data", "x"], "nerf-core: --data: no such option; "),
        (["train", "-notes"], "nerf-core: -notes: no such option; "),
        (["train", "-h2"], "nerf-core: -h2: no such option; "),
        (["eval", "-r"], "nerf-core: -r: no such option; "),
        (["train", "x", "--set", "-a=3"], "nerf-core: --set: needs a value; "),
        (
            ["probe", "run", "--camera", "x", "--pixel", "1", "--t", "-inf"],
            "nerf-core: --pixel: needs 2 values; ",
        ),
        (["train", "--ndc", "perhaps"], "nerf-core: --ndc 'perhaps': choose from auto, on, off; nerf-core train"),
        (
            ["train", "--downscale", "four"],
            "nerf-core: --downscale: cannot be read: 'four': a whole number is needed; nerf-core train",
        ),
        (
            ["pose", "x", "--memory-gb", "much"],
            "nerf-core: --memory-gb: cannot be read: 'much': a number is needed; nerf-core pose",
        ),
        (["pose", "x", "--quality"], "nerf-core: --quality: needs a value; nerf-core pose"),
        (
            ["pose", "x", "--quality", "fats"],
            "nerf-core: --quality 'fats' (did you mean fast?): choose from fast, normal, high; nerf-core pose",
        ),
        (["cache", "--clear", "pose"], "nerf-core: --clear 'pose' (did you mean poses?): choose from "),
        (["pose"], "nerf-core: PHOTOS: is needed; nerf-core pose"),
        (["eval"], "nerf-core: DIR: is needed; nerf-core eval"),
        (["probe", "run", "--pixel", "1", "1"], "nerf-core: --camera: is needed; nerf-core probe"),
        (
            ["probe", "run", "--camera", "a", "--pixel", "1.5", "1"],
            "nerf-core: --pixel: cannot be read: '1.5', '1': whole numbers are needed; nerf-core probe",
        ),
        (
            ["probe", "run", "--camera", "a", "--pixel", "a", "b"],
            "--pixel: cannot be read: 'a', 'b': whole numbers are needed; nerf-core probe",
        ),
        (
            ["probe", "run", "--camera", "a", "--pixel", "1", "1", "--t", "x"],
            "nerf-core: --t: cannot be read: 'x': a number is needed; nerf-core probe",
        ),
        (["--wings"], "--wings"),
        (["--stpes", "3"], "nerf-core: --stpes: no such option (did you mean --steps?); "),
        ([], SUBCOMMANDS),
    ],
)
def test_a_command_that_cannot_be_parsed_gives_an_error_of_one_line(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    line = error_line(capsys)
    assert text in line
    named = bool(arguments) and not arguments[0].startswith("-")
    about = f"nerf-core {arguments[0]}" if named else "nerf-core"
    assert line.endswith(f"; {about} --help lists the options\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("train_imges=7", "--set 'train_imges': method voxels has no such constant; did you mean train_images?"),
        ("train_images=seven", "--set train_images='seven': expected a whole number"),
        ("train_images=-5", "--set train_images=-5: must be at least 0"),
    ],
)
def test_a_wrong_constant_is_told_before_poses_are_searched_for(
    change: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(3):
        Image.new("RGB", (32, 32)).save(tmp_path / f"{k}.png")
    monkeypatch.setattr("nerf_core.captures.opening.find_poses", lambda *_: pytest.fail("poses are searched for"))
    run = tmp_path / "run"
    assert main(["train", str(tmp_path), "--out", str(run), "--device", "cpu", "--set", change]) == 2
    assert error_line(capsys) == f"nerf-core: {words}\n"
    guided = ["train", "--method", "nerf-guided", "--out", str(run), "--set"]
    assert main([*guided, "guide.stp=0.5"]) == 2
    assert "did you mean guide.step?" in error_line(capsys)
    nerf = ["train", str(tmp_path), "--method", "nerf", "--out", str(run), "--set"]
    for low, least in (("rays=0", 1), ("coarse_samples=2", 3)):
        assert main([*nerf, low]) == 2
        assert error_line(capsys) == f"nerf-core: --set {low}: must be at least {least}\n"


@pytest.mark.parametrize("name", COMMANDS.names())
def test_a_subcommand_explains_itself_and_its_mistakes(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    kind: Any = COMMANDS.get(name)
    assert is_dataclass(kind)
    assert vars(kind)["__dataclass_params__"].frozen
    sentence = " ".join((kind.__doc__ or "").split())
    assert sentence.endswith(".")
    for words in (["--help"], [name, "--help"]):
        with pytest.raises(SystemExit) as caught:
            main(words)
        assert caught.value.code == 0
        shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert sentence.partition(".")[0] in shown
    assert main([name, "--no-such-option"]) == 2
    assert error_line(capsys).endswith("--help lists the options\n")


def test_help_exits_with_status_0(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["train", "--help"])
    assert caught.value.code == 0
    assert "--seconds" in capsys.readouterr().out


def test_diverged_exits_1(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(train(capture, tmp_path / "run", "--steps", "50", "--set", "learning_rate=1e30")) == 1
    assert "went back to step 0 and saved it" in error_line(capsys)
    assert checkpoint.newest(tmp_path / "run")[1]["step"] == 0


def test_two_instances(capture: Path, tmp_path: Path) -> None:
    with RunFolder(tmp_path).claimed():
        done = subprocess.run(command(train(capture, tmp_path)), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        f"nerf-core: {tmp_path}: another process trains in this folder: wait for it or choose another --out\n"
    )


def running(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """The command in a process of its own, once it has printed its first line."""
    process = subprocess.Popen(command(arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("training nerf"), process.communicate()
    return process


@pytest.mark.parametrize(
    ("number", "status"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.thorough(10)),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.thorough(10)),
    ],
)
def test_signals_save_and_exit(
    hangup: None, number: signal.Signals, status: int, capture: Path, tmp_path: Path
) -> None:
    # with 32 rays a step takes milliseconds; with 200,000 it takes minutes, so that the signal interrupts it
    for rays in (32, 200_000):
        out = RunFolder(tmp_path / str(rays))
        process = running(train(capture, out.path, rays=rays))
        assert process.stdout is not None
        assert process.stdout.readline().startswith("no --steps and no --seconds: all ")
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, errors) == (status, "")
        assert "stopped: step" in output
        assert out.restore()[0].step_count == checkpoint.newest(out.path)[1]["step"]


def test_a_cancelled_render_leaves_no_file(capture: Path, tmp_path: Path) -> None:
    out, films = tmp_path / "run", tmp_path / "films"
    assert main(train(capture, out, "--steps", "1")) == 0
    arguments = ["render", str(out), "--out", str(films / "a.mp4"), "--frames", "3000"]
    process = subprocess.Popen(command(arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (films.exists() and list(films.iterdir())):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors) == (130, "nerf-core: interrupted (SIGINT)\n")
    assert list(films.iterdir()) == []


def test_probe_opens_a_pixel_of_a_run(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, file = tmp_path / "run", tmp_path / "ray.json"
    assert main(train(capture, run, "--steps", "3")) == 0
    capsys.readouterr()
    figure = tmp_path / "deep" / "ray.svg"
    words = ["probe", str(run), "--camera", "r_2", "--pixel", "8", "8", "--write", str(file), "--write", str(figure)]
    assert main(words) == 0
    told = capsys.readouterr().out
    stored = json.loads(file.read_text())
    assert told.startswith(stored["verdict"]["kind"])
    assert "step 3" in told
    assert stored["pixel"] == [8, 8]
    assert stored["camera"]["width"] == 16
    assert figure.is_file()
    assert main([*words[:2], "--camera", str(file), "--pixel", "8", "8", "--write", str(tmp_path / "again.json")]) == 0
    assert json.loads((tmp_path / "again.json").read_text()) == stored  # an opened ray's file has its camera
    capsys.readouterr()
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "poor.json").write_text(json.dumps({k: v for k, v in stored["camera"].items() if k != "c2w"}))
    near, far = (f"{stored[name]:.4g}" for name in ("near", "far"))
    for wrong, text in (
        (["--camera", str(tmp_path / "list.json"), "--pixel", "8", "8"], "list.json holds []: an object as an opened"),
        (["--camera", str(tmp_path / "poor.json"), "--pixel", "8", "8"], "holds no camera (field c2w is missing): an"),
        (
            ["--camera", "r_2", "--pixel", "8", "8", "--t", "1e9"],
            f"--t 1e+09: the point lies far behind all that the ray meets: give a distance from {near} to {far}\n",
        ),
        (["--camera", "r_9", "--pixel", "8", "8"], "--camera 'r_9': is none of the 6 photos"),
        (["--camera", "r_2", "--pixel", "8", "8", "--t", "nan"], "--t nan: the point's distance along the ray"),
        (["--camera", "r_2", "--pixel", "8", "8", "--t", "-1"], "--t -1.0: the point's distance along the ray"),
        (
            ["--camera", "r_2", "--pixel", "16", "0"],
            "nerf-core: --pixel 16 0: outside the picture, columns 0 … 15, rows 0 … 15\n",
        ),
        (
            ["--camera", "r_2", "--pixel", "1", "1", "--write", str(tmp_path / "a.txt")],
            "a.txt: an opened ray is written",
        ),
        (
            ["--camera", "r_2", "--pixel", "1", "1", "--write", "/proc/x.json"],
            "/proc/x.json: cannot be written: No such file or directory; choose a folder that has space",
        ),
    ):
        assert main(["probe", str(run), *wrong]) == 2
        assert text in error_line(capsys)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out == f"nerf-core {nerf_core.__version__}\n"


def test_methods_are_listed_with_their_constants(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(METHODS.names())
    assert main(["methods", "nerf"]) == 0
    text = capsys.readouterr().out
    assert "presets: auto, complete, no-pe-viewdirs-hierarchy" in text
    assert "  coarse_samples = 64 (from 3 to 16,384)\n      samples per ray of the coarse network, N_c\n" in text
    assert "  precision = float32 (float32 or bfloat16)" in text
    assert main(["methods", "nerf-guided"]) == 0
    assert "  guide.step = 0.7 (from 0.05 to 16)" in capsys.readouterr().out
    assert main(["methods", "wings"]) == 2
    assert "unknown method 'wings'" in capsys.readouterr().err


def test_autosaves_are_listed_and_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t"))
    assert main(["autosaves"]) == 0
    assert capsys.readouterr().out == "0 autosaves, 0 B\n"
    folder = tmp_path / "nerf-viewer" / "autosave"
    file = folder / "chair-0123abcd-20260102-030405-7.safetensors"
    left = left_off(file, tmp_path / "gone", LoadOptions())
    described = {
        "method": "voxels", "config": {}, "steps": 0, "seed": 0, "threads": 1, "step": 1234, "seconds": 61.0,
        "scene": "0123abcd", "scene_name": "chair", "scene_summary": "", **left,
    }  # fmt: skip
    checkpoint.save(file, described, {"weights": torch.zeros(500_000)})
    (folder / "mine.safetensors").write_bytes(file.read_bytes())
    assert main(["autosaves"]) == 0
    line, total = capsys.readouterr().out.splitlines()
    assert "2 MB  chair, voxels, step 1,234, 1 min 1 s of training  " in line
    assert line.endswith(f"{file} ({tmp_path / 'gone'} is no longer there)")
    assert total == "1 autosave, 2 MB; --clear deletes them"
    assert main(["autosaves", "--clear"]) == 0
    assert "deleted 1 of 1 autosave, 2 MB" in capsys.readouterr().out
    assert [path.name for path in folder.iterdir()] == ["mine.safetensors"]
