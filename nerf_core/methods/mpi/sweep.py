"""Fill a new MPI by a plane sweep: a plane is opaque where the photos, projected onto it, agree.

LLFF's network (arXiv:1905.00889, section 4.1) reads such projections of five photos, the plane-sweep volumes, and
predicts the opacities and colours. Its weights are not used here. Instead, the opacity follows from how little the
projected colours differ (Collins 1996 introduced the sweep), and gradient descent improves on that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerf_core.geometry.camera import Camera, project
from nerf_core.geometry.scene import Scene
from nerf_core.methods.mpi.optimizer import OPAQUE, clear_border
from nerf_core.methods.mpi.planes import Stack, sharing

UNSEEN = 1e-3  # weight of a photo's nearest pixel where it does not show a texel: counts only where no photo does
ALONE = 0.2  # RMS difference that is assumed where fewer than two photos show a texel: worse than any good fit
LEAST = 1e-4  # smaller opacities become 0: 1/40 of a step of 8 bits, and their squares would be denormal and slow
ROWS = 32  # of texels whose probabilities are computed at once: about 5 ms


WHOLE = 1 - 1e-3  # of the pixels that a texel mixes, so many count: a masked one would have more than rounding


class Photo:
    """A photo as colours (1, 3, h, w) with its camera, ready to be projected onto the planes of a stack.

    A photo with more pixels than the planes have texels is averaged over blocks first, so that it is not undersampled.

    kept: (1, 1, h, w) 1 where pixels count, and 0 where one in the block is masked; None: all count.
    """

    def __init__(self, scene: Scene, view: int, stack: Stack, points: Tensor) -> None:
        """Prepare a photo of the scene. points: those of `Stack.points`."""
        camera = scene.views[view].camera
        factor = max(1, int(camera.fx / float(stack.focal[0])))  # pixels along a texel
        self.camera = camera.shrunk(factor)
        width, height, side = self.camera.width, self.camera.height, min(factor, camera.width, camera.height)
        blocks = scene.images[view][: height * side, : width * side].reshape(height, side, width, side, 3)
        pixels = torch.from_numpy(blocks.mean((1, 3), dtype=np.float32) / 65535)
        self.pixels = pixels.to(points.device).permute(2, 0, 1)[None].contiguous()
        self.kept: Tensor | None = None
        if (mask := scene.photos.mask(view)) is not None:
            inside = mask[: height * side, : width * side].reshape(height, side, width, side).all((1, 3))
            self.kept = torch.from_numpy(inside).to(self.pixels)[None, None]
            self.pixels *= self.kept  # a texel may still mix 1 − WHOLE of a masked pixel
        axes = torch.from_numpy(np.array(self.camera.c2w, np.float64)).to(points.device)
        self.turned = (points.double() @ (stack.rotation.T @ axes[:, :3])).float()
        self.moved = ((stack.position - axes[:, 3]) @ axes[:, :3]).float()

    def onto(self, depth: float) -> tuple[Tensor, Tensor]:
        """Project the photo onto the plane at a depth.

        The plane's texel q, on the plane at depth 1 in the reference camera's axes, is seen in the photo's camera
        along A q + b / z with A = R′ᵀ R and b = R′ᵀ (p − p′): the plane's homography.

        Returns:
            The photo's colours (3, H + 2, W + 2), and their weights (H + 2, W + 2): 1 + UNSEEN for texels that it
            shows, UNSEEN for others, 0 where the pixel is masked.
        """
        local = self.turned + self.moved / depth
        if self.camera.lens.wide:
            place, shown = self._around(local)
        else:
            ahead = local[..., 2] < -1e-6  # the texel lies in front of the camera, and the division is safe
            plane = local[..., :2] / torch.where(ahead, -local[..., 2], 1.0)[..., None]
            place = _in_photo(plane, self.camera)
            shown = ahead & (place.abs() <= 1).all(-1)
        found = functional.grid_sample(self.pixels, place[None], padding_mode="border", align_corners=False)[0]
        weight = shown.float() + UNSEEN
        if self.kept is not None:
            kept = functional.grid_sample(self.kept, place[None], padding_mode="border", align_corners=False)[0, 0]
            weight = torch.where(kept > WHOLE, weight, 0)
        return found, weight

    def _around(self, local: Tensor) -> tuple[Tensor, Tensor]:
        """Where texels (H + 2, W + 2, 3) in the axes of a camera with a wide lens lie in its photo; which it shows."""
        camera, points = self.camera, local.reshape(-1, 3).double().cpu().numpy()
        done = project(points, np.array(camera.intrinsics(), np.float64))
        place = torch.from_numpy(2 * done.pixels / (camera.width, camera.height) - 1).to(local)
        shown = torch.from_numpy(done.framed & done.shown).to(local.device)
        return place.reshape(*local.shape[:2], 2), shown.reshape(local.shape[:2])


def _in_photo(plane: Tensor, camera: Camera) -> Tensor:
    """Return where points (..., 2) on a camera's image plane, y up, lie in its photo, whose corners are ±1."""
    y_down = plane * torch.tensor([1.0, -1.0], device=plane.device)
    if camera.lens.bends:
        y_down = torch.from_numpy(camera.lens.distort(y_down.cpu().double().numpy())).to(plane)
    focal = torch.tensor([camera.fx / camera.width, camera.fy / camera.height]).to(plane)
    center = torch.tensor([camera.cx / camera.width, camera.cy / camera.height]).to(plane)
    return 2 * (y_down * focal + center) - 1


