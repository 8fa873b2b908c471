"""Made-up data for panels: a scene, a ray through fog to a wall, a point with view-dependent colour, odd states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from nerf_core.captures.records import COPYING, PLACED, STAGES, Growing, PoseProgress
from nerf_core.captures.report import capture_report
from nerf_core.captures.report_records import CaptureReport, Finding, ReportState
from nerf_core.captures.video_frames import LOOKING
from nerf_core.common.language import digits, phrase
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View
from nerf_core.lab.records import Curve, Knob, Look, RowState, StudyState, Table
from nerf_core.live.messages import Export, History, Inspect, Notice, Pin, Preview, Snapshot, Status
from nerf_core.methods.stages import BarCode, Colors, Marks, Pictures, Stage, Stems, Transfer
from nerf_core.probe import (
    SPHERE_COLUMNS,
    SPHERE_ROWS,
    Layer,
    Opened,
    PassProbe,
    RadianceProbe,
    RayHistory,
    RayProbe,
    Sightings,
    Standing,
    Verdict,
    disc_grid,
)
from nerf_core.training.autosaves import Autosave
from viewer.model.state import AppState, ShownNotice


def make_camera(eye: np.ndarray) -> Camera:
    """A camera at `eye` that looks at the origin, z up."""
    back = eye / np.linalg.norm(eye)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    return Camera(200, 150, 210, 210, 100, 75, np.column_stack([right, np.cross(back, right), back, eye]))


def make_scene(count: int = 24) -> Scene:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [4 * np.array([np.cos(a) * 0.8, np.sin(a) * 0.8, 0.6]) for a in angles]
    views = tuple(View(f"train/r_{i}.png", make_camera(eye)) for i, eye in enumerate(eyes))
    photos = Photos.of([np.zeros((150, 200, 3), np.uint16)] * count)
    splits = {"train": tuple(range(count - 4)), "test": tuple(range(count - 4, count))}
    return Scene(
        name="spheres", format="blender", views=views, photos=photos, splits=splits, near=2.0, far=6.0,
        background=(1, 1, 1), center=np.zeros(3), radius=1.5, up=np.array([0.0, 0, 1]), to_input=np.eye(4),
        notes=("17 of 67 images are missing: skipped",),
    )  # fmt: skip


def make_pass(name: str, t: np.ndarray, surface: float, density: float) -> PassProbe:
    """The samples `t` (S,) through fog in front of a wall at `surface`."""
    sigma = density / (1 + np.exp(-(t - surface) * 60)) + 0.05 * np.maximum(np.sin(9 * t), 0)
    delta = np.append(np.diff(t), 1e10)
    alpha = 1 - np.exp(-sigma * delta)
    transmittance = np.cumprod(np.append(1, 1 - alpha[:-1]))
    rgb = np.stack([0.5 + 0.4 * np.sin(3 * t), 0.5 + 0.3 * np.cos(2 * t), np.full_like(t, 0.25)], -1)
    arrays = (t, t + delta, delta, sigma, alpha, transmittance, alpha * transmittance, rgb)
    return PassProbe(name, *(a.astype(np.float32) for a in arrays))


def make_ray(density: float = 40.0, step: int = 12_400) -> RayProbe:
    rng = np.random.default_rng(1)
    coarse = make_pass("coarse", np.linspace(2.02, 5.98, 64), 3.8, density)
    fine_t = np.sort(np.concatenate([coarse.t, rng.normal(3.85, 0.06, 128)]))
    fine = make_pass("fine", fine_t, 3.8, density)
    if density == 0:
        nothing = np.zeros_like(fine.sigma)
        fine = replace(fine, sigma=nothing, alpha=nothing, weights=nothing, transmittance=nothing + 1)
    color = fine.weights @ fine.rgb + (1 - fine.weights.sum())
    total, accumulated = float(fine.weights.sum()), np.cumsum(fine.weights)
    camera = make_camera(np.array([3.2, 0, 2.4]))
    return RayProbe(
        step=step, pixel=(412, 233), origin=camera.c2w[:, 3], direction=-camera.c2w[:, 2], near=2.0, far=6.0,
        passes=(coarse, fine), color=color, opacity=total,
        depth_expected=float(fine.weights @ fine.t) / total if total else None,
        depth_median=float(fine.t[np.searchsorted(accumulated, 0.5)]) if total > 0.5 else None,
        depth_strongest=float(fine.t[fine.weights.argmax()]),
        rendered_color=color + 3e-8, background=np.ones(3),
    )  # fmt: skip


def make_radiance(ray: RayProbe) -> RadianceProbe:
    """The radiance rgb = 0.5 − 0.5 v, where v is the direction from the point outwards."""
    t = ray.point_t()
    up, azimuth0 = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    polar, azimuth = np.meshgrid(
        (np.arange(SPHERE_ROWS) + 0.5) / SPHERE_ROWS * np.pi,
        (np.arange(SPHERE_COLUMNS) + 0.5) / SPHERE_COLUMNS * 2 * np.pi,
        indexing="ij",
    )
    sphere = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    towards = -ray.direction
    right = np.cross(up, towards) / np.linalg.norm(np.cross(up, towards))
    axes = np.stack([right, np.cross(towards, right), towards])
    x, y, inside = disc_grid()
    disc = np.stack([x[inside], y[inside], np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2)], -1) @ axes
    directions = np.concatenate([sphere.reshape(-1, 3), disc])
    point = ray.origin + t * ray.direction
    rgb = (0.5 - 0.5 * directions).astype(np.float32)
    return RadianceProbe(
        ray.step, point, t, directions, rgb, 0.5 - 0.5 * towards, 0.21, np.array([t - 0.1, t + 0.1]), rgb,
        0.4 - 0.4 * towards, 0.17, 0.9 * rgb, axes, up, azimuth0, axes[2], "viewer", "layer",
    )  # fmt: skip


def make_evidence(scene: Scene, radiance: RadianceProbe) -> Sightings:
    """The evidence of twelve photos. In every fourth, something hides the point."""
    views = np.array(scene.split("train")[:12])
    count = len(views)
    directions = np.array([scene.views[i].camera.c2w[:, 3] - radiance.point for i in views])
    distance = np.linalg.norm(directions, axis=1)
    rgb = np.linspace(0.2, 0.8, 3 * count).reshape(count, 3).astype(np.float32)
    hidden = np.arange(count) % 4 == 3
    return Sightings(
        radiance.point, 0.04, len(scene.split("train")), count, 0, views, np.tile([100.5, 75.5], (count, 1)), distance,
        np.linspace(0, 1.5, count), directions / distance[:, None], np.where(hidden, 0.1, 0.95), np.full(count, 0.9),
        rgb, np.ones_like(rgb), rgb + 0.02, rgb - 0.02, rgb - 0.05,
    )  # fmt: skip


def make_opened(ray: RayProbe) -> Opened:
    scene, radiance = make_scene(), make_radiance(ray)
    evidence = make_evidence(scene, radiance)
    layer = Layer(3.2, 3.17, 3.1, 3.3, 0.1, 0.03, 0.4, 1.0, np.array([0.9, 0.1, 0.1]))
    standing = Standing(layer, evidence, 9, 11, 11, 8, 2, 1, 9, 0.2, 0.03, 0.3, 0.1)
    reasons = (
        "a layer behind makes 40% of the pixel, but of 11 photos that see it 8 contradict it and 2 would miss it",
    )
    verdict = Verdict("floater", reasons, 3.8, (standing,), "warning")
    t = np.linspace(2, 6, 9)
    walk = (
        Stage("Camera and pixel", "A sentence.", rows=(("pixel", "412, 233"),)),
        Stage("Samples", "Another sentence.", (Marks(t, t[:4]), Stems("w", t, t / 10))),
        Stage("Encoding", "A third.", (BarCode(("γ(x)", "γ(d)"), (np.sin(t), np.cos(t)), 1.0),)),
        Stage("Resampling", "A fourth.", (Transfer(t, np.linspace(0, 1, 9), np.linspace(0, 1, 5), t[::2]),)),
        Stage("Planes", "A fifth.", (make_pictures(4),), (("planes", "4"),)),
        Stage("Pixel", "The last.", (Colors(("model", "photo"), np.array([[1, 0, 0], [0.9, 0.1, 0]])),)),
    )
    return Opened(make_camera(np.array([3.2, 0, 2.4])), scene, "nerf", ray, verdict, radiance, evidence, walk)


def make_ray_history() -> RayHistory:
    steps = np.array([0, 1, 2, 5, 11, 40, 130, 900, 12_000])
    weights = np.random.default_rng(0).random((len(steps), 96)).astype(np.float32) / 96
    color = np.linspace(0, 1, 3 * len(steps)).reshape(-1, 3)
    depth = np.where(steps < 2, np.nan, 3.8)
    return RayHistory(np.linspace(2, 6, 97), steps, weights, color, depth, np.linspace(0, 1, len(steps)))


def make_history(last: int = 12_400) -> History:
    step = np.arange(100, last, 100)
    psnr = 30 - 20 * np.exp(-step / 3000) + np.random.default_rng(0).normal(0, 0.6, len(step))
    return History(step, (10 ** (-psnr / 10)).astype(np.float32), psnr.astype(np.float32))


def make_pins(ray: RayProbe) -> tuple[Pin, ...]:
    camera = make_camera(np.array([3.2, 0, 2.4]))
    return (
        Pin(1, "the wall", 0, False, camera, ray.pixel, ray, make_ray_history()),
        Pin(2, "another", 5, True, camera, ray.pixel),
    )


def make_snapshot(status: Status = "training", density: float = 40.0) -> Snapshot:
    ray = make_ray(density)
    preview = Preview(
        3, make_camera(np.array([3.2, 0, 2.4])), np.zeros((38, 50, 4), np.uint8), np.ones((38, 50), np.float32),
        stride=4, complete=True, step=12_000, quality="coarse",
    )  # fmt: skip
    return Snapshot(
        status=status, loaded=1, scene=make_scene(), method="nerf", device="CPU", step=12_400, saved_step=10_000,
        total_steps=30_000, seconds=612.0, rays_per_second=640_123.0, seconds_left=70.2, train_share=0.62,
        memory_bytes=512 << 20, history=make_history(), preview=preview, opened=make_opened(ray), opened_step=12_400,
        opened_id=1, preview_rays_per_second=9_000.0, pins=make_pins(ray),
    )  # fmt: skip


def make_state(snapshot: Snapshot) -> AppState:
    state = AppState(
        snapshot=snapshot, time=100.0, viewport_rect=(0, 0, 700, 500), checkpoint_file="run/last.safetensors"
    )
    if snapshot.scene is not None:
        state.camera.set_scene(snapshot.scene)
    if snapshot.ray is not None:
        state.inspect = snapshot.pins[0].inspect()
    return state


def odd_ray() -> RayProbe:
    """A ray with an empty pass and a pass of one sample whose numbers are NaN or huge."""
    one = np.array([3.0], np.float32)
    nan = np.array([np.nan], np.float32)
    odd = PassProbe("packed", one, one * 1e10, one * 1e10, nan, nan, one, nan, np.full((1, 3), np.nan, np.float32))
    none = np.zeros(0)
    empty = PassProbe("packed", none, none, none, none, none, none, none, np.zeros((0, 3)))
    ray = make_ray(0.0)
    return replace(ray, passes=(empty, odd), near=3.0, far=3.0, color=np.full(3, np.nan), depth_expected=None)


def odd_opened() -> Opened:
    ray = odd_ray()
    radiance = replace(make_radiance(make_ray()), rgb=np.full_like(make_radiance(make_ray()).rgb, np.nan), normal=None)
    evidence = make_evidence(make_scene(), radiance).at(np.zeros(0, np.int64))
    nan = np.full(3, np.nan)
    charts = (Stems("w", nan, nan), Marks(nan, nan[:0]), BarCode(("γ",), (nan,), np.nan), Transfer(nan, nan, nan, nan))
    pictures = make_pictures(3)
    charts += pictures._replace(marks=np.full((3, 2), np.nan)), Pictures((), (), np.zeros((0, 2)))
    walk = (Stage("Odd", "Nothing but holes.", (*charts, Stems("w", nan[:0], nan[:0]))),)
    return Opened(make_camera(np.array([3.2, 0, 2.4])), make_scene(), "nerf", ray, None, radiance, evidence, walk)


def make_pictures(count: int) -> Pictures:
    """Pictures of 40 × 30 pixels, transparent at the left, the first opaque; the ray meets each farther right."""
    images = np.full((count, 30, 40, 4), 120, np.uint8)
    images[1:, :, :20, 3] = 0
    images[0, ..., 3] = 255
    marks = np.stack([np.linspace(5, 35, count), np.full(count, 15.0)], -1)
    return Pictures(tuple(f"plane {k}" for k in range(count)), tuple(images), marks)


def bare_ray(visits: int = 10, depth: float | None = 3.8) -> RayProbe:
    """A ray of a method without samples, which jumped to and fro until it found a surface."""
    k = np.arange(visits)
    return replace(
        make_ray(), passes=(), visited=(3.8 - 1.7 * (-0.6) ** k).astype(np.float32), depth_expected=depth,
        depth_median=None, depth_strongest=None, opacity=1.0,
    )  # fmt: skip


def bare_snapshot(ray: RayProbe, method: str = "nearest-view") -> Snapshot:
    """What a window shows of a method without samples, with a pinned ray."""
    full = make_snapshot()
    opened = replace(
        make_opened(make_ray()), ray=ray, method=method, verdict=None, radiance=None, evidence=None
    )  # fmt: skip
    history = make_ray_history()
    history = replace(history, weights=np.full_like(history.weights, np.nan))
    pin = replace(full.pins[0], ray=ray, history=history)
    return replace(full, method=method, opened=opened, pins=(pin,))


def make_study(state: Literal["running", "done", "cancelled", "failed"], name: str = "compare") -> StudyState:
    """A study with two rows, pictures, curves, a table, knobs and a figure."""
    image = np.full((6, 8, 3), 120, np.uint8)
    rows = RowState("voxels", "done"), RowState("srn", "failed", "no"), RowState("nerf", "running", "step 12")
    return StudyState(
        name, Path("lab/x"), state, rows, 0.4, "nerf: step 12", 70.0,
        looks=(Look("voxels", image, phrase("{psnr:.1f} dB", psnr=30.1)), Look("nerf", image[:, :3])),
        curves=(Curve("none", np.arange(3), np.array([1.0, np.nan, 3.0])), Curve("basic", np.zeros(0), np.zeros(0))),
        tables=(Table("Results", ("method", "PSNR"), (("voxels", digits("30.1")), ("nerf | x", "–")), ("A note.",)),),
        knobs=(Knob("L", 1, 12, 6), Knob("σ", 0.5, 64.0, 10.0)),
        files=(Path("lab/x/report.md"),) if state == "done" else (),
        figures=(Look("compare", image),) if state == "done" else (),
    )  # fmt: skip


@cache
def make_report() -> CaptureReport:
    """A report of the made-up scene, whose photos show nothing, with two photos that stand out."""
    report = capture_report(make_scene())
    soft = phrase("{share:.0%} as sharp as similar views: motion, or out of focus", share=0.12)
    odd = {3: (soft,), 5: (phrase("{stops:.1f} stops darker than similar views", stops=1.2),)}
    photos = [
        replace(p, odd=odd.get(k, ()), relative_sharpness=1 + k / 100, relative_exposure=(-1) ** k * k / 50)
        for k, p in enumerate(report.photos)
    ]
    where = phrase("{where}, {height}", where=phrase("behind"), height=phrase("above"))
    text = "no photo from {where} ({width:.0f}° wide): what shows only from there is guessed"
    gap = Finding("gap", 1.0, phrase(text, where=where, width=80.0), phrase("add photos from there"))
    return replace(report, photos=tuple(photos), limits=(gap, *report.limits))


def make_report_state(state: Literal["running", "done", "cancelled", "failed"]) -> ReportState:
    report, text = make_report() if state == "done" else None, phrase("photo {done:,} of {total:,}", done=9, total=24)
    return ReportState(state, 0.4, text, make_snapshot().loaded, report)


def make_posing(stage: str) -> PoseProgress:
    """How far poses are found, in a stage; in the last with a model of three cameras."""
    poses = np.stack([make_camera(np.array([3.0, k, 1.0])).c2w for k in range(3)])
    model = Growing(poses, np.zeros((4, 3), np.float32), np.full((4, 3), 200, np.uint8))
    if stage not in (STAGES["poses"], PLACED):
        return PoseProgress(stage, 400, 1225, 50, 0, 70.0)
    return PoseProgress(stage, 3, 50, 50, 3, None, model)


def states() -> dict[str, AppState]:
    """The states in which every panel must draw, by name."""
    full, alone = make_snapshot(), Snapshot()
    noise = replace(full, step=3, saved_step=0, history=make_history(150), opened=None)
    found = {
        "empty": make_state(alone),
        "loading": make_state(replace(alone, status="loading", loading="photos: 12 of 100")),
        "first noise": make_state(noise),
        "background": make_state(make_snapshot(density=0.0)),
        "odd": make_state(
            replace(full, opened=odd_opened(), history=History(np.arange(3), np.zeros(3), np.full(3, np.nan)))
        ),
        "asked": make_state(replace(full, opened=None)),
    }
    for stage in (COPYING, LOOKING, *STAGES.values(), PLACED):
        found[f"posing {stage}"] = make_state(replace(alone, status="loading", posing=make_posing(stage)))
    found["visits"] = make_state(bare_snapshot(bare_ray()))
    found["many visits"] = make_state(bare_snapshot(bare_ray(300)))
    found["no visits"] = make_state(bare_snapshot(bare_ray(0, None)))
    found["visits in holes"] = make_state(bare_snapshot(replace(bare_ray(), visited=np.full(3, np.nan, np.float32))))
    untrained = replace(
        full.history, step=full.history.step[:0], loss=full.history.loss[:0], psnr=full.history.psnr[:0]
    )
    found["nothing to train"] = make_state(
        replace(bare_snapshot(bare_ray(0, None)), status="finished", step=0, total_steps=0, history=untrained)
    )
    for status in get_args(Status):
        found.setdefault(status, make_state(replace(full, status=status)))
    found["asked"].inspect = Inspect(make_camera(np.array([3.2, 0, 2.4])), (4, 5))
    for kind in ("running", "done", "cancelled", "failed"):
        export = Export(Path("orbit.mp4"), 12, 60, 70.0 if kind == "running" else None, kind)
        found[f"export {kind}"] = make_state(replace(full, export=export))
    for kind in ("running", "done", "cancelled", "failed"):
        found[f"study {kind}"] = make_state(replace(full, study=make_study(kind)))
    for kind in ("running", "done", "cancelled", "failed"):
        found[f"report {kind}"] = make_state(replace(full, report=make_report_state(kind)))
    failed = found["failed"]
    failed.notices += [
        ShownNotice(Notice("info", "saved step 12,400 to run/last.safetensors", Path("run/last.safetensors")), 99),
        ShownNotice(Notice("warning", "the loss is not a number: went back to step 12,000"), 40),
        ShownNotice(Notice("error", "out of memory", detail="Traceback …\n  line 1"), 95),
    ]
    found["training"].show_help = True
    for name, snapshot, entries in (
        ("left off, not read", alone, None),
        ("left off", alone, _autosaves()),
        ("left off, with a scene", full, _autosaves()),
    ):
        found[name] = make_state(snapshot)
        found[name].show_left_off = True
        found[name].left_off.entries = entries
        found[name].left_off.pictures["0"] = np.zeros((1, 9, 4), np.uint8)
    return found


def _autosaves() -> tuple[Autosave, ...]:
    """One that can be continued, one that cannot, and one that cannot be read."""
    good = Autosave(Path("0"), 73_600_000, 1.7e9, "chair", "voxels", 12_400, 71.0, Path("photos \udcff"), LoadOptions())
    gone = replace(good, file=Path("1"), saved=0.0, problem="photos is no longer there" * 9)
    return good, gone, Autosave(Path("2"), 5, 1.7e9, problem="cut short")
