"""Compare photos with each other across the model's depths, and find how several cameras must move at once.

A pixel of one photo, the host, shows a surface at the distance t that the model knows. Where another photo sees that
surface, it should have the same colour. The difference r of the two changes with the host's pose, with the other's,
and with t. Σ ρ(r) over pixels and pairs of photos is the cost of direct bundle adjustment (Engel, Koltun and
Cremers 2018, arXiv:1607.02565). A step of Gauss and Newton moves all cameras together. Each pixel's distance is an
unknown, too, and is eliminated from the equations (Schur's complement).

What this adds to `pose_fit`: a model that has learnt from wrong poses has bent to them, and each camera alone seems to
stand right in it. Photos know nothing of the model's colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nerf_core.geometry.camera import Projected, project
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.lens import Lens
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.training.pose_fit import (
    HIT,
    SHIFT,
    Target,
    crossed,
    geman_mcclure,
    pixels_by_direction,
    robust,
    told,
    unit_vectors,
)

OTHERS = 8  # photos that a host is compared with in a round
NEAREST, NEAREST_SHARE = 16, 0.25  # photos that they are drawn from: so many, or this share of all if that is more
SAME = 0.03  # relative difference of distances up to which two photos are taken to see one surface
LOOSE = 10.0  # standard deviation of the model's distances, in units of SHIFT: a young model's are wrong together
FARTHEST = 20.0  # that a distance is moved at once, in the same units: one step is exact for small ones only
STILL_SEEN = 0.8  # of the sightings: a move that loses more is not judged by the rest
MADE_NORMAL = 1.48  # times the median of absolute values is the standard deviation, if they are normal
TOLERANT = 1.5  # standard deviations that make the scale of ρ: pictures of one edge differ where it is sampled


@dataclass(frozen=True)
class Sightings:
    """P pixels of a host photo whose surfaces other photos see: A sightings in all.

    host, others: positions of the photos; others is (K,).
    pixels: (P, 2) column and row in the host.
    local: (P, 3) the surfaces, in the host's axes.
    colors: (P, 3) the host's.
    pixel, other: (A,) of each sighting, as indices into `pixels` and `others`.
    off: (A, 3) the other photo's colour less the host's.
    by_host, by_other: (A, 3, 6) how that changes with a turn of each camera, in radians, and a shift, in scene units.
    by_distance: (A, 3) how it changes with the distance of the surface, in units of SHIFT of itself.
    """

    host: int
    others: np.ndarray
    pixels: np.ndarray
    local: np.ndarray
    colors: np.ndarray
    pixel: np.ndarray
    other: np.ndarray
    off: np.ndarray
    by_host: np.ndarray
    by_other: np.ndarray
    by_distance: np.ndarray


def near_each(poses: np.ndarray, chosen: np.ndarray, reach: float) -> np.ndarray:
    """Return M others for each of C chosen cameras, (C, M): those that stand and look most alike, the most alike first.

    Args:
        poses: (N, 3, 4), N ≥ 2.
        chosen: (C,) positions.
        reach: the distance at which cameras that look alike should look at one place, in scene units.
    """
    points = np.stack([poses[:, :, 3], poses[:, :, 3] - reach * poses[:, :, 2]], 1)  # where each stands, and looks
    apart = np.linalg.norm(points[chosen, None] - points, axis=-1).sum(-1)
    apart[np.arange(len(chosen)), chosen] = np.inf
    count = min(len(poses) - 1, max(NEAREST, int(NEAREST_SHARE * len(poses))))
    return apart.argsort(1, kind="stable")[:, :count]


def sighted(
    method: Method, scene: Scene, shown: Sequence[Target], poses: np.ndarray, host: int, others: np.ndarray,
    pixels: np.ndarray,
) -> Sightings:  # fmt: skip
    """Find the surfaces that pixels of a host photo show, and which other photos see them.

    A photo sees a surface if the model's distance along its own ray is the same.

    Args:
        method: the model, for its distances.
        scene: for near and far.
        shown: N photos.
        poses: (N, 3, 4) their poses.
        host, others: positions of the host and, (K,), of others.
        pixels: (P, 2) column and row in the host.
    """
    c2w, camera = poses[host], shown[host].camera
    t, hit = _distances(method, scene, [shown[host]], poses[[host]], np.zeros(len(pixels), np.int64), pixels + 0.5)
    pixels = pixels[hit]
    local = unit_vectors(camera.directions(pixels + 0.5)) * t[hit, None]
    colors = shown[host].colors(pixels)[0]
    count = len(pixels), len(others)
    pixel, other = (v.ravel() for v in np.indices(count))
    seen, axes = _seen(shown, poses, host, others, local[pixel], other)
    there = np.linalg.norm(axes, axis=-1)
    at = np.flatnonzero(_inside(shown, others, other, seen))
    t, hit = _distances(method, scene, [shown[n] for n in others], poses[others], other[at], seen.pixels[at])
    at = at[hit & (np.abs(t - there[at]) < SAME * there[at])]
    color, gradient, counts = _between_pixels(shown, others, other[at], seen.pixels[at])
    at, color, gradient = at[counts], color[counts], gradient[counts]
    places, pixel, other, axes, there = seen.pixels[at], pixel[at], other[at], axes[at], there[at]
    # a surface's change of place, in the other's axes, times this is the change of the other's colour
    by_place = gradient @ _pixels_by_direction(shown, others, other, places) / there[:, None, None]
    by_local = by_place @ (poses[others, :, :3].swapaxes(1, 2) @ c2w[:, :3])[other]
    x = local[pixel]
    return Sightings(
        host, others, pixels, local, colors, pixel, other, color - colors[pixel],
        by_host=np.concatenate([-by_local @ crossed(x), by_local], -1),
        by_other=np.concatenate([by_place @ crossed(axes), -by_place], -1),
        by_distance=SHIFT * (by_local @ x[..., None])[..., 0],
    )  # fmt: skip


def noise(found: Sequence[Sightings]) -> float:
    """Return the scale σ of all differences: from their median, because wrong sightings are not of its making."""
    off = np.concatenate([np.abs(s.off).ravel() for s in found])
    return max(TOLERANT * MADE_NORMAL * float(np.median(off)), 1 / 255) if len(off) else 1 / 255


def steps(found: Sequence[Sightings], before: np.ndarray, unit: np.ndarray, scale: float) -> np.ndarray:
    """Return the steps (N, 6) of all hosts: turns in radians and shifts in scene units, in each camera's axes.

    Photos that are no host stay where they are: their step is 0. The steps minimise Σ 4ρ(r + J ξ + d δ) + Σ |δ|² /
    LOOSE² + Σ |b + ξ|², linearised at 0, over the steps ξ and the changes δ of all distances.

    Args:
        found: sightings, of one host each.
        before: (N, 6) the turn and shift b from the given pose to the present one.
        unit: (6,) the prior's standard deviations of a turn and a shift.
        scale: σ, of `noise`.
    """
    hosts = {s.host: row for row, s in enumerate(found)}
    count = len(hosts)
    square, slope = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
    for row, s in enumerate(found):
        free = [k for k, n in enumerate(s.others.tolist()) if n in hosts]
        who = np.array([row, *(hosts[int(s.others[k])] for k in free)])
        jacobian = np.zeros((*s.off.shape, len(who), 6))
        jacobian[..., 0, :] = s.by_host * unit
        for column, k in enumerate(free):
            its = s.other == k
            jacobian[its, :, column + 1] = s.by_other[its] * unit
        flat = jacobian.reshape(s.off.size, -1)
        weight = robust(s.off, scale) / scale**2
        curved, sloped = _distance_equations(s, s.off, weight)
        mixed = np.zeros((len(s.pixels), flat.shape[1]))
        np.add.at(mixed, np.repeat(s.pixel, 3), (weight * s.by_distance).reshape(-1, 1) * flat)
        weighted = weight.reshape(-1, 1) * flat
        own = weighted.T @ flat - (mixed / curved[:, None]).T @ mixed
        square[who[:, None], :, who] += own.reshape(len(who), 6, len(who), 6).transpose(0, 2, 1, 3)
        slope[who] += (weighted.T @ s.off.ravel() - mixed.T @ (sloped / curved)).reshape(-1, 6)
    system = square.reshape(6 * count, -1) + np.eye(6 * count)
    rows = list(hosts)
    done = np.zeros_like(before)
    done[rows] = -np.linalg.solve(system, (slope + before[rows] / unit).ravel()).reshape(count, 6) * unit
    return done


def agreement(
    shown: Sequence[Target], poses: np.ndarray, wanted: np.ndarray, left_out: Sightings, scale: float
) -> tuple[float, float, float]:
    """Return by how much a host's left-out pixels agree better with the other photos, as `pose_fit.gain` does.

    Under either poses, a surface's distance is first moved to where the photos agree best. Sightings that one of the
    two loses do not count, and without a fifth of them nothing can be told.

    Args:
        shown: N photos.
        poses, wanted: (N, 3, 4) the present poses and the wanted ones.
        left_out: sightings, found under `poses`, of pixels that no step was fitted to.
        scale: σ, of `noise`.
    """
    (before, there), (after, here) = (_refitted(shown, p, left_out, scale) for p in (poses, wanted))
    both = there & here
    if both.sum() <= STILL_SEEN * len(both):
        return 0.0, 0.0, 0.0
    pixel = left_out.pixel[both]
    used, row, count = np.unique(pixel, return_inverse=True, return_counts=True)
    costs, left = (np.bincount(row, geman_mcclure(v[both], scale).mean(-1)) / count for v in (before, after))
    return told(shown[left_out.host].cells(left_out.pixels[used]), costs, costs - left)


def _refitted(
    shown: Sequence[Target], poses: np.ndarray, found: Sightings, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return `off` (A, 3) and whether it counts (A,), from other poses and at the distances that suit them best."""
    off, there = _off(shown, poses, found, found.local)
    curved, sloped = _distance_equations(found, off, robust(off, scale) / scale**2 * there[:, None])
    step = np.clip(-sloped / curved, -FARTHEST, FARTHEST)
    again, still = _off(shown, poses, found, found.local * (1 + SHIFT * step)[:, None])
    return again, there & still