def sweep(
    scene: Scene, views: Sequence[int], stack: Stack, pictures: int, window: int, softness: float,
    yield_callback: Callable[[], None],
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the opacities (D, H + 2, W + 2) and colours (G, 3, H + 2, W + 2) of a new MPI, with their border.

    The difference e_i of plane i is the RMS spread of the photos' colours there, averaged over a window. With
    p = softmax(−e / softness), α_i = p_i / Σ_{j≥i} p_j gives each plane the weight p_i in the reference view. A plane's
    colour is the photos' mean.

    Args:
        scene: the scene.
        views: the photos that are compared.
        stack: the planes.
        pictures: how many colour pictures G the planes share.
        window: side of the window in texels.
        softness: see the equation.
        yield_callback: called between pieces of about 10 ms.
    """
    points = stack.points().float()
    photos = []
    for view in views:
        photos.append(Photo(scene, view, stack, points))
        yield_callback()
    spreads, means = [], []
    for depth in stack.depths.tolist():
        count = torch.full(points.shape[:2], 0.0, device=points.device)
        total = torch.zeros(3, *points.shape[:2], device=points.device)
        squares = torch.zeros_like(total)
        for photo in photos:
            found, weight = photo.onto(depth)
            count += weight
            total.addcmul_(found, weight)
            squares.addcmul_(found.square(), weight)
            yield_callback()
        count.clamp_(min=LEAST * UNSEEN)  # 0 where all photos are masked: the texel is black, and far from any good fit
        mean = total / count
        spread = (squares / count - mean.square()).sum(0).clamp(min=0).sqrt()
        spreads.append(_averaged(torch.where(count > 1.5, spread, ALONE), window))
        means.append(mean)
        yield_callback()
    spread, mean = torch.stack(spreads), torch.stack(means)
    alpha = torch.empty_like(spread)
    shared = sharing(len(mean), pictures)
    color = torch.empty(pictures, *mean.shape[1:], device=mean.device)
    for row in range(0, len(points), ROWS):
        rows = slice(row, row + ROWS)
        share = torch.softmax(-spread[:, rows] / softness, 0)
        behind = share.flip(0).cumsum(0).flip(0)
        # the last plane has p_i / p_i; 1e-30 only keeps the division of two zeros finite
        opacity = (share / behind.clamp(min=1e-30)).clamp(max=OPAQUE)
        alpha[:, rows] = torch.where(opacity < LEAST, 0, opacity)
        share += 1e-6  # so that planes that nobody sees are averaged
        for picture in range(pictures):
            own = slice(picture * shared, (picture + 1) * shared)
            color[picture, :, rows] = (share[own, None] * mean[own, :, rows]).sum(0) / share[own].sum(0)
        yield_callback()
    clear_border(alpha)
    return alpha, color


def _averaged(picture: Tensor, window: int) -> Tensor:
    """Average a picture (H, W) over window × window texels, fewer at its edge; an even window counts as one more."""
    half = min(window // 2, *((side - 1) // 2 for side in picture.shape))
    for kernel, padding in (((2 * half + 1, 1), (half, 0)), ((1, 2 * half + 1), (0, half))):
        picture = functional.avg_pool2d(picture[None], kernel, 1, padding, count_include_pad=False)[0]
    return picture
