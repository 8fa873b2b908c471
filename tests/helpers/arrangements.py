"""Captures of known worlds in eight arrangements of cameras, for the first view that the window opens with.

The worlds are axis-aligned boxes with a texture, drawn in closed form. z is up in a world; a capture has it turned into
a frame of its own, as structure from motion does, so that no axis of the input tells what is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from nerf_core.datasets.capture import Capture, Photo
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import camera_rays
from nerf_core.geometry.scene import Scene

SIZE = (160, 120)
UP = np.array([0.0, 0.0, 1.0])
SOLID, HOLLOW = 1, -1  # a box seen from outside, a room seen from inside
# An unrelated rotation: columns are where the world's axes point in the input's frame.
FRAME = np.linalg.qr(np.array([[0.3, -0.8, 0.5], [0.9, 0.2, -0.4], [0.1, 0.7, 0.8]]))[0]
FRAME = FRAME * np.sign(np.linalg.det(FRAME))
TURNS = {0: 1, 90: 6, 180: 3, 270: 8}  # degrees by which a camera is turned clockwise: the EXIF orientation to undo it


@dataclass(frozen=True)
class Box:
    """low, high: (3,) corners. side: SOLID or HOLLOW. subject: whether it is what the photos are of."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    side: int = SOLID
    subject: bool = False


@dataclass(frozen=True)
class Arrangement:
    """A world and the cameras that photograph it.

    world: its boxes. cameras: in world axes and metres.
    turns: degrees, clockwise, by which each camera is turned about its view axis.
    exif: whether the photos say how they are turned.
    unit: metres per unit of the input.
    target: (3,) the middle of what the photos are of; None: they look out of a room's middle.
    """

    world: tuple[Box, ...]
    cameras: tuple[Camera, ...]
    turns: tuple[int, ...]
    exif: bool = False
    unit: float = 1.0
    target: tuple[float, float, float] | None = (0.0, 0.0, 0.0)

    def place(self, points: np.ndarray) -> np.ndarray:
        """World points (P, 3) in the input's frame and unit."""
        return points @ FRAME.T / self.unit

    def stored(self) -> list[Camera]:
        """The cameras as a calibration states them: turned, in the input's frame and unit."""
        found = []
        for camera, turn in zip(self.cameras, self.turns, strict=True):
            held = turned(camera, turn)
            found.append(held.moved(np.column_stack([FRAME @ held.c2w[:, :3], self.place(held.c2w[:, 3])])))
        return found

    def points(self, count: int = 40) -> np.ndarray:
        """Some surface points (P, 3) that the cameras see, in world axes: every camera has `count` of them."""
        rng, found = np.random.default_rng(1), []
        for camera in self.cameras:
            rays = camera_rays(camera, 0.01, 100.0)
            some = rng.choice(len(rays), count, replace=False)
            o, d = (v.double().numpy()[some] for v in (rays.origins, rays.directions))
            t, _, _ = meet(self.world, o, d)
            found.append((o + t[:, None] * d)[np.isfinite(t)])
        return np.concatenate(found)

    def capture(self, points: bool = True) -> Capture:
        """The capture as a format would read it, without photos on disk."""
        photos = tuple(
            Photo(f"{k}.png", Path(f"{k}.png"), camera, orientation=TURNS[turn] if self.exif else 1)
            for k, (camera, turn) in enumerate(zip(self.stored(), self.turns, strict=True))
        )
        return Capture("colmap", photos, points=self.place(self.points()) if points else None)


def in_world(camera: Camera, scene: Scene, truth: Arrangement) -> Camera:
    """A camera of the scene, in the axes and metres of the world."""
    linear, offset = scene.to_input[:3, :3], scene.to_input[:3, 3]
    turn = FRAME.T @ linear / np.cbrt(np.linalg.det(linear))
    eye = FRAME.T @ (linear @ camera.c2w[:, 3] + offset) * truth.unit
    return camera.moved(np.column_stack([turn @ camera.c2w[:, :3], eye]))


