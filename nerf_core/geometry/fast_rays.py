"""Turn pixels into rays and colours on a CPU, with numba where it is installed."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.jit.cache import numba_obstacle
from nerf_core.common.jit.shards import each_shard, shards_of, split
from nerf_core.geometry.photos import WIDEN

FEWEST = 4096  # rays in a shard: half a millisecond's work. 16 shards of 512 took four times as long as two of these


def fast_rays(
    index: Tensor, pixels: Tensor, focal: Tensor, principal: Tensor, lens: Tensor, c2w: Tensor, near: float, far: float
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Compute `Cameras.rays` with numba.

    Returns:
        Origins (R, 3), directions (R, 3), near (R,) and far (R,), float32. None where numba is missing.
    """
    if numba_obstacle():
        return None
    from nerf_core.geometry.numba_rays import rays

    count = len(index)
    found = torch.empty(count, 3), torch.empty(count, 3), torch.empty(count), torch.empty(count)
    given = [v.contiguous().numpy() for v in (index, pixels.double(), focal, principal, lens, c2w)]
    out = [v.numpy() for v in found]
    shards = shards_of(count, torch.get_num_threads(), FEWEST)
    each_shard(shards, lambda s: rays(*given, near, far, *split(count, shards, s), *out))
    return found


def photo_colors(index: Tensor, pixel: Tensor, widths: Tensor, starts: Tensor, flat: np.ndarray) -> Tensor:
    """Return the colours of pixels in photos.

    Args:
        index: (R,) the photo of each pixel.
        pixel: (R, 2) integer column and row.
        widths: (N,) the width of each photo.
        starts: (N,) the row of `flat` at which each photo begins.
        flat: (P, 3) uint8 or uint16 (full range = 1), the pixels of all photos.

    Returns:
        sRGB colours (R, 3), float32 in [0, 1].
    """
    scale = WIDEN if flat.dtype == np.uint8 else 1
    if numba_obstacle():
        at = starts[index] + pixel[:, 1] * widths[index] + pixel[:, 0]
        return torch.from_numpy(flat[at.numpy()].astype(np.float32) * scale / 65535)
    from nerf_core.geometry.numba_rays import colors

    count = len(index)
    found = torch.empty(count, 3)
    given, out = [v.contiguous().numpy() for v in (index, pixel, widths, starts)], found.numpy()
    shards = shards_of(count, torch.get_num_threads(), FEWEST)
    each_shard(shards, lambda s: colors(*given, flat, scale, *split(count, shards, s), out))
    return found
