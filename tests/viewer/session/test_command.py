"""The `nerf-viewer` command: the real app, worker and files, offscreen and in a real window.

Importing everything that a window needs takes seconds, so most tests run the command in this process. A few start a new
one.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from desk import PATIENCE

from nerf_core import cli as core
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.live.messages import MOST_PINS, OpenScene
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.modes import COLOR, mode_names
from nerf_core.training import checkpoint
from nerf_core.training.autosaves import forget_old_autosaves, spare_files
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from viewer.app.app import App
from viewer.cli import main
from viewer.session.script import Script
from viewer.session.wishes import Wishes

TINY = [
    "--method", "nerf", "--device", "cpu", "--threads", "1", "--downscale", "8", "--set", "rays=16",
    "--set", "coarse_samples=8", "--set", "fine_samples=8", "--set", "depth=2", "--set", "width=16",
    "--size", "640x400",
]  # fmt: skip


Completed = subprocess.CompletedProcess[str]


def without(options: list[str], given: list[str]) -> list[str]:
    """Return `options`, pairs of a name and a value, without those in `given`: each option may be given once."""
    pairs = [options[i : i + 2] for i in range(0, len(options), 2)]
    return [word for name, value in pairs if name == "--set" or name not in given for word in (name, value)]


def viewer(*arguments: str) -> Completed:
    """Run the command in this process."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        status = main(arguments)
    return Completed(arguments, status, out.getvalue(), err.getvalue())


def process(*arguments: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> Completed:
    """Run the command in a process of its own."""
    command = [sys.executable, "-m", "viewer.cli", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3]), **(env or {})}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE, cwd=cwd, env=environment, check=False
    )


