"""The types that numba infers in the compiled loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels import numba_march
from nerf_core.kernels.cpu_rays import ray_arrays
from nerf_core.volume.cells import Cells


def test_a_march_computes_in_single_precision() -> None:
    """An integer operand beside float32 gives float64: slower, and rounded differently when stored as float32."""
    cells = Cells.of(np.zeros(3), np.ones(3), torch.ones(2, 2, 2, dtype=torch.bool), contracted=True)
    one = torch.ones(1, 3)
    rays = ray_arrays(BoxRays(one, one, one, one[:, 0], one[:, 0]), one[:, 0])
    compiler: Any = njit  # it returns a dispatcher, although its stubs say otherwise
    march = compiler(numba_march.march.py_func)  # compiled here, as a cached function has no types
    march(cells.cell_arrays(), rays, 0, np.float32(1), np.zeros(80, np.float32))
    (compiled,) = march.overloads.values()
    for name in ("t", "last", "dt", "px", "ux", "gap", "norm"):
        typed = compiled.type_annotation.typemap.items()
        assert {str(kind) for key, kind in typed if key.split(".")[0] == name} == {"float32"}, name
