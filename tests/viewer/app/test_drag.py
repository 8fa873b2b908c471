"""A drag over a trained model: what the window shows in every frame, against the true picture of its camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scripted
import torch

from nerf_core.datasets import load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.view_rays import view_rays
from nerf_core.live.messages import Preview, ViewRequest
from nerf_core.methods import traced
from nerf_core.rendering.images import to_bytes
from nerf_core.rendering.modes import COLOR, mode_names, shaded
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer
from viewer.app.app import App
from viewer.app.pacing import Pacer
from viewer.model.state import GoToView
from viewer.window import Window

SIZE = (480, 360)
STEPS = 100  # of training: the demo's things have edges by then
TURN = 3  # pixels of the drag from one frame to the next: 1.5 degrees
COARSE = 32  # stride of the pictures of a moving camera: what a slow model can draw

RENDERED: dict[tuple[object, ...], Preview] = {}  # of the one trainer, because drags repeat their cameras
Error = tuple[float, float]
Open = Callable[[], tuple[App, "Models"]]


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    settings = RunSettings(method="voxels")
    trainer = Trainer(load_scene(None, settings.load), settings)
    for _ in range(STEPS):
        trainer.step()
    return trainer


class Models(scripted.ScriptedWorker):
    """Answers with pictures of a trained model, of the stride, step and number that are set."""

    def __init__(self, trainer: Trainer) -> None:
        super().__init__(trainer.scene)
        self.current = replace(self.current, step=STEPS, status="paused")
        self.trainer, self.step, self.model = trainer, STEPS, 1

    def truth(self, camera: Camera, mode: str = COLOR) -> Preview:
        """The picture of all pixels."""
        key = *camera.intrinsics(), camera.c2w.tobytes(), mode
        if key not in RENDERED:
            y, x = np.mgrid[: camera.height, : camera.width]
            pixels = np.stack([x.ravel(), y.ravel()], -1)
            colors, depths = [], []
            for k in range(0, len(pixels), 16384):
                rays = view_rays(self.trainer.scene, camera, pixels[k : k + 16384])
                if mode == COLOR:  # all that most pictures need, and much quicker than with the samples
                    drawn = self.trainer.method.render(rays)
                    shown = drawn.color.numpy()
                else:
                    trace = traced(self.trainer.method, rays)
                    drawn, shown = trace.rendering, shaded(self.trainer.method, rays, trace, mode)
                colors.append(to_bytes(shown))
                ahead = rays.directions @ -torch.from_numpy(camera.c2w[:, 2]).float()
                depths.append((drawn.depth * ahead).numpy())
            rgba = np.full((camera.height, camera.width, 4), 255, np.uint8)
            rgba[..., :3] = np.concatenate(colors).reshape(camera.height, camera.width, 3)
            depth = np.concatenate(depths).reshape(x.shape).astype(np.float32)
            RENDERED[key] = Preview(0, camera, rgba, depth, 1, True, STEPS, "fine", mode)
        return RENDERED[key]

    def request_view(self, request: ViewRequest) -> None:
        self.views.append(request)
        if self.answering:
            self.answer(self.stride)

    def answer(self, stride: int) -> None:
        """Answer the newest request."""
        request = self.views[-1]
        truth = self.truth(request.camera, request.mode)
        part = np.s_[::stride, ::stride]
        preview = replace(
            truth, stamp=request.stamp, rgba=truth.rgba[part].copy(), depth=truth.depth[part].copy(), stride=stride,
            complete=stride == 1, step=self.step, model=self.model,
        )  # fmt: skip
        self.current = replace(self.current, preview=preview, step=self.step)


class Clock:
    """A clock that stands until it is moved on."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


CLOCK = Clock()


class Quick(Pacer):
    """One for which frames take no time, however busy the machine is."""

    def drew(self, now: float, seconds: float = 0.0, part: float = 1.0) -> None:
        super().drew(now, 0.0, part)


@pytest.fixture
def opened(offscreen: Callable[..., Window], trainer: Trainer) -> Iterator[Open]:
    apps: list[App] = []

    def open_app() -> tuple[App, Models]:
        for app in apps:
            app.close()
        worker = Models(trainer)
        app = App(offscreen(SIZE), worker, time=CLOCK)
        apps.append(app)
        app.state.show_samples = app.state.show_cameras = app.state.show_panels = False
        worker.answering = False
        app.settle(3)
        worker.answering = True
        wait(app, 1.0)
        app.state.camera.orbit(40, 25, SIZE[1])  # away from the photo's own camera
        wait(app, 1.0)
        assert not app.stale
        return app, worker

    yield open_app
    for app in apps:
        app.close()