def test_a_misspelt_constant_preset_or_option_is_told_before_a_window_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    for opener in ("open_offscreen", "open_window"):
        monkeypatch.setattr(f"viewer.window.{opener}", lambda *_: pytest.fail("a window opens"))
    done = viewer("photos", "--device", "cpu", "--set", "train_imges=7")
    words = "--set 'train_imges': method voxels has no such constant; did you mean train_images?"
    assert (done.returncode, done.stderr) == (2, f"nerf-viewer: {words}\n")
    done = viewer("photos", "--device", "cpu", "--method", "nerf", "--preset", "quik")
    words = "--preset 'quik': method nerf has no such preset; did you mean quick?"
    assert (done.returncode, done.stderr) == (2, f"nerf-viewer: {words}\n")
    done = viewer("photos", "--stpes", "100")
    words = "--stpes: no such option (did you mean --steps?); nerf-viewer --help lists the options"
    assert (done.returncode, done.stderr) == (2, f"nerf-viewer: {words}\n")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that asks for every kind of file at once."""
    out = tmp_path_factory.mktemp("out")
    done = viewer(
        *TINY, "--headless", "--steps", "60", "--click", "0.5", "0.5", "--screenshot", str(out / "shot.png"),
        "--render", str(out / "picture.npy"), "--inspect", str(out / "ray.json"), "--orbit", str(out / "orbit.mp4"),
        "--save", str(out / "model.safetensors"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return out


def test_help_lists_the_render_modes() -> None:
    with redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit):
        main(["--help"])
    shown = " ".join(out.getvalue().replace("│", " ").split())
    assert f"(default: {COLOR}; one of {', '.join(mode_names())})" in shown


def test_everything_asked_for_is_written(written: Path) -> None:
    assert iio.imread(written / "shot.png").shape == (400, 640, 3)
    film = str(written / "orbit.mp4")
    assert imageio_ffmpeg.count_frames_and_secs(film)[0] == 60
    reader = imageio_ffmpeg.read_frames(film)
    assert next(reader)["size"] == (26, 26)  # 25 pixels a side, padded to even
    reader.close()
    assert not list(written.glob("*.part"))


def test_the_inspected_ray_is_the_rendered_pixel(written: Path) -> None:
    ray = json.loads((written / "ray.json").read_text())
    picture = np.load(written / "picture.npy")
    assert picture.dtype == np.float32
    column, row = ray["pixel"]
    assert abs(column - picture.shape[1] // 2) <= 1
    assert abs(row - picture.shape[0] // 2) <= 1
    assert np.abs(picture[row, column] - ray["color"]).max() < 1e-5
    assert np.abs(np.array(ray["rendered_color"]) - ray["color"]).max() < 1e-5


def test_the_inspected_ray_obeys_the_equations(written: Path) -> None:
    ray = json.loads((written / "ray.json").read_text())
    assert [one["name"] for one in ray["passes"]] == ["coarse", "fine"]
    t = weights = rgb = np.empty(0)  # of the last pass, after the loop
    for one in ray["passes"]:
        t, delta, sigma, rgb, weights = (np.array(one[k]) for k in ("t", "delta", "sigma", "rgb", "weights"))
        alpha = 1 - np.exp(-sigma * delta)
        transmittance = np.concatenate([[1.0], np.cumprod(1 - alpha)[:-1]])
        assert np.all(np.diff(t) >= 0)
        assert np.allclose(one["alpha"], alpha, atol=1e-5)
        assert np.allclose(one["transmittance"], transmittance, atol=1e-5)
        assert np.allclose(weights, transmittance * alpha, atol=1e-5)
    color = weights @ rgb + (1 - weights.sum()) * np.array(ray["background"])
    assert np.abs(color - ray["color"]).max() < 1e-5
    assert ray["opacity"] == pytest.approx(weights.sum(), abs=1e-6)
    half = np.flatnonzero(np.cumsum(weights) >= 0.5)
    assert ray["depth_median"] == (pytest.approx(t[half[0]]) if len(half) else None)


def test_the_radiance_covers_the_sphere_around_the_point(written: Path) -> None:
    ray = json.loads((written / "ray.json").read_text())
    directions, rgb = np.array(ray["radiance"]["directions"]), np.array(ray["radiance"]["rgb"])
    assert len(directions) == len(rgb) >= 2048
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    assert rgb.min() >= 0
    assert rgb.max() <= 1
    along = np.array(ray["radiance"]["point"]) - ray["origin"]
    assert np.allclose(along / np.linalg.norm(along), ray["direction"], atol=1e-5)


def test_a_checkpoint_gives_the_same_picture_again(written: Path, tmp_path: Path) -> None:
    done = viewer(
        *TINY, "--headless", "--load", str(written / "model.safetensors"), "--render", str(tmp_path / "again.npy")
    )
    assert done.returncode == 0, done.stderr
    assert np.array_equal(np.load(tmp_path / "again.npy"), np.load(written / "picture.npy"))


def test_the_picture_is_written_in_the_mode_that_is_shown(written: Path, tmp_path: Path) -> None:
    picture, shot = tmp_path / "mode.npy", tmp_path / "shot.png"
    done = viewer(
        *TINY, "--headless", "--load", str(written / "model.safetensors"), "--mode", "view-dependence",
        "--render", str(picture), "--screenshot", str(shot),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    drawn = to_bytes(np.load(picture))
    assert np.abs(drawn.astype(int) - to_bytes(np.load(written / "picture.npy"))).max() > 50
    middle = drawn[drawn.shape[0] // 2, drawn.shape[1] // 2]
    assert (iio.imread(shot) == middle).all(-1).any()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "voxels"], "holds a model of method 'nerf': leave one of them out"),
        (["--set", "rays=17"], "--set 'rays'='17': the constants of"),
        (["--set", "wings=2"], "--set 'wings'='2': the constants of"),
        (["--preset", "complete"], "--preset 'complete': the constants of"),
    ],
)
def test_a_loaded_model_keeps_its_method_and_constants(written: Path, arguments: list[str], words: str) -> None:
    done = viewer("--headless", "--load", str(written / "model.safetensors"), "--render", "x.npy", *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert not done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "640"], "--size 640"),
        (["--click", "2.0", "0.5", "--inspect", "x.json"], "--click 2.0"),
        (["--inspect", "x.json"], "--click X Y"),
        (["--click", "0.5", "0.5", "--inspect", "x.json", "--inspect", "y.txt"], "--inspect y.txt: name a .json or"),
        (["--pin", "0.5", "0.5"] * (MOST_PINS + 1), "--pin: given 9 times; 8 rays at most can be pinned"),
        (["--camera", "nowhere", "--steps", "1", "--screenshot", "x.png"], "--camera 'nowhere': is none of the"),
        (["--click", "a", "0.5", "--steps", "1000000"], "--click a"),
        (["--click", "5000", "5000", "--steps", "1000000", "--inspect", "x.json"], "--click 5000"),
        (["--pin", "5000", "5000", "--steps", "1000000", "--save", "x.safetensors"], "--pin 5000"),
        (["--render", "a.png", "--render", "b.npy"], "--render: given 2 times"),
        (["--render", "x.jpg"], ".png or .npy"),
        (["--load", "nothing.safetensors"], "nothing.safetensors"),
        (["nowhere"], "nowhere"),
        (["--method", "magic"], "magic"),
        (["--set", "rays=many"], "rays"),
        (["--steps", "0"], "--steps 0"),
        (["--steps", "1.5"], "--steps"),
        (["--wings"], "--wings"),
        (["--size", "²x500"], "--size ²x500"),
        (["--size", "16x16", "--click", "0.5", "0.5", "--inspect", "x.json"], "give a larger --size"),
        (["--orbit", "x.avi"], "--orbit x.avi: name a .mp4 file"),
        (["--screenshot", "x.jpg"], "--screenshot x.jpg: name a .png file"),
        (["--save", "/proc/none/x.safetensors"], "/proc/none/x.safetensors: cannot be written"),
        (["--downscale", "9" * 400], "--downscale"),
        (["--set", "rays=" + 20 * "9"], "rays"),
        (["--set", "depth=100000"], "depth"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    steps = [] if "--steps" in arguments or "--load" in arguments else ["--steps", "1"]
    done = viewer(*without(TINY, arguments), "--headless", *steps, *arguments)
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mistake", [["--wings"], ["--camera", "nowhere"]], ids=["while parsing", "with a window open"])
def test_a_process_ends_with_one_line_and_status_2(mistake: list[str], tmp_path: Path) -> None:
    done = process(*TINY, "--headless", "--steps", "1", *mistake, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert mistake[-1] in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough(6)
def test_eight_pins_replace_those_of_the_demo_and_every_file_has_them(tmp_path: Path) -> None:
    tiny = ["--method", "voxels", "--device", "cpu", "--threads", "1", "--downscale", "8", "--size", "640x400"]
    pins = [word for k in range(MOST_PINS) for word in ("--pin", f"0.{k + 1}", "0.4")]
    files, model = [tmp_path / "rays.json", tmp_path / "rays.csv"], tmp_path / "model.safetensors"
    done = viewer(
        *tiny, "--headless", "--steps", "2", *pins, "--click", "0.5", "0.6", "--save", str(model),
        *(word for file in files for word in ("--inspect", str(file))),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rays = json.loads(files[0].read_text())["rays"]
    names = [ray.get("name") for ray in rays]
    assert names[0] is None  # the clicked one
    assert len(set(names[1:])) == len({tuple(ray["pixel"]) for ray in rays[1:]}) == MOST_PINS
    lines = files[1].read_text().splitlines()[1:]
    assert {line.partition(",")[0] for line in lines} == {str(k) for k in range(MOST_PINS + 1)}

    done = viewer(*tiny, "--headless", "--load", str(model), "--pin", "0.5", "0.5", "--render", str(tmp_path / "x.npy"))
    assert done.returncode == 2
    assert f"--pin: given 1 times; beside the rays that are pinned in {model} there is room for 0" in done.stderr
    assert not (tmp_path / "x.npy").exists()


def test_trained_weights_are_saved_if_a_file_cannot_be_written(
    data_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Script, file: Path) -> None:
        raise UserError(f"{file}: no space left on the disk")

    monkeypatch.setattr(Script, "_inspect", fail)
    for old in data_home.rglob("*.safetensors"):
        old.unlink()
    done = viewer(*TINY, "--headless", "--steps", "3", "--click", "0.5", "0.5", "--inspect", str(tmp_path / "x.json"))
    assert done.returncode == 2
    assert "no space left on the disk" in done.stderr
    (file,) = data_home.rglob("*.safetensors")
    assert str(file) in done.stdout


@pytest.mark.thorough(10)
@pytest.mark.parametrize(
    "taken",
    [
        "the user's data",
        pytest.param("nothing", marks=pytest.mark.thorough(12)),
        pytest.param("a temporary file", marks=pytest.mark.thorough(12)),
    ],
)
def test_weights_that_their_file_does_not_take_are_saved_elsewhere(taken: str, tmp_path: Path) -> None:
    """The reason is said, and where they are: among the user's data, or if that fails too, in a temporary folder."""
    file, data, temporary = tmp_path / "model.safetensors", tmp_path / "data", tmp_path / "temporary"
    temporary.mkdir()
    own = {"XDG_DATA_HOME": str(data), "TMPDIR": str(temporary)}
    limit = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
    limit += "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)); " if taken == "nothing" else ""
    code = limit + "import sys; from viewer.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *TINY, "--headless", "--steps", "1000000", "--save", str(file)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env={**os.environ, **own}, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert any(line.startswith("training: ") for line in process.stdout)
        if taken != "nothing":
            file.mkdir()
        if taken == "a temporary file":
            data.touch()
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 143
    assert "Traceback" not in err
    assert f"{file}: cannot be written: " in err
    saved = [path for path in tmp_path.rglob("*.safetensors") if path.is_file()]
    if taken == "nothing":
        assert not saved
        assert err.count("File too large") == 3  # of each place
    else:
        (path,) = saved
        assert path.is_relative_to(data if taken == "the user's data" else temporary)
        command = f"nerf-viewer --downscale 8 --device cpu --load {path}"
        assert f"saved to {path}; continue with {command}" in out
    assert not list(tmp_path.rglob("*.part"))


