"""Checkpoints of earlier versions, in which bricks had rows for all of their vertices, as today's are."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from nerf_core.volume.cells import blocks
from nerf_core.volume.voxel_grid import DOUBLINGS, MOST_SIZES, blocks_of, cells_of_each_size, vertices_of

BRICKS = "grid.bricks"
OF_ROWS = ("grid.rows", "average", "moments")


def of_today(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint as `VoxelModel.state` names them.

    The first versions had cells of one size, "grid.occupied", and one table, "grid.bricks". Later ones had a table for
    each size, which said which bricks are stored. Moments once had first ones in front.

    Raises ValueError if the tables of an earlier version do not fit its cells and rows.
    """
    state = dict(state)
    if "grid.occupied" in state:
        if state["grid.occupied"].dtype != torch.bool:
            raise ValueError("the voxel grid is not of the kind that is written")
        state["grid.kinds"] = state.pop("grid.occupied").to(torch.uint8)
        state[f"{BRICKS}.0"] = state.pop(BRICKS)
    names = sorted(name for name in state if name.startswith(BRICKS))
    if names:
        if names != [f"{BRICKS}.{d}" for d in range(len(names))]:
            raise ValueError("the voxel grid is not of the kind that is written")
        kept = _rows_in_use(state["grid.kinds"], [state.pop(name) for name in names], len(state["grid.rows"]))
        state |= {name: state[name][kept] for name in OF_ROWS if name in state and len(state[name]) == len(kept)}
        state["grid.sizes"] = torch.tensor(len(names))
    if "moments" in state and state["moments"].shape == state["grid.rows"].shape:
        state["moments"] = state["moments"][:, [14, 15, 13]]
    return state


def _rows_in_use(kinds: Tensor, bricks: list[Tensor], count: int) -> Tensor:
    """Which of `count` rows belong to vertices of cells, (count,) bool."""
    sizes = len(bricks)
    if (
        not 1 <= sizes <= MOST_SIZES
        or kinds.ndim != 3
        or kinds.dtype != torch.uint8
        or not kinds.any()
        or int(kinds.max()) > sizes
    ):
        raise ValueError("the voxel grid is not of the kind that is written")
    kept = [torch.zeros(0, dtype=torch.bool)]
    for cells, stored in zip(cells_of_each_size(kinds, sizes), bricks, strict=True):
        vertices = vertices_of(cells)
        needed = blocks(vertices)
        if stored.dtype != torch.bool or stored.shape != needed.shape or bool((needed & ~stored).any()):
            raise ValueError("the voxel grid lacks rows for its cells")
        kept.append(blocks_of(vertices, DOUBLINGS)[stored].flatten())
    if sum(map(len, kept)) != count:
        raise ValueError("the voxel grid's rows do not fit its bricks")
    return torch.cat(kept)