def wait(app: App, seconds: float) -> None:
    for _ in range(round(seconds * 20)):
        frame(app, 1 / 20)


def frame(app: App, seconds: float = 1 / 60) -> None:
    CLOCK.now += seconds
    app.frame(force=True)


def shown(app: App) -> np.ndarray:
    """The viewport without the line of text at its bottom, (H, W, 3)."""
    left, top, right, bottom = (int(v) for v in app.widgets["viewport"])
    return app.window.read_pixels()[top : bottom - 60, left:right].astype(float)


def true(app: App, worker: Models, mode: str = COLOR) -> np.ndarray:
    picture = worker.truth(app.state.camera.camera(*app.state.viewport), mode).rgba
    return picture[:-60, :, :3].astype(float)


def error(picture: np.ndarray, truth: np.ndarray) -> Error:
    """The mean absolute error, and that on edges."""
    apart, edges = np.abs(picture - truth).mean(-1), gradient(truth) > 8
    return float(apart.mean()), float(apart[edges].mean())


def gradient(picture: np.ndarray) -> np.ndarray:
    return np.hypot(*np.gradient(picture.mean(-1)))


def drag(app: App, worker: Models, frames: int, *, every: int = 2) -> tuple[list[Error], list[float]]:
    """Orbit by small steps; return each frame's error, and its sharpness: its mean gradient over the true one's.

    every: the worker answers every so many frames, always a frame late. 0: it does not.
    """
    errors, sharpness = [], []
    for k in range(frames):
        app.state.camera.orbit(TURN, 0.2 * TURN, SIZE[1])
        frame(app)
        truth, picture = true(app, worker), shown(app)
        errors.append(error(picture, truth))
        sharpness.append(float(gradient(picture).mean() / gradient(truth).mean()))
        if every and k % every == 0:
            worker.answer(worker.stride)
    return errors, sharpness


@pytest.mark.thorough(17)
@pytest.mark.parametrize("stride", [32, 8])
def test_a_drag_never_shows_worse_than_the_sharp_picture_warped_or_the_newest_one(opened: Open, stride: int) -> None:
    runs = {}
    for name, first, every in (("both", 1, 2), ("warped", 1, 0), ("newest", stride, 2)):
        app, worker = opened()
        worker.answering, worker.stride = False, stride
        worker.model += 1  # the sharp picture that `opened` left is that of another model
        worker.answer(first)
        wait(app, 0.5)
        runs[name] = drag(app, worker, 30, every=every)
    errors, sharpness = runs["both"]
    for k, (mean, edges) in enumerate(errors):
        (mean_warped, edges_warped), (mean_newest, edges_newest) = runs["warped"][0][k], runs["newest"][0][k]
        assert mean <= 1.05 * min(mean_warped, mean_newest) + 0.1, k  # both are mixed where they are alike
        assert edges <= 1.15 * min(edges_warped, edges_newest) + 0.1, k
    assert max(abs(a - b) for a, b in pairwise(sharpness)) < 0.08  # no frame looks much softer or more blocky


def test_after_a_drag_the_picture_sharpens_without_a_step_back_or_a_pop(opened: Open) -> None:
    app, worker = opened()
    worker.answering, worker.stride = False, COARSE
    drag(app, worker, 12)
    wait(app, 0.5)
    truth = true(app, worker)
    before = shown(app)
    errors, changes = [error(before, truth)[0]], []
    for stride in (16, 8, 4, 2, 1):
        worker.answer(stride)
        for _ in range(15):  # a quarter of a second
            frame(app)
            picture = shown(app)
            changes.append(float(np.abs(picture - before).mean()))
            errors.append(error(picture, truth)[0])
            before = picture
    assert all(after <= 1.02 * earlier + 0.02 for earlier, after in pairwise(errors))
    assert max(changes) < 0.2 * errors[0]  # of the whole way from the first picture to the true one
    np.testing.assert_array_equal(before, truth)
    assert not app.stale