def test_the_newest_autosaves_of_a_scene_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    temporary = tmp_path / "temporary"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    scene = load_scene(None, LoadOptions(downscale=8))
    folder = tmp_path / "nerf-viewer" / "autosave"
    trainer = Trainer(scene, RunSettings(method="nerf", device="cpu"))
    seconds = [0.5, 3600.0, 0.5, 0.5, 0.5, 0.5]
    for k, trained in enumerate(seconds):
        name = spare_files(scene)[0].name.replace(f"-{os.getpid()}.", f"-{k}.")
        elsewhere = temporary if k == 2 else folder  # as after a save that the first folder did not take
        for file in (elsewhere / name, elsewhere / f"copy {k}.safetensors"):
            checkpoint.save(file, trainer.describe() | {"seconds": trained}, trainer.state())
            os.utime(file, (k, k))
    (folder / "mine.safetensors").write_bytes(b"of another program")
    os.utime(folder / "mine.safetensors", (0, 0))
    forget_old_autosaves(scene, 2)
    forget_old_autosaves(scene, 3)  # there are no more
    kept = sorted(path.stem.rpartition("-")[2] for path in (*folder.iterdir(), *temporary.iterdir()))
    # the longest trained one stays, and so do the user's own copies
    assert kept == ["1", "4", "5", *(f"copy {k}" for k in range(6)), "mine"]
    file, second = spare_files(scene)
    assert file.parent == folder
    assert not file.exists()
    assert (second.name, second.parent) == (file.name, temporary)