def _off(
    shown: Sequence[Target], poses: np.ndarray, found: Sightings, local: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return `off` (A, 3) of surfaces at other places (P, 3) and from other poses, and whether it counts (A,)."""
    seen, _ = _seen(shown, poses, found.host, found.others, local[found.pixel], found.other)
    there = _inside(shown, found.others, found.other, seen)
    places = np.where(there[:, None], seen.pixels, 1.0)
    color, _, counts = _between_pixels(shown, found.others, found.other, places)
    return color - found.colors[found.pixel], there & counts


def _distance_equations(found: Sightings, off: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the second and first derivative (P,) of half the cost by each pixel's distance, in units of SHIFT.

    off, weight: (A, 3) the differences, and their weights in the cost.
    """
    count = len(found.pixels)
    curved = np.bincount(found.pixel, (weight * found.by_distance**2).sum(-1), count) + 1 / LOOSE**2
    return curved, np.bincount(found.pixel, (weight * found.by_distance * off).sum(-1), count)


def _distances(
    method: Method, scene: Scene, shown: Sequence[Target], poses: np.ndarray, photo: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the model's distances (P,) along rays of photos (P,) at places (P, 2), and whether there is a surface."""
    if not len(places):
        return np.zeros(0), np.zeros(0, bool)
    cameras = [target.camera.moved(c2w) for target, c2w in zip(shown, poses, strict=True)]
    rays = Cameras(cameras, scene.near, scene.far).rays(torch.from_numpy(photo), torch.from_numpy(places))
    with torch.no_grad():
        drawn = method.render(rays.to(method.device))
    t, opacity = (v.double().cpu().numpy() for v in (drawn.depth, drawn.opacity))
    return t, (opacity > HIT) & np.isfinite(t) & (t > 0)


def _intrinsics(shown: Sequence[Target], others: np.ndarray) -> np.ndarray:
    return np.array([shown[n].camera.intrinsics() for n in others], np.float64)


def _seen(
    shown: Sequence[Target], poses: np.ndarray, host: int, others: np.ndarray, local: np.ndarray, other: np.ndarray
) -> tuple[Projected, np.ndarray]:
    """Project points (A, 3) in the host's axes into others (A,). Returns that, and the points in the other's axes."""
    points = local @ poses[host, :, :3].T + poses[host, :, 3]
    c2w = poses[others][other]
    axes = ((points - c2w[:, :, 3])[:, None] @ c2w[:, :, :3])[:, 0]
    return project(axes, _intrinsics(shown, others)[other]), axes


def _inside(shown: Sequence[Target], others: np.ndarray, other: np.ndarray, seen: Projected) -> np.ndarray:
    """Whether four pixels' centres are around each place, (A,)."""
    size = _intrinsics(shown, others)[other, :2]
    places = np.where(seen.framed[:, None], seen.pixels, -1.0)
    return seen.framed & seen.shown & ((places >= 0.5) & (places < size - 0.5)).all(-1)


def _between_pixels(
    shown: Sequence[Target], others: np.ndarray, other: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours (A, 3) between four pixels, their derivatives (A, 3, 2), and whether all four pixels count."""
    corner = np.floor(places - 0.5).astype(np.int64)
    x, y = (places - 0.5 - corner).T[..., None]
    four = np.empty((4, len(places), 3))
    counts = np.ones(len(places), bool)
    for k, n in enumerate(others):
        its = np.flatnonzero(other == k)
        column, row = corner[its].T
        target, around = shown[n], ((row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1))
        four[:, its] = target.correct(np.stack([target.photos.part(target.index, *at) for at in around]) / 65535)
        counts[its] = np.all([target.counted(*at) for at in around], 0)
    left, right, below, far = four
    top, bottom = left + x * (right - left), below + x * (far - below)
    across = (1 - y) * (right - left) + y * (far - below)
    return top + y * (bottom - top), np.stack([across, bottom - top], -1), counts


def _pixels_by_direction(
    shown: Sequence[Target], others: np.ndarray, other: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """`pixels_by_direction` of several photos, (A, 2, 3)."""
    table = _intrinsics(shown, others)[other]
    lens = Lens(*table[:, 6:].T)
    return pixels_by_direction(lambda at: lens.directions((at - table[:, 4:6]) / table[:, 2:4]), places)
