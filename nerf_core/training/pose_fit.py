"""Compare a photo with a model's picture, and find how the camera must move for the two to agree.

The camera turns by ω and shifts by v, in its own axes. A surface at the place x in front of it then moves in the
picture by the flow F = −∂p/∂x · (v + ω × x), and the model's colour at a pixel p becomes c(p) − ∇c · F. The photo's
gradient stands for that of the model, so that a model needs to draw each pixel only once and need not be
differentiable. This is the image alignment of Lucas and Kanade (1981) with the model's depths. One step of Gauss and
Newton on robust residuals is taken at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method

Correct = Callable[[np.ndarray], np.ndarray]
TURN, SHIFT = np.radians(1.0), 0.01  # prior of a step: 1°, and 1 % of the depth
KNOWN = 0.2  # share of a photo's variance that the model must explain: else they say nothing about the pose
CELLS = 8  # parts along a side of a photo: pixels of one cell are wrong together, those of two count as independent
FEWEST_CELLS = 5  # that left-out pixels are in: the sums over one alone always agree
HIT = 0.5  # of a pixel's light; with less, its depth is that of the rest of the photo
CANDIDATES = 4  # pixels of which one is drawn
INDEPENDENT = 0.1  # so many residuals count as independent, as a share of all: neighbours are wrong together


def unchanged(colors: np.ndarray) -> np.ndarray:
    """The correction of a photo whose exposure is not known."""
    return colors


@dataclass(frozen=True)
class Target:
    """A photo to compare with, perhaps at a smaller size.

    photos, index: the photo's pixels.
    camera: its camera at that size, from which the pose is not taken.
    correct: undoes the photo's exposure: colours (…, 3) in [0, 1] to those of the mean exposure.
    """

    photos: Photos
    index: int
    camera: Camera
    correct: Correct = unchanged

    def corrected(self, correct: Correct) -> Target:
        """Return the target with another correction."""
        return replace(self, correct=correct)

    def pixels(self, rng: np.random.Generator, count: int, left_half: bool = False) -> np.ndarray:
        """Draw pixels (P, 2), P ≤ count, that count, have neighbours on all sides and are shown by the lens.

        They are drawn in proportion to the photo's gradient: plain surfaces tell nothing about a pose.
        left_half: look at nothing in the right half.
        """
        width, height = self.camera.width, self.camera.height
        width = width // 2 if left_half else width
        if min(width, height) < 3:
            return np.zeros((0, 2), np.int64)
        found = np.unique(rng.integers([1, 1], [width - 1, height - 1], (CANDIDATES * count, 2)), axis=0)
        x, y = found.T  # the gradient at the edge of a mask is not one of the photo
        around = ((x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1))
        good = np.all([self.counted(row, column) for column, row in around], 0)
        steep = np.linalg.norm(self.colors(found)[1], axis=(1, 2)) * good
        # the smallest of exponential variables with these rates; a rate of 0 is never drawn
        order = np.argsort(rng.exponential(size=len(found)) / np.maximum(steep, 1e-9), kind="stable")[:count]
        return found[order[steep[order] > 0]]

    def counted(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return whether the lens shows pixels (P,), (P,) and no mask leaves them out, as bool (P,)."""
        camera = self.camera
        off = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy])
        good = np.linalg.norm(off, axis=0) < camera.lens.reach()
        mask = self.photos.mask(self.index)
        return good if mask is None else good & mask[row, column]

    def cells(self, pixels: np.ndarray) -> np.ndarray:
        """Return the cells (P, 2) that pixels (P, 2) are in, as column and row in [0, CELLS)."""
        return pixels * CELLS // (self.camera.width, self.camera.height)

    def colors(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return colours (P, 3) of pixels (P, 2), and their gradients (P, 3, 2) by column and row."""
        x, y = pixels.T
        places = ((x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1))
        shown = np.stack([self.photos.part(self.index, row, column) for column, row in places]) / 65535
        middle, left, right, above, below = self.correct(shown)
        return middle, np.stack([right - left, below - above], -1) / 2


@dataclass(frozen=True)
class Comparison:
    """The model against P pixels of a photo.

    cells: (P, 2) the column and row of the cell of the photo, of CELLS × CELLS, that each pixel is in.
    colors: (P, 3) the photo's.
    off: (P, 3) the model's colours less the photo's.
    by_pose: (P, 3, 6) how that changes with a turn, in units of TURN, and a shift, in units of SHIFT of `depth`.
    depth: the median depth, in scene units; 0 if nothing was hit.
    """

    cells: np.ndarray
    colors: np.ndarray
    off: np.ndarray
    by_pose: np.ndarray
    depth: float


def compared(method: Method, scene: Scene, target: Target, c2w: np.ndarray, pixels: np.ndarray) -> Comparison:
    """Draw pixels from a pose and compare them with the photo.

    Args:
        method: the model.
        scene: for near and far.
        target: the photo.
        c2w: (3, 4) the camera's pose.
        pixels: (P, 2) column and row, P ≥ 1.
    """
    camera, centres = target.camera.moved(c2w), pixels + 0.5
    rays = Cameras([camera], scene.near, scene.far).rays(
        torch.zeros(len(pixels), dtype=torch.long), torch.from_numpy(centres)
    )
    with torch.no_grad():
        drawn = method.render(rays.to(method.device))
    color, t, opacity = (v.double().cpu().numpy() for v in (drawn.color, drawn.depth, drawn.opacity))
    hit = (opacity > HIT) & np.isfinite(t)
    depth = float(np.median(t[hit])) if hit.any() else 0.0
    t = np.where(hit, t, depth)
    shown, gradient = target.colors(pixels)
    # a direction moves by −ω × d − (v − d (d·v)) / t
    to_pixel = pixels_by_direction(camera.directions, centres)
    turned = crossed(unit_vectors(camera.directions(centres))) * TURN
    shifted = -np.eye(3) * (SHIFT * depth / np.maximum(t, 1e-3 * depth or 1.0))[:, None, None]
    flow = to_pixel @ np.concatenate([turned, shifted], -1)  # (P, 2, 6)
    return Comparison(target.cells(pixels), shown, color - shown, -gradient @ flow, depth)


def solved(found: Comparison, before: np.ndarray) -> np.ndarray:
    """Return the step (6,) of a comparison: turn in radians, shift in scene units, in the camera's axes.

    It minimises 4 · INDEPENDENT · Σ ρ(r + J ξ) + |b + ξ|², linearised at 0. ρ is the function of Geman and McClure with
    the scale σ of the residuals r. What a photo cannot tell, such as a turn from a shift where all is equally far away,
    thus stays near the given pose.

    Args:
        found: the comparison.
        before: (6,) the turn and shift b from the given pose to this one, in the same units.
    """
    unit = np.repeat([TURN, SHIFT * found.depth or 1.0], 3)
    scale = spread(found.off)
    weight = robust(found.off, scale)[..., None]
    share = INDEPENDENT / scale**2
    square = np.einsum("pci,pcj->ij", weight * found.by_pose, found.by_pose) * share + np.eye(6)
    slope = np.einsum("pci,pc->i", weight * found.by_pose, found.off) * share
    return -np.linalg.solve(square, slope + before / unit) * unit


def gain(before: Comparison, after: Comparison) -> tuple[float, float, float]:
    """Return by how much the pixels of two comparisons agree better in the second, the standard error, and the cost.

    The cost is the mean of ρ(r) before, with the ρ of `solved`, and the gain is what is left out of it after. Pixels
    near each other are wrong together, so the error is that of sums over cells: √(Σ_c (Σ_p∈c (g_p − ḡ))²) / P. Pixels
    of a few cells cannot tell, and neither can a model that does not know the photo: then all are 0.
    """
    if not _known(before):
        return 0.0, 0.0, 0.0
    scale = spread(before.off)
    costs = geman_mcclure(before.off, scale).mean(-1)
    return told(before.cells, costs, costs - geman_mcclure(after.off, scale).mean(-1))


def told(cells: np.ndarray, costs: np.ndarray, gains: np.ndarray) -> tuple[float, float, float]:
    """Return the mean gain (P,), its standard error by cells (P, 2), and the mean cost (P,); see `gain`."""
    flat = cells @ (1, CELLS)
    if len(np.unique(flat)) < FEWEST_CELLS:
        return 0.0, 0.0, 0.0
    sums = np.bincount(flat, gains - gains.mean())
    return float(gains.mean()), float(np.sqrt((sums**2).sum()) / len(gains)), float(costs.mean())


def _known(found: Comparison) -> bool:
    """Whether the model explains enough of a photo to say anything about its pose."""
    variance = max(float(found.colors.var(0).mean()), 1e-12)  # of a photo of one colour
    return bool(1 - (found.off**2).mean() / variance > KNOWN)


def moved(c2w: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return a pose (3, 4) turned and shifted by a step (6,) in its own axes; see `solved`."""
    return np.column_stack([c2w[:, :3] @ rotation(step[:3]), c2w[:, 3] + c2w[:, :3] @ step[3:]])


def between(given: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Return the step (6,) that takes one pose (3, 4) to another; the inverse of `moved`."""
    back = given[:, :3].T
    return np.concatenate([turn_of(back @ c2w[:, :3]), back @ (c2w[:, 3] - given[:, 3])])


def rotation(turn: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by a vector (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    k = crossed(turn)
    small = angle < 1e-8  # sin and cos have lost their digits
    a, b = (1.0, 0.5) if small else (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2)
    return np.eye(3) + a * k + b * k @ k


def turn_of(matrix: np.ndarray) -> np.ndarray:
    """Return the vectors (…, 3) in radians of rotations (…, 3, 3) by less than a half turn."""
    m = np.asarray(matrix)
    axis = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1) / 2
    sine, cosine = np.linalg.norm(axis, axis=-1), (np.trace(m, axis1=-2, axis2=-1) - 1) / 2
    # below 1e-9, the sine and the angle are the same
    return axis * np.where(sine < 1e-9, 1.0, np.arctan2(sine, cosine) / np.maximum(sine, 1e-9))[..., None]


def spread(off: np.ndarray) -> float:
    """Return the scale of residuals: their RMS. Their median would be that of a plain background."""
    return max(float(np.sqrt((off**2).mean())), 1 / 255)  # a photo does not know less than a level


def robust(off: np.ndarray, scale: float) -> np.ndarray:
    """The weights of Geman and McClure for residuals: 1 / (1 + (r / 2σ)²)²."""
    return 1 / (1 + (off / (2 * scale)) ** 2) ** 2


def geman_mcclure(off: np.ndarray, scale: float) -> np.ndarray:
    """The function ρ of Geman and McClure: (r / 2σ)² / (1 + (r / 2σ)²)."""
    square = (off / (2 * scale)) ** 2
    return square / (1 + square)


def pixels_by_direction(directions: Callable[[np.ndarray], np.ndarray], places: np.ndarray) -> np.ndarray:
    """Return how pixel coordinates (P, 2) change with the unit vectors to what they show: (P, 2, 3), by least squares.

    directions: takes pixel coordinates to directions (P, 3).
    """
    looks = [unit_vectors(directions(places + step)) for step in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))]
    by_pixel = np.stack([looks[0] - looks[1], looks[2] - looks[3]], -1)  # (P, 3, 2)
    transposed = by_pixel.swapaxes(1, 2)
    return np.linalg.solve(transposed @ by_pixel, transposed)


def unit_vectors(v: np.ndarray) -> np.ndarray:
    """Return vectors (…, 3) divided by their lengths."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def crossed(v: np.ndarray) -> np.ndarray:
    """The matrices (…, 3, 3) that take a cross product with v (…, 3) from the left."""
    zero = np.zeros(np.shape(v)[:-1])
    x, y, z = np.moveaxis(np.asarray(v), -1, 0)
    return np.stack([np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2)