def test_a_finer_picture_keeps_an_idle_window_drawing_until_it_has_faded_in(opened: Open) -> None:
    app, worker = opened()
    app._pacer = Quick(watched=True)
    worker.answering = False
    app.state.camera.orbit(20, 0, SIZE[1])
    wait(app, 0.5)
    for stride in (8, 1):
        worker.answer(stride)
        drew = []
        for _ in range(120):
            CLOCK.now += 1 / 60
            drew.append(app.frame())
        assert sum(drew[:30]) >= 6
        assert not any(drew[60:])
    np.testing.assert_array_equal(shown(app), true(app, worker))


def test_a_coarse_picture_of_a_distant_view_shows_nothing_of_the_one_before(opened: Open) -> None:
    app, worker = opened()
    worker.answering = False
    scene = worker.trainer.scene
    here = app.state.camera.c2w()[:, 2]
    opposite = min(scene.split("train"), key=lambda k: float(scene.views[k].camera.c2w[:, 2] @ here))
    app.perform(GoToView(opposite))
    wait(app, 1.0)
    assert app.stale
    worker.answer(16)
    frame(app)
    first = shown(app)
    wait(app, 1.0)
    assert np.abs(shown(app) - first).mean() < 0.2  # all of it is there in the first frame
    assert not app.stale
    assert error(first, true(app, worker))[0] < 0.5 * error(np.full_like(first, 255), true(app, worker))[0]


def test_a_turn_on_the_spot_fills_what_was_outside_with_new_pixels(opened: Open) -> None:
    app, worker = opened()
    worker.answering = False
    camera = app.state.camera
    camera.focus(camera.pivot + 0.25 * camera.distance * camera.c2w()[:, 0])
    wait(app, 0.5)
    worker.answer(16)
    wait(app, 0.5)
    apart = np.abs(shown(app) - true(app, worker)).mean(-1)
    middle = apart.shape[1] // 2
    assert app.stale
    assert apart[:, :middle].mean() < 1.5  # sharp: the angle between a point's rays is 0
    assert apart[:, middle:].mean() < 3.0


def test_while_training_an_old_picture_is_kept_for_a_third_more_steps_and_six_seconds_at_rest(opened: Open) -> None:
    app, worker = opened()
    worker.answering = False
    app.state.camera.orbit(6, 0, SIZE[1])
    wait(app, 0.5)
    worker.step += 1
    worker.answer(8)
    wait(app, 4.0)
    assert app.stale
    wait(app, 4.0)
    assert not app.stale

    app, worker = opened()
    worker.answering = False
    app.state.camera.orbit(6, 0, SIZE[1])
    wait(app, 0.5)
    worker.step += STEPS // 10
    worker.answer(4)
    wait(app, 0.5)
    assert app.stale
    worker.step = 2 * STEPS  # 2^2.4: the old picture counts as one of stride 5
    worker.answer(4)
    wait(app, 0.5)
    assert not app.stale


def test_while_paused_an_old_picture_is_kept_until_new_pixels_are_as_sharp(opened: Open) -> None:
    app, worker = opened()
    worker.answering = False
    app.state.camera.orbit(6, 0, SIZE[1])
    wait(app, 0.5)
    worker.answer(8)
    wait(app, 20.0)
    assert app.stale


def test_another_mode_or_model_shows_nothing_of_the_picture_before(opened: Open) -> None:
    for change in ("mode", "model"):
        app, worker = opened()
        worker.answering = False
        app.state.camera.orbit(6, 0, SIZE[1])
        wait(app, 0.5)
        if change == "mode":
            app.state.mode = mode_names()[1]
            wait(app, 0.5)
        else:
            worker.model += 1
        worker.answer(8)
        frame(app)
        first = shown(app)
        assert not app.stale
        wait(app, 1.0)
        np.testing.assert_array_equal(shown(app)[60:], first[60:])  # below a line that says what the mode shows


def test_a_window_that_is_resized_during_a_drag_goes_on(opened: Open) -> None:
    app, worker = opened()
    worker.answering, worker.stride = False, COARSE
    drag(app, worker, 6)
    app.state.show_panels = True  # the docks take a part of the viewport
    wait(app, 0.5)
    app.state.show_panels = False
    wait(app, 0.5)
    errors, _ = drag(app, worker, 6)
    assert max(mean for mean, _ in errors) < 4
    worker.answer(1)
    wait(app, 0.5)
    np.testing.assert_array_equal(shown(app), true(app, worker))
