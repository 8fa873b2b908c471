"""The tensors of one MPI, and a step of gradient descent on them that can be abandoned half way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerf_core.methods.mpi.config import MpiConfig
from nerf_core.methods.mpi.planes import BORDER, Spread, Stack, sharing

OPAQUE = 1 - 1 / 256  # the largest α: half a step of 8 bits below 1, so that what lies behind keeps a gradient
# Adam's ε, far below the gradient of a texel that one ray of a batch has touched. It is added within the root, because
# the square of a gradient that fades away becomes denormal, and the root of that takes ten times as long.
EPSILON = 1e-8
EDGE = 0.01  # difference of opacity below which neighbouring texels count as alike
EVERY = 4  # steps in which each plane is smoothed once, with as much more weight: a quarter of the time


class Planes(NamedTuple):
    """The tensors of an MPI with D planes and G colour pictures, with a border of one texel.

    alpha: (D, H + 2, W + 2) opacities in [0, OPAQUE], 0 on the border.
    color: (G, 3, H + 2, W + 2) colours in [0, 1].
    alpha_mean, alpha_square, color_mean, color_square: Adam's moments of both.
    """

    alpha: Tensor
    color: Tensor
    alpha_mean: Tensor
    alpha_square: Tensor
    color_mean: Tensor
    color_square: Tensor

    @staticmethod
    def zeros(stack: Stack, pictures: int) -> Planes:
        """Return transparent planes for a stack, with this number of colour pictures."""
        side = stack.height + 2 * BORDER, stack.width + 2 * BORDER
        alpha = torch.zeros(len(stack.depths), *side, device=stack.depths.device)
        color = torch.zeros(pictures, 3, *side, device=stack.depths.device)
        return Planes(alpha, color, *(torch.zeros_like(v) for v in (alpha, alpha, color, color)))


class Gradient(NamedTuple):
    """The gradient of a loss with regard to what R rays see of D planes.

    at: (D, R, 2) where they cross the planes.
    alpha: (D, R) of the opacities.
    weights: (D, R) the planes' weights in the rays' colours.
    color: (3, R) of the rays' colours; that of a plane's colour is its weight times this.
    """

    at: Tensor
    alpha: Tensor
    weights: Tensor
    color: Tensor


def descend(
    old: Planes, new: Planes, stack: Stack, found: Gradient, config: MpiConfig, update: int, rate: float,
    yield_callback: Callable[[], None],
) -> None:  # fmt: skip
    """Make a step of Adam (Kingma and Ba 2014, arXiv:1412.6980, algorithm 1) from `old` to `new` planes.

    The gradients of rays are added up on the texels around them: the transpose of a bilinear look-up. Then the planes
    move, one by one, and are cut to their range.

    Args:
        old: the planes; they stay as they are.
        new: tensors of the same shapes, which are overwritten.
        stack: where the planes lie.
        found: the gradient of the rays.
        config: the constants.
        update: the number of this update, from 1.
        rate: what the learning rates are multiplied with.
        yield_callback: called between pieces of about 10 ms.
    """
    planes, shared = len(old.alpha), sharing(len(old.alpha), len(old.color))
    roughness = EVERY * config.smooth * found.at.shape[1] / old.alpha[0].numel()
    on_alpha, on_color = torch.empty_like(old.alpha[0]), torch.empty_like(old.color[0])
    size = rate * (1 - config.keep_square**update) ** 0.5 / (1 - config.keep**update)
    for picture in range(len(old.color)):
        on_color.zero_()
        for plane in range(picture * shared, min((picture + 1) * shared, planes)):
            spread = Spread.of(found.at[plane], stack.width, stack.height)
            on_alpha.zero_()
            spread.onto(found.alpha[plane], on_alpha)
            if plane % EVERY == update % EVERY:
                add_roughness(old.alpha[plane], roughness, on_alpha)
            _adam(
                _part(old.alpha, old.alpha_mean, old.alpha_square, plane),
                _part(new.alpha, new.alpha_mean, new.alpha_square, plane),
                on_alpha, config, size * config.rate_alpha, OPAQUE,
            )  # fmt: skip
            clear_border(new.alpha[plane])
            for channel in range(3):
                spread.onto(found.weights[plane] * found.color[channel], on_color[channel])
        _adam(
            _part(old.color, old.color_mean, old.color_square, picture),
            _part(new.color, new.color_mean, new.color_square, picture),
            on_color, config, size * config.rate_color, 1.0,
        )  # fmt: skip
        yield_callback()


def _part(value: Tensor, mean: Tensor, square: Tensor, index: int) -> tuple[Tensor, Tensor, Tensor]:
    return value[index], mean[index], square[index]


def _adam(
    old: tuple[Tensor, Tensor, Tensor], new: tuple[Tensor, Tensor, Tensor], gradient: Tensor, config: MpiConfig,
    size: float, most: float,
) -> None:  # fmt: skip
    """Move values, with their first and second moments, against a gradient; they stay in [0, most]."""
    mean = torch.lerp(old[1], gradient, 1 - config.keep, out=new[1])
    square = torch.mul(old[2], config.keep_square, out=new[2])
    square.addcmul_(gradient, gradient, value=1 - config.keep_square)
    torch.addcdiv(old[0], mean, (square + EPSILON**2).sqrt_(), value=-size, out=new[0]).clamp_(0, most)


def clear_border(planes: Tensor) -> None:
    """Set the outermost texels of planes (..., H, W) to 0."""
    for edge in (planes[..., 0, :], planes[..., -1, :], planes[..., 0], planes[..., -1]):
        edge.zero_()


def add_roughness(plane: Tensor, weight: float, gradient: Tensor) -> None:
    """Add the gradient of weight · Σ √(d² + EDGE²) over the differences d of neighbouring texels to `gradient`.

    This total variation (Rudin et al. 1992), smooth at 0, wants a plane's opacity to be even but allows edges.

    Args:
        plane: (H, W) values.
        weight: the weight of the sum.
        gradient: (H, W), where it is added.
    """
    for axis in (0, 1):
        pull = plane.diff(dim=axis)
        pull.div_((pull.square() + EDGE**2).sqrt_()).mul_(weight)
        size = plane.shape[axis] - 1
        gradient.narrow(axis, 1, size).add_(pull)
        gradient.narrow(axis, 0, size).sub_(pull)