def meet(
    world: Sequence[Box], origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays (R, 3) first meet a world: t (R,), infinite beside it; the face's axis (R,); the box's index (R,)."""
    t, axis, index = np.full(len(origins), np.inf), np.zeros(len(origins), int), np.full(len(origins), -1)
    safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)  # a ray along a face never meets it
    for k, box in enumerate(world):
        ends = np.stack([np.array(box.low) - origins, np.array(box.high) - origins]) / safe
        enter, leave = ends.min(0), ends.max(0)
        first, last = enter.max(1), leave.min(1)
        at, face = (first, enter.argmax(1)) if box.side == SOLID else (last, leave.argmin(1))
        nearer = (first < last) & (at > 1e-9) & (at < t)
        t, axis, index = np.where(nearer, at, t), np.where(nearer, face, axis), np.where(nearer, k, index)
    return t, axis, index


def draw(world: Sequence[Box], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photo: colours (H, W, 3) uint8, the distance along each ray (H, W), and the box that it meets (H, W)."""
    rays = camera_rays(camera, 0.01, 100.0)
    o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
    t, axis, index = meet(world, o, d)
    x = o + np.where(np.isfinite(t), t, 0)[:, None] * d
    shade, rng = np.zeros(len(x)), np.random.default_rng(0)
    for which in range(3):
        on = axis == which
        for cells, weight in ((3.0, 0.6), (9.0, 0.4)):  # cells a metre: coarse ones for a blurred picture, fine ones
            texture = rng.uniform(size=(64, 64))
            i, j = np.floor(np.delete(x[on], which, 1).T * cells + 0.013).astype(int)
            shade[on] += weight * texture[i % 64, j % 64]
    hues = np.random.default_rng(3).uniform(0.35, 1.0, (len(world) + 1, 3))[index]
    color = (0.25 + 0.75 * shade[:, None]) * hues * (1 - 0.15 * axis[:, None])
    color[~np.isfinite(t)] = (0.65, 0.75, 0.9)  # sky
    shape = camera.height, camera.width
    return np.rint(255 * color).astype(np.uint8).reshape(*shape, 3), t.reshape(shape), index.reshape(shape)


def looking(
    eye: np.ndarray | Sequence[float],
    target: np.ndarray | Sequence[float],
    up: Sequence[float] = (0, 0, 1),
    focal: float = 1.0,
) -> Camera:
    """A camera at `eye` with its axis through `target`; focal in picture widths."""
    back = np.subtract(eye, target).astype(np.float64)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    width, height = SIZE
    c2w = np.column_stack([right, np.cross(back, right), back, np.asarray(eye, np.float64)])
    return Camera(width, height, focal * width, focal * width, width / 2, height / 2, c2w)


def turned(camera: Camera, degrees: int) -> Camera:
    """The camera turned clockwise about its view axis, by a multiple of 90°. Its picture is the same scene, turned."""
    c, s = np.round((np.cos(np.radians(degrees)), np.sin(np.radians(degrees))))
    x, y, rest = camera.c2w[:, 0], camera.c2w[:, 1], camera.c2w[:, 2:]
    c2w = np.column_stack([c * x - s * y, s * x + c * y, rest])
    return camera.moved(c2w)


# ---- worlds and cameras ----------------------------------------------------------------------------------------

OBJECT = (
    Box((-0.7, -0.5, -0.6), (0.7, 0.5, 0.6), subject=True),
    Box((-4.0, -4.0, -0.9), (4.0, 4.0, -0.6)),
)
ROOM = (
    Box((-3.0, -2.5, -1.4), (3.0, 2.5, 1.4), HOLLOW),
    Box((1.8, -2.5, -1.4), (3.0, -1.5, -0.5)),
    Box((-3.0, 1.2, -1.4), (-2.2, 2.5, 0.4)),
)
CORRIDOR = (
    Box((-1.2, -1.0, -1.3), (1.2, 14.0, 1.3), HOLLOW),
    Box((-1.2, 5.0, -1.3), (-0.8, 6.0, 0.2)),
    Box((0.8, 9.0, -1.3), (1.2, 10.0, 0.6)),
)
TOWN = (
    Box((-30.0, -30.0, -1.0), (30.0, 30.0, 0.0)),
    *(
        Box((x, y, 0.0), (x + 1.2, y + 1.4, 0.6 + 0.2 * k), subject=True)
        for k, (x, y) in enumerate([(-3.1, -3.0), (-0.6, -3.2), (2.0, -2.8), (-3.3, 0.2), (-0.5, -0.4), (2.2, 0.6),
                                    (-2.8, 2.6), (0.1, 2.4), (2.4, 3.0)])
    ),
)  # fmt: skip


def ring(count: int = 24) -> tuple[Camera, ...]:
    """All around the object, looking down on it by 20° to 30°."""
    found = []
    for k in range(count):
        angle, height = 2 * np.pi * k / count, 1.35 + 0.15 * (k % 3)
        found.append(looking((3.2 * np.cos(angle), 3.2 * np.sin(angle), height), (0.05 * (k % 2), 0.0, -0.05)))
    return tuple(found)


def outward(count: int = 36) -> tuple[Camera, ...]:
    """From places near the middle of the room, in all directions, up or down by up to 20°."""
    rng, found = np.random.default_rng(0), []
    for k in range(count):
        eye = rng.uniform(-0.35, 0.35, 3) * (3.0, 2.5, 1.4)
        yaw, pitch = 2 * np.pi * k / count, rng.uniform(-0.35, 0.35)
        aim = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        found.append(looking(eye, eye + aim, focal=0.7))
    return tuple(found)


def walk(count: int = 28) -> tuple[Camera, ...]:
    """Along the corridor, looking ahead; the hand turns by a few degrees."""
    rng, found = np.random.default_rng(0), []
    for k in range(count):
        eye = np.array([0.3 * np.sin(k), 0.0 + 7.0 * k / count, 0.1 * np.cos(2 * k)])
        found.append(looking(eye, eye + np.array([0.07 * rng.normal(), 1.0, 0.07 * rng.normal()]), focal=0.8))
    return tuple(found)


def flight(strips: int = 5, shots: int = 6, turn: bool = True) -> tuple[Camera, ...]:
    """Straight down, strip beside strip. At the end of a strip the aircraft turns about, and its photos with it."""
    rng, found = np.random.default_rng(0), []
    for row in range(strips):
        for k in range(shots):
            back = turn and row % 2
            x, y = -4.0 + 8.0 * (shots - 1 - k if back else k) / (shots - 1), -4.0 + 8.0 * row / (strips - 1)
            aim = np.array([x, y, 0.0]) + rng.normal(0, 0.15, 3) * (1, 1, 0)
            found.append(looking((x, y, 8.0), aim, (-1 if back else 1, 0.02, 0.0), focal=0.9))
    return tuple(found)


def arrangements() -> dict[str, Arrangement]:
    """The eight kinds, by name."""
    around, count = ring(), len(ring())
    inside, along, above = outward(), walk(), flight()
    return {
        "inward": Arrangement(OBJECT, around, (0,) * count),
        "sideways": Arrangement(OBJECT, around, (90,) * count),
        "upside down": Arrangement(OBJECT, around, (180,) * count, exif=True),
        "outward": Arrangement(ROOM, inside, (0,) * len(inside), target=None),
        "corridor": Arrangement(CORRIDOR, along, (0,) * len(along), target=(0.0, 14.0, 0.0)),
        "aerial": Arrangement(TOWN, above, (0,) * len(above), target=(0.0, 0.0, 0.3)),
        "millimetres": Arrangement(OBJECT, around, (0,) * count, unit=1e-3),
        "kilometres": Arrangement(OBJECT, around, (0,) * count, unit=1e3),
    }


# ---- on disk ---------------------------------------------------------------------------------------------------


def write(folder: Path, arrangement: Arrangement) -> Path:
    """Write photos and a COLMAP model in text, with points; the EXIF orientation is in the photos if they have one."""
    (folder / "images").mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    rows, cameras = [], arrangement.stored()
    for k, (camera, turn) in enumerate(zip(arrangement.cameras, arrangement.turns, strict=True)):
        name = f"{k:03}.jpg"
        photo = Image.fromarray(draw(arrangement.world, turned(camera, turn))[0])
        exif = Image.Exif()
        exif[0x0112] = TURNS[turn] if arrangement.exif else 1
        photo.save(folder / "images" / name, quality=95, exif=exif)
        rotation = cameras[k].c2w[:, :3].T * np.array([[1], [-1], [-1]])  # OpenCV's axes: y down, z forward
        pose = [*quaternion(rotation), *(-rotation @ cameras[k].c2w[:, 3])]
        rows += [f"{k + 1} {' '.join(map(repr, map(float, pose)))} 1 {name}", ""]
    points = arrangement.place(arrangement.points())
    c = cameras[0]
    (folder / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    (folder / "sparse/0/images.txt").write_text("\n".join(rows) + "\n")
    (folder / "sparse/0/points3D.txt").write_text(
        "".join(f"{k + 1} {float(x)!r} {float(y)!r} {float(z)!r} 9 9 9 0.5\n" for k, (x, y, z) in enumerate(points))
    )
    return folder


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) by the eigenvector of Bar-Itzhack's matrix, exact at every angle."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array([[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
                  [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]])  # fmt: skip
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])
