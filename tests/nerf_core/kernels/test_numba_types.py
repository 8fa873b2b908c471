"""The types that numba infers in the compiled loops, and their logarithm."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from nerf_core.common.jit.vectors import log
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
    # compiled here, as a cached function has no types
    enter, advance = compiler(numba_march.enter.py_func), compiler(numba_march.advance.py_func)
    arrays, step = cells.cell_arrays(), np.float32(1)
    way, t = enter(arrays, rays, 0, step)
    way = numba_march.Way(*(np.float32(v) for v in way))  # returned to Python, they are Python's floats
    advance(arrays, way, step, np.float32(t), np.zeros(80, np.float32), 0, 10)
    singles = {enter: ("t", "last", "length", "straight"), advance: ("t", "last", "dt", "px", "ux", "gap", "norm")}
    for function, names in singles.items():
        (compiled,) = function.overloads.values()
        for name in names:
            typed = compiled.type_annotation.typemap.items()
            assert {str(kind) for key, kind in typed if key.split(".")[0] == name} == {"float32"}, name


def test_the_logarithm_is_that_of_the_library() -> None:
    x = np.exp(np.linspace(-80, 88, 20001)).astype(np.float32)
    x[:3] = 1, np.nextafter(np.float32(1), np.float32(2)), np.sqrt(np.float32(2))
    found, expected = np.array([log(v) for v in x]), np.log(x.astype(np.float64))
    assert float((np.abs(found - expected) / (1 + np.abs(expected))).max()) < 2e-7
