"""A worker that answers at once, always in the same way: a ball on a checkered ground, in closed form."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.live.messages import (
    Command,
    EditPin,
    History,
    Inspect,
    Notice,
    Pause,
    Pin,
    PinRay,
    Preview,
    Snapshot,
    StopInspecting,
    Train,
    UnpinRay,
    ViewRequest,
)
from nerf_core.probe import SPHERE_COLUMNS, SPHERE_ROWS, Opened, PassProbe, RadianceProbe, RayProbe, Verdict, disc_grid

BALL, GROUND_SIZE = 1.0, 3.0
BACKGROUND = (1.0, 1.0, 1.0)


def pinhole(width: int, height: int, eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    """A camera at `eye` that looks at `target`, z up, with a vertical field of view of 45°."""
    back = np.subtract(eye, target).astype(float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    c2w = np.stack([right, np.cross(back, right), back, np.asarray(eye, float)], -1)
    focal = height / 2 / np.tan(np.radians(45) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2, c2w)


def make_scene() -> Scene:
    angles = np.arange(8) * 2 * np.pi / 8
    cameras = [pinhole(40, 30, (5 * np.cos(a), 5 * np.sin(a), 3.0), (0.0, 0.0, 0.3)) for a in angles]
    return Scene(
        name="ball", format="scripted", views=tuple(View(f"view {k}", c) for k, c in enumerate(cameras)),
        photos=Photos.of([np.full((30, 40, 3), 65535, np.uint16) for _ in cameras]),
        splits={"train": (0, 1, 2, 3, 4, 5), "test": (6, 7)}, near=1.0, far=12.0, background=BACKGROUND,
        center=np.array([0.0, 0.0, 0.3]), radius=2.0, up=np.array([0.0, 0.0, 1.0]), to_input=np.eye(4),
    )  # fmt: skip


def trace(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what rays with unit directions (3, R) hit first: distance (R,), NaN for a miss, and colour (3, R)."""
    ahead = origin @ directions
    root = ahead**2 - (origin @ origin - BALL**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        ball = np.where(root > 0, -ahead - np.sqrt(np.maximum(root, 0)), np.inf)
        ground = -(origin[2] + 0.7) / directions[2]
    ball[~(ball > 0)] = np.inf
    x, y = origin[:2, None] + np.where(np.isfinite(ground), ground, 0) * directions[:2]
    ground[~((ground > 0) & (np.abs(x) < GROUND_SIZE) & (np.abs(y) < GROUND_SIZE))] = np.inf
    t = np.minimum(ball, ground)
    checks = (np.floor(x) + np.floor(y)) % 2
    lamp = np.array([0.5, -0.3, 0.8])
    facing = (lamp @ origin + np.where(np.isfinite(ball), ball, 0) * (lamp @ directions)) / BALL
    shade = 0.35 + 0.65 * np.clip(facing, 0, 1)
    color = np.where(ball < ground, np.array([[0.85], [0.35], [0.25]]) * shade, 0.35 + 0.35 * checks)
    missed = ~np.isfinite(t)
    t[missed] = np.nan
    color[:, missed] = np.array(BACKGROUND)[:, None]
    return t, color


def rays(camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions (3, R) through pixel centres, and the z-depth (R,) of a unit step along each."""
    local = np.stack([(x + 0.5 - camera.cx) / camera.fx, -(y + 0.5 - camera.cy) / camera.fy, -np.ones(x.shape)])
    length = np.sqrt(local[0] ** 2 + local[1] ** 2 + 1)
    return camera.c2w[:, :3] @ (local / length), 1 / length


def render(request: ViewRequest, stride: int = 1) -> Preview:
    camera = request.camera
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    rgba, depth = _picture(camera.width, camera.height, lens, camera.c2w.tobytes(), stride)
    return Preview(request.stamp, camera, rgba, depth, stride, True, 100, "fine")


@lru_cache(maxsize=16)  # most tests use the camera with which the window starts
def _picture(
    width: int, height: int, lens: tuple[float, float, float, float], c2w: bytes, stride: int
) -> tuple[np.ndarray, np.ndarray]:
    camera = Camera(width, height, *lens, np.frombuffer(c2w).reshape(3, 4))
    rows, columns = np.arange(0, camera.height, stride), np.arange(0, camera.width, stride)
    rgba = np.full((len(rows), len(columns), 4), 255, np.uint8)
    depth = np.empty(rgba.shape[:2], np.float32)
    for k in range(0, len(rows), 8):  # so few rays fit in the processor's cache, which is twice as fast
        y, x = np.meshgrid(rows[k : k + 8], columns, indexing="ij")
        directions, z = rays(camera, x.ravel(), y.ravel())
        t, color = trace(camera.c2w[:, 3], directions)
        rgba[k : k + 8, :, :3] = np.round(color.T.reshape(*x.shape, 3) * 255)
        depth[k : k + 8] = (t * z).reshape(x.shape)
    rgba.flags.writeable = depth.flags.writeable = False
    return rgba, depth


def open_ray(inspect: Inspect) -> tuple[RayProbe, RadianceProbe]:
    """Open a ray with 64 samples, whose density peaks 0.1 behind the surface that it hits."""
    camera, (x, y) = inspect.camera, inspect.pixel
    directions, _ = rays(camera, np.array([x]), np.array([y]))
    origin = camera.c2w[:, 3]
    hit, color = trace(origin, directions)
    t = np.linspace(1.0, 12.0, 65)
    delta, t = np.diff(t), t[:-1]
    surface = float(hit[0])
    sigma = np.zeros(64) if np.isnan(surface) else 12 * np.exp(-(((t - surface - 0.1) / 0.25) ** 2))
    alpha = 1 - np.exp(-sigma * delta)
    transmittance = np.concatenate([[1.0], np.cumprod(1 - alpha)[:-1]])
    weights = alpha * transmittance
    opened = PassProbe("fine", t, t + delta, delta, sigma, alpha, transmittance, weights, np.tile(color.T, (64, 1)))
    opacity = float(weights.sum())
    rendered = weights @ opened.rgb + (1 - opacity) * np.asarray(BACKGROUND)
    median = None if opacity < 0.5 else surface
    probe = RayProbe(
        100, inspect.pixel, origin, directions[:, 0], 1.0, 12.0, (opened,), rendered, opacity, median, median,
        float(t[weights.argmax()]), rendered, np.asarray(BACKGROUND),
    )  # fmt: skip
    point_t = inspect.point_t or probe.point_t()
    return probe, _radiance(camera, origin + point_t * directions[:, 0], point_t, color[:, 0])


def _radiance(camera: Camera, point: np.ndarray, t: float, color: np.ndarray) -> RadianceProbe:
    polar, azimuth = np.meshgrid(
        (np.arange(SPHERE_ROWS) + 0.5) / SPHERE_ROWS * np.pi,
        (np.arange(SPHERE_COLUMNS) + 0.5) / SPHERE_COLUMNS * 2 * np.pi,
        indexing="ij",
    )
    around = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    x, y, inside = disc_grid()
    facing = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)[inside] @ camera.c2w[:, :3].T
    directions = np.concatenate([around.reshape(-1, 3), facing])
    gloss = np.clip(directions @ np.array([0.5, -0.3, 0.8]), 0, 1)[:, None] ** 8
    rgb = np.clip(color + 0.5 * gloss, 0, 1).astype(np.float32)
    up, first = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    axes = camera.c2w[:, :3].T.copy()
    layer = np.array([t - 0.1, t + 0.1])
    return RadianceProbe(
        100, point, t, directions, rgb, color, 0.1, layer, rgb, color, 0.1, rgb, axes, up, first, axes[2], "viewer",
        "layer",
    )  # fmt: skip


class ScriptedWorker:
    """Has the interface of `nerf_core.live.worker.Worker`. sent, views: the commands and requests in order."""

    def __init__(self, scene: Scene | None = None) -> None:
        steps = np.arange(0, 101, dtype=np.int64)
        loss = (0.1 * np.exp(-steps / 30)).astype(np.float32)
        history = History(steps, loss, (-10 * np.log10(loss)).astype(np.float32))
        self.current = Snapshot(status="empty")
        if scene is not None:
            self.current = Snapshot(
                status="ready", loaded=1, scene=scene, method="nerf", device="CPU", step=100,
                total_steps=30_000, seconds=12.0, rays_per_second=64_000.0, seconds_left=70.0,
                memory_bytes=512 << 20, history=history,
            )  # fmt: skip
        self.sent: list[Command] = []
        self.views: list[ViewRequest] = []
        self.answering = True
        self.stride = 1
        self.waiting_notices: list[Notice] = []

    def send(self, command: Command) -> int:
        self.sent.append(command)
        match command:
            case Train():
                self.current = replace(self.current, status="training")
            case Pause():
                self.current = replace(self.current, status="paused")
            case Inspect():
                ray, radiance = open_ray(command)
                verdict = Verdict("surface", ("one layer",), ray.depth_median, (), "good")
                assert self.current.scene is not None
                opened = Opened(command.camera, self.current.scene, "scripted", ray, verdict, radiance)
                self.current = replace(
                    self.current, opened=opened, opened_step=ray.step, opened_id=command.id, opened_look=command.look
                )
            case StopInspecting():
                self.current = replace(self.current, opened=None)
            case PinRay(camera, pixel):
                ray, _ = open_ray(Inspect(camera, pixel))
                number = len(self.current.pins)
                pin = Pin(command.id, command.name or f"ray {number + 1}", number, command.hidden, camera, pixel, ray)
                self.current = replace(self.current, pins=(*self.current.pins, pin))
            case EditPin(number, name, hidden):
                pins = [self._edited(pin, name, hidden) if pin.id == number else pin for pin in self.current.pins]
                self.current = replace(self.current, pins=tuple(pins))
            case UnpinRay(number):
                left = tuple(pin for pin in self.current.pins if pin.id != number)
                self.current = replace(self.current, pins=left)
            case _:
                pass
        return len(self.sent)

    @staticmethod
    def _edited(pin: Pin, name: str | None, hidden: bool | None) -> Pin:
        return replace(pin, name=pin.name if name is None else name, hidden=pin.hidden if hidden is None else hidden)

    def request_view(self, request: ViewRequest) -> None:
        self.views.append(request)
        if self.answering:
            self.current = replace(self.current, preview=render(request, self.stride))

    def snapshot(self) -> Snapshot:
        return self.current

    def paints(self) -> None:
        pass

    def painted(self, seconds: float) -> None:
        pass

    def notices(self) -> list[Notice]:
        found, self.waiting_notices = self.waiting_notices, []
        return found
