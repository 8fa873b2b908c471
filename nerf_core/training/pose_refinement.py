"""Correct the poses of training photos while a model learns from them.

In every round, each photo is compared with the model at some pixels, and a step of its camera follows (`pose_fit`). A
part of the pixels is left out of the step. It is kept only where they agree better than before, and else the camera
stays as it was. Rounds begin with small photos, in which a wrong pose is off by a pixel or two, and go on with larger
ones.

A model bends to wrong poses, and then no camera seems wrong. So when a round has brought nothing, those that follow
compare photos with each other, and move all cameras together that were found to be wrong (`pose_bundle`). When that
brings nothing, it is the model's turn again.

A turn, shift and scaling of all cameras together changes nothing that photos show. So what such a motion has in common
with the corrections is taken out of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.methods.group import ALONE, Group
from nerf_core.training import pose_bundle
from nerf_core.training.batches import shrunk
from nerf_core.training.pose_fit import SHIFT, TURN, Target, between, compared, gain, moved, rotation, solved, turn_of
from nerf_core.training.pose_records import MOVED, REFUSED, UNTRIED, PoseCorrections

FITTED, LEFT_OUT = 512, 512  # pixels of a photo in a round
AMONG = 256  # as many for each of the two where photos are compared with each other: each is seen by several
SHARE = 0.5  # of the rays of training: so many are drawn for the poses, which takes some 20 % of the time
MOST = 64  # photos in a round, in turns; rounds of fewer are as far apart, because the model must follow its cameras
SMALLEST, ROUNDS = 64, 6  # longest side of the photos in their first rounds, in pixels; it doubles after so many
LEAST_STRIDE, MOST_STRIDE = 1 / 8, 2.0  # of a step: a model that remembers the old poses shows half of an error
WRONG = 0.05  # share of the cost that a round saves if the capture's poses are wrong
CERTAIN = 3.0  # standard errors by which left-out pixels must agree better
CorrectPhoto = Callable[[int, np.ndarray], np.ndarray]


class Corrections(NamedTuple):
    """What a round finds, and `PoseRefinement` keeps: see there."""

    poses: np.ndarray
    outcome: np.ndarray
    stride: float
    stride_among: float
    wrong: bool
    among: bool


class Tried(NamedTuple):
    """M photos that a round has tried to move.

    photos: (M,) their positions.
    wanted: (N, 3, 4) the poses of all photos, if they were kept.
    gains: (M, 3) those of left-out pixels, of `gain`.
    """

    photos: np.ndarray
    wanted: np.ndarray
    gains: np.ndarray


def shrink_of(longest: int, rounds: int) -> int:
    """Return by which factor photos are shrunk after so many rounds of each. longest: their longest side in pixels."""
    return max(1, round(longest / (SMALLEST << min(rounds // ROUNDS, 30))))


def targets(scene: Scene, views: Sequence[int], shrink: int) -> list[Target]:
    """Return photos to compare with, averaged over blocks of shrink × shrink pixels."""
    photos, cameras = scene.photos.at(views), [scene.views[i].camera for i in views]
    if shrink > 1:
        cameras = [camera.shrunk(shrink) for camera in cameras]
        photos = shrunk(photos, [(camera.width, camera.height) for camera in cameras], shrink)
    return [Target(photos, n, camera) for n, camera in enumerate(cameras)]


def fitted(method: Method, scene: Scene, view: int) -> np.ndarray:
    """Return the pose (3, 4) of a held-out photo that is fitted to its left half; the model stays as it is.

    The rounds, the sizes and the gate are those of training photos, without the gauge.

    Args:
        method: the model.
        scene: the scene, with the pose to begin with.
        view: the photo.
    """
    given = pose = scene.poses[view]
    rng, rounds, shrink = np.random.default_rng(view), 0, 0
    longest = max(scene.views[view].camera.width, scene.views[view].camera.height)
    target = targets(scene, [view], 1)[0]
    while shrink != 1 or rounds % ROUNDS:  # all rounds of the full size, too
        if shrink_of(longest, rounds) != shrink:
            shrink = shrink_of(longest, rounds)
            target = targets(scene, [view], shrink)[0]
        rounds += 1
        pixels = target.pixels(rng, FITTED + LEFT_OUT, left_half=True)
        out = _left_out(target, pixels, rounds)
        if out.all() or not out.any():
            continue
        step = solved(compared(method, scene, target, pose, pixels[~out]), between(given, pose))
        wanted = moved(pose, step)
        found, error, _ = gain(*(compared(method, scene, target, p, pixels[out]) for p in (pose, wanted)))
        pose = wanted if found > CERTAIN * error else pose
    return pose


def better(gains: np.ndarray, wrong: bool) -> tuple[np.ndarray, bool, bool]:
    """Return which photos (N,) agree better by more than chance, whether all together do, and whether poses are wrong.

    What one photo cannot tell from chance, all together may: then a photo need only agree better at all. But poses that
    are right drift with a model that is not: a forward-facing scene may bend, and all photos agree better. So they are
    heard together only once a round has shown that the capture's poses are wrong.

    gains: (N, 3) gains, their standard errors and costs, of `gain`.
    wrong: whether an earlier round has shown it.
    """
    of_one, error, cost = gains.T
    together = bool(of_one.sum() > CERTAIN * np.sqrt((error**2).sum()))
    wrong = wrong or (together and bool(of_one.sum() > WRONG * cost.sum()))
    return of_one > (0.0 if together and wrong else CERTAIN) * error, together, wrong


def _next_stride(stride: float, together: bool, most: float) -> float:
    return min(most, 2 * stride) if together else max(LEAST_STRIDE, stride / 2)


def _left_out(target: Target, pixels: np.ndarray, side: int) -> np.ndarray:
    """Which pixels (P, 2) are left out: those of every second cell, as on a chessboard; `side` says of which colour.

    Neighbours would not tell: where a model is too smooth, both are wrong in the same way.
    """
    return (target.cells(pixels).sum(-1) + side) % 2 == 0


class PoseRefinement:
    """The poses of N training photos.

    views: the photos as indices into `Scene.views`.
    given: (N, 3, 4) float64, the poses of the capture.
    poses: (N, 3, 4) float64, the poses as they are corrected.
    outcome: (N,) int64, of the last round of each photo: UNTRIED, MOVED or REFUSED by the left-out pixels.
    stride: the share of each step that a round goes. If poses are wrong, it is halved when all photos together do not
        agree better, and doubled when they do.
    stride_among: the same of rounds that compare photos with each other. It is 1 at most: photos remember nothing.
    wrong: whether a round has shown that the capture's poses are wrong; see `better`.
    among: whether the next round compares photos with each other.
    """

    def __init__(self, scene: Scene, views: Sequence[int], seed: int) -> None:
        """Begin with the capture's poses.

        Args:
            scene: the capture.
            views: the photos as indices into `Scene.views`.
            seed: of the pixels that are drawn.
        """
        self.scene, self.views, self.seed = scene, tuple(views), seed
        self.given = scene.poses[list(views)]
        self.poses = self.given.copy()
        self.outcome = np.full(len(self.views), UNTRIED)
        self.rounds, self._rays = 0, 0.0
        self.stride, self.stride_among, self.wrong, self.among = 1.0, 1.0, False, False
        self._targets: tuple[int, list[Target]] = 0, []

    def due(self, rays: int) -> bool:
        """Return whether a round is due before a training step of so many rays. It changes nothing."""
        return self._rays + SHARE * rays >= MOST * (FITTED + 2 * LEFT_OUT)

    def trained(self, rays: int) -> None:
        """Count the rays of a training step, which pay for a round."""
        self._rays += SHARE * rays

    def round(self, method: Method, correct: CorrectPhoto, yield_callback: Callable[[], None]) -> Corrections:
        """Return what a round finds. Nothing changes before `take`.

        Args:
            method: the model.
            correct: takes a position in `views` and the photo's colours (…, 3), and undoes the photo's exposure.
            yield_callback: called between photos; it may raise.
        """
        rng = np.random.default_rng([self.seed, self.rounds])
        shown = [target.corrected(partial(correct, n)) for n, target in enumerate(self._shown())]
        find = self._among_photos if self.among else self._with_model
        tried = find(method, rng, shown, yield_callback)
        poses, outcome = self.poses.copy(), self.outcome.copy()
        # photos that are compared with each other have been found wrong, but say nothing about all others
        kept, together, wrong = better(tried.gains, self.wrong or self.among)
        outcome[tried.photos] = np.where(kept, MOVED, REFUSED)
        poses[tried.photos[kept]] = tried.wanted[tried.photos[kept]]
        stride, stride_among = self.stride, self.stride_among
        useful = bool((poses != self.poses).any()) and (together or not wrong)
        if self.among:
            stride_among, wrong = _next_stride(stride_among, together, 1.0), self.wrong
        elif wrong:
            stride = _next_stride(stride, together, MOST_STRIDE)
        possible = self._targets[0] == 1 and len(poses) > 1 and bool((poses != self.given).any())
        among = possible and self.among == useful
        return Corrections(poses, outcome, stride, stride_among, wrong, among)

    def _with_model(
        self, method: Method, rng: np.random.Generator, shown: Sequence[Target], yield_callback: Callable[[], None]
    ) -> Tried:
        """Compare each photo with the model."""
        wanted, left_out, side = self.poses.copy(), {}, int(rng.integers(2))
        for n in self._chosen().tolist():
            pixels = shown[n].pixels(rng, FITTED + LEFT_OUT)
            out = _left_out(shown[n], pixels, side)
            yield_callback()
            if out.any() and not out.all():
                found = compared(method, self.scene, shown[n], self.poses[n], pixels[~out])
                step = solved(found, between(self.given[n], self.poses[n]))
                if np.isfinite(step).all():  # a model that diverges is told after the step
                    wanted[n] = moved(self.poses[n], self.stride * step)
                    left_out[n] = pixels[out]
        wanted = self._without_gauge(wanted)
        gains = np.zeros((len(left_out), 3))
        for row, (n, pixels) in enumerate(left_out.items()):
            yield_callback()
            gains[row] = gain(*(compared(method, self.scene, shown[n], p[n], pixels) for p in (self.poses, wanted)))
        return Tried(np.array(list(left_out), np.int64), wanted, gains)

    def _among_photos(
        self, method: Method, rng: np.random.Generator, shown: Sequence[Target], yield_callback: Callable[[], None]
    ) -> Tried:
        """Compare photos that have moved with each other and with those near them."""
        reach = float(np.linalg.norm(self.given[:, :, 3] - self.scene.center, axis=-1).mean()) or self.scene.radius
        moving = np.flatnonzero((self.poses != self.given).any((1, 2)))
        chosen = np.sort(rng.permutation(moving)[:MOST])
        found, left_out, side = [], [], int(rng.integers(2))
        for n, near in zip(chosen.tolist(), pose_bundle.near_each(self.poses, chosen, reach), strict=True):
            pixels = shown[n].pixels(rng, 2 * AMONG)
            out = _left_out(shown[n], pixels, side)
            others = rng.choice(near, min(pose_bundle.OTHERS, len(near)), replace=False)
            yield_callback()
            if out.any() and not out.all():
                for part, kept in ((~out, found), (out, left_out)):
                    kept.append(pose_bundle.sighted(method, self.scene, shown, self.poses, n, others, pixels[part]))
        nothing = Tried(np.zeros(0, np.int64), self.poses, np.zeros((0, 3)))
        if not any(len(s.off) for s in found):
            return nothing
        scale = pose_bundle.noise(found)
        before = np.stack([between(given, c2w) for given, c2w in zip(self.given, self.poses, strict=True)])
        depth = float(np.median(np.concatenate([np.linalg.norm(s.local, axis=-1) for s in found])))
        step = pose_bundle.steps(found, before, np.repeat([TURN, SHIFT * depth], 3), scale)
        if not np.isfinite(step).all():  # a photo whose exposure is none
            return nothing
        wanted = np.stack([moved(c2w, self.stride_among * s) for c2w, s in zip(self.poses, step, strict=True)])
        if len(found) == len(self.poses):  # else those that stand still hold the gauge
            wanted = self._without_gauge(wanted)
        gains = np.zeros((len(left_out), 3))
        for row, sightings in enumerate(left_out):
            yield_callback()
            gains[row] = pose_bundle.agreement(shown, self.poses, wanted, sightings, scale)
        return Tried(np.array([s.host for s in left_out], np.int64), wanted, gains)

    def now(self) -> Corrections:
        """Return what the last round found."""
        return Corrections(self.poses, self.outcome, self.stride, self.stride_among, self.wrong, self.among)

    def take(self, found: Corrections, group: Group = ALONE) -> None:
        """Make what `round` returned the poses of all processes: those of the first one count."""
        first = [torch.as_tensor(v).double() * (group.rank == 0) for v in found]
        group.add(first)
        self.poses, self.outcome = first[0].numpy(), first[1].long().numpy()
        self.stride, self.stride_among = float(first[2]), float(first[3])
        self.wrong, self.among = bool(first[4]), bool(first[5])
        self.rounds, self._rays = self.rounds + 1, 0.0

    def corrections(self) -> PoseCorrections:
        """Return by how much each camera was moved."""
        turned = np.linalg.norm(turn_of(np.swapaxes(self.given[:, :, :3], 1, 2) @ self.poses[:, :, :3]), axis=-1)
        still = (self.poses == self.given).all((1, 2))  # a product of a rotation and its inverse is rounded
        away = np.linalg.norm(self.poses[:, :, 3] - self.given[:, :, 3], axis=-1) / self.scene.radius
        return PoseCorrections(
            np.array(self.views), self.given, np.where(still, 0, np.degrees(turned)), away, self.outcome, self.rounds
        )

    def _chosen(self) -> np.ndarray:
        """The photos of this round as positions in `views`: all, or the next MOST of them in a random order."""
        total = len(self.views)
        if total <= MOST:
            return np.arange(total)
        at = self.rounds * MOST + np.arange(MOST)
        orders = {k: np.random.default_rng([self.seed, 0, k]).permutation(total) for k in np.unique(at // total)}
        return np.unique([orders[k][n] for k, n in zip(at // total, at % total, strict=True)])

    def _shown(self) -> list[Target]:
        """The photos at the size of this round."""
        cameras = [self.scene.views[i].camera for i in self.views]
        longest, total = max(max(c.width, c.height) for c in cameras), len(cameras)
        shrink = shrink_of(longest, self.rounds * min(MOST, total) // total)
        if self._targets[0] != shrink:
            self._targets = shrink, targets(self.scene, self.views, shrink)
        return self._targets[1]

    def _without_gauge(self, poses: np.ndarray) -> np.ndarray:
        """Take out of poses (N, 3, 4) the turn, shift and scaling about the middle that is common to all corrections.

        Least squares over the corrections: a turn counts with the cameras' distance from the scene's centre.
        """
        places, middle = self.given[:, :, 3], self.given[:, :, 3].mean(0)
        arms = places - middle
        unit = float(np.linalg.norm(places - self.scene.center, axis=-1).mean()) or self.scene.radius
        turns = turn_of(poses[:, :, :3] @ np.swapaxes(self.given[:, :, :3], 1, 2))
        count, zero = len(poses), np.zeros
        system = zero((2, count, 3, 7))  # of turn, shift and scaling
        system[0, :, :, :3] = unit * np.eye(3)
        system[1, :, :, :3] = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)
        system[1, :, :, 3:6] = np.eye(3)
        system[1, :, :, 6] = arms
        wanted = np.stack([unit * turns, poses[:, :, 3] - places])
        common = np.linalg.lstsq(system.reshape(-1, 7), wanted.ravel(), rcond=None)[0]
        shifts = (system[1] @ common).reshape(count, 3)
        back = rotation(-common[:3])
        return np.concatenate([back @ poses[:, :, :3], (poses[:, :, 3] - shifts)[:, :, None]], -1)

    def state(self) -> dict[str, Tensor]:
        """Return poses, outcomes and counts by name, for a checkpoint."""
        return {
            "poses": torch.from_numpy(self.poses), "outcome": torch.from_numpy(self.outcome),
            "counts": torch.tensor(
                [self.rounds, self._rays, self.stride, self.wrong, self.stride_among, self.among], dtype=torch.float64
            ),
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError or ValueError if it is of other photos."""
        for name in ("poses", "outcome"):
            if state[name].shape != self.state()[name].shape:
                raise ValueError(f"{name} of {len(state[name])} photos, not {len(self.views)}")
        counts = state["counts"].tolist()
        if len(counts) == 4:  # of a version that compared photos with the model alone
            counts += [1.0, False]
        self.poses = state["poses"].cpu().double().numpy().copy()
        self.outcome = state["outcome"].cpu().long().numpy().copy()
        rounds, self._rays, self.stride, wrong, self.stride_among, among = counts
        self.rounds, self.wrong, self.among = int(rounds), bool(wrong), bool(among)