def test_an_autosaves_name_fits_whatever_the_scene_is_called() -> None:
    scene = load_scene(None, LoadOptions(downscale=8))
    for name in ("ü" * 200, "n" * 255, "../../etc", "\udcff\udcfe", "", "a\nb"):
        file = spare_files(replace(scene, name=name))[0]
        assert len(file.name.encode()) < 255
        assert file.parent.name == "autosave"


@pytest.fixture
def screen(display: str, tmp_path: Path) -> dict[str, str]:
    """Environment variables for a window on the virtual display, for a user who has no layout and no weights yet."""
    home = {"XDG_CONFIG_HOME": str(tmp_path / "config"), "XDG_DATA_HOME": str(tmp_path / "data")}
    return {"DISPLAY": display, "WAYLAND_DISPLAY": ""} | home


def test_the_command_works_in_a_window(screen: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in screen.items():
        monkeypatch.setenv(name, value)
    shot = tmp_path / "window.png"
    done = viewer(*TINY, "--steps", "3", "--click", "0.5", "0.5", "--screenshot", str(shot))
    assert done.returncode == 0, done.stderr
    assert iio.imread(shot).shape[2] == 3


def test_closing_a_training_window_loses_nothing(screen: dict[str, str], tmp_path: Path) -> None:
    saved = tmp_path / "model.safetensors"
    asked = ["--save", str(saved), "--steps", "100000", "--orbit", str(tmp_path / "o.mp4")]
    command = [sys.executable, "-m", "viewer.cli", *TINY, *asked]
    with subprocess.Popen(command, env={**os.environ, **screen}, stdout=subprocess.PIPE, text=True) as window:
        assert window.stdout is not None
        assert any(line.startswith("training: ") for line in window.stdout)  # its first progress, after seconds
        window.send_signal(signal.SIGTERM)
        begin = time.monotonic()
        assert window.wait(timeout=PATIENCE) == 143
        assert time.monotonic() - begin < 5  # the sender of a SIGTERM soon sends SIGKILL
    assert saved.is_file()
    assert not list(tmp_path.glob("*.mp4"))


def test_a_wrong_option_ends_the_window_with_one_line(screen: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in screen.items():
        monkeypatch.setenv(name, value)
    done = viewer("--scale", "2")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "--scale 2" in done.stderr


def test_a_window_says_why_a_capture_is_not_open(
    screen: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a launcher there is no terminal to read it in."""
    for name, value in screen.items():
        monkeypatch.setenv(name, value)
    photos = tmp_path / "holiday"
    photos.mkdir()
    iio.imwrite(photos / "a.png", np.zeros((8, 8, 3), np.uint8))
    shot = tmp_path / "window.png"

    def look(app: App, _: object) -> None:
        assert str(photos) in app.state.not_opened
        app.screenshot(shot)
        assert "toasts.0.dismiss" not in app.widgets  # the viewport says it
        app.perform(OpenScene(None, RunSettings(load=LoadOptions(downscale=8))))
        limit = time.monotonic() + PATIENCE
        while app.state.snapshot.scene is None and time.monotonic() < limit:
            app.window.poll(0.02)
            app.frame(force=True)
        assert app.state.not_opened == ""

    monkeypatch.setattr(App, "run", look)
    done = viewer(*TINY, str(photos))
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)  # another scene was opened
    assert str(photos) in done.stderr
    monkeypatch.setattr(App, "run", lambda *_: None)
    assert viewer(*TINY, str(photos)).returncode == 2
    assert shot.is_file()
    done = viewer(*TINY, str(photos), "--screenshot", str(tmp_path / "other.png"))  # writes files: nobody looks
    assert done.returncode == 2
    assert not (tmp_path / "other.png").exists()


def test_offscreen_without_requests_a_picture_an_orbit_and_a_ray_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Like the first command of the README on a machine without a display, but with less training."""
    monkeypatch.chdir(tmp_path)
    done = viewer(*TINY, "--headless", "--steps", "5")
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert str(folder) in done.stdout
    assert sorted(p.name for p in folder.iterdir()) == ["orbit.mp4", "ray.json", "screenshot.png"]
    assert imageio_ffmpeg.count_frames_and_secs(str(folder / "orbit.mp4"))[0] == 40


def test_offscreen_no_folder_is_named_before_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = viewer("--headless", "nowhere")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_a_window_without_a_display_works_offscreen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
    shot = tmp_path / "shot.png"
    done = viewer(*TINY, "--steps", "2", "--screenshot", str(shot))
    assert done.returncode == 0, done.stderr
    assert "offscreen" in done.stdout
    assert shot.is_file()


def test_gl_and_training_live_in_one_process() -> None:
    """A CUDA build of torch brings triton, which would crash the process if it were bound to Mesa's LLVM.

    Its library takes 65 MB of memory, so it is loaded where triton is imported, not where somebody looks for it.
    """
    pytest.importorskip("triton", reason="only Linux on x86-64 has triton")
    code = (
        "from viewer.window.egl_window import EglWindow; w = EglWindow((64, 64));"
        "import importlib.util; assert importlib.util.find_spec('triton') is not None;"
        "assert 'libtriton' not in open('/proc/self/maps').read(); import triton, torch;"
        "assert 'libtriton' in open('/proc/self/maps').read();"
        "p = torch.nn.Parameter(torch.ones(3)); o = torch.optim.Adam([p]); p.sum().backward(); o.step();"
        "w.framebuffer.clear(1.0, 0.0, 0.0); print(w.read_pixels()[0, 0].tolist())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[255, 0, 0]"


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("lego", ["--downscale", "16"]),
        ("fox", ["--downscale", "32"]),
        ("fern", ["--downscale", "8"]),
        ("can", ["--format", "llff", "--downscale", "16"]),
        ("can", ["--format", "colmap", "--downscale", "16"]),
    ],
)
def test_real_scenes_open_and_train(scenes: Path, name: str, options: list[str], tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    done = viewer(
        str(scenes / name), *without(TINY, options), *options, "--headless", "--steps", "20", "--screenshot", str(shot)
    )
    assert done.returncode == 0, done.stderr
    assert shot.is_file()


def test_the_free_camera_may_turn_away_in_ndc(scenes: Path) -> None:
    scene = load_scene(scenes / "fern", LoadOptions(downscale=8))
    assert scene.ndc is not None
    camera: Camera = scene.views[0].camera
    behind = camera.moved(camera.c2w @ np.diag([-1.0, 1, -1, 1])).resized(8, 8)
    rays = camera_rays(behind, scene.near, scene.far)
    _, _, exists = scene.ndc.rays(rays.origins, rays.directions)
    assert not exists.any()


def test_a_checkpoint_is_checked_before_anything_else_is_done(tmp_path: Path) -> None:
    junk = tmp_path / "junk.safetensors"
    junk.write_bytes(b"no header at all")
    with pytest.raises(UserError, match=r"junk\.safetensors: not a readable checkpoint"):
        Wishes(load=junk).check()


def test_both_commands_write_the_same_for_a_pixel(tmp_path: Path) -> None:
    """Both open one pixel of one checkpoint, and their files have one schema and equal arrays."""
    options = ["--method", "voxels", "--device", "cpu", "--threads", "1", "--downscale", "8"]
    assert core.main(["train", "--out", str(tmp_path), *options, "--steps", "40"]) == 0
    (model,) = tmp_path.rglob("*.safetensors")
    files = tmp_path / "viewer.json", tmp_path / "core.json"
    done = viewer(
        *options, "--headless", "--size", "640x400", "--load", str(model), "--steps", "40", "--camera", "test/r_3",
        "--click", "0.5", "0.5", "--inspect", str(files[0]),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    looking = json.loads(files[0].read_text())
    (photo,) = (v for v in load_scene(None, LoadOptions(downscale=8)).views if v.name == "test/r_3.png")
    np.testing.assert_allclose(looking["camera"]["c2w"], photo.camera.c2w, atol=1e-6)
    pixel = [str(v) for v in looking["pixel"]]
    words = ["probe", str(tmp_path), "--camera", str(files[0]), "--pixel", *pixel, "--write", str(files[1])]
    assert core.main(words) == 0
    one, other = (json.loads(file.read_text()) for file in files)
    assert {"passes", "verdict", "radiance", "evidence"} <= one.keys()
    assert _numbers(one).keys() == _numbers(other).keys()
    for name, value in _numbers(one).items():
        np.testing.assert_allclose(value, _numbers(other)[name], atol=1e-6, err_msg=name)
    assert one["verdict"]["reasons"] == other["verdict"]["reasons"]


def _numbers(value: object, name: str = "") -> dict[str, np.ndarray]:
    """Return every array of numbers in a JSON document by its path."""
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in _numbers(inner, f"{name}/{key}").items()}
    if isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        return {k: v for i, inner in enumerate(value) for k, v in _numbers(inner, f"{name}/{i}").items()}
    array = np.array(value)
    return {name: array} if array.dtype.kind in "if" else {}


def test_a_method_with_nothing_to_train_goes_on_at_once(tmp_path: Path) -> None:
    """--steps would be waited for in vain."""
    options = [
        "--downscale",
        "8",
        "--method",
        "nearest-view",
        "--device",
        "cpu",
        "--threads",
        "1",
        "--size",
        "640x400",
        "--headless",
    ]
    done = viewer(
        *options, "--steps", "5", "--click", "0.5", "0.5", "--render",
        str(tmp_path / "a.npy"), "--inspect", str(tmp_path / "ray.json"), "--screenshot", str(tmp_path / "a.png"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "nothing to train: method nearest-view has no parameters" in done.stdout
    ray, picture = json.loads((tmp_path / "ray.json").read_text()), np.load(tmp_path / "a.npy")
    column, row = ray["pixel"]
    np.testing.assert_allclose(picture[row, column], ray["color"], atol=1e-6)
    assert (ray["passes"], ray["visited"]) == ([], [])
    assert "failed" not in done.stderr  # a panel
    refused = viewer(*options, "--mode", "view-dependence", "--render", str(tmp_path / "b.npy"))
    assert refused.returncode == 2
    assert "method nearest-view keeps no samples along a ray: it cannot show view-dependence" in refused.stderr
