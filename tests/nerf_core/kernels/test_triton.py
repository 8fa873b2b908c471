"""The Triton kernels, interpreted in a process of their own: in this one Triton may already be set to compile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from nerf_core.kernels.packed_kernels import BETA1, BETA2

HERE = Path(__file__).parent
PACKED, FIXED_STEP = HERE / "test_packed_kernels.py", HERE.parent / "methods" / "test_fixed_step.py"
GENERATIONS = (75, 80, 90, 120)  # compute capabilities: Turing, Ampere, Hopper, Blackwell
TYPES = {
    "*u8": "occupied leap",
    "*i64": "row_offsets counts",
    "*i32": "resolutions",
    "i32": "rays capacity count rows levels nx ny nz",
    "fp32": "step bx by bz sx sy sz epsilon",
}  # fmt: skip  types of the kernels' arguments; the others are pointers to fp32


def interpreted(checks: Path) -> int:
    """Run a file's tests of Triton's kernels. Returns how many passed; none may be skipped."""
    pytest.importorskip("triton")
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "-n0", "-k", "triton", checks]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=3000, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " SKIPPED" not in done.stdout
    return done.stdout.count(" PASSED")


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("checks", "fewest"),
    [
        pytest.param(PACKED, 18, marks=pytest.mark.thorough(25)),
        pytest.param(FIXED_STEP, 5, marks=pytest.mark.thorough(22)),
    ],
)
def test_the_interpreted_kernels_pass_their_checks(checks: Path, fewest: int) -> None:
    assert interpreted(checks) >= fewest


def machine_code(name: str, capability: int, **constants: Any) -> Any:
    """Compile a kernel, which needs no GPU. Returns the compiler's outputs by their suffixes, such as ptx and cubin."""
    triton = pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from nerf_core.kernels import triton_loops
    from nerf_core.kernels.triton_packed import EXACTLY

    kernel = getattr(triton_loops, name)
    types = {word: kind for kind, words in TYPES.items() for word in words.split()}
    types |= dict.fromkeys(constants, "constexpr")
    source = ASTSource(
        kernel,
        {word: types.get(word, "*fp32") for word in kernel.arg_names},
        {(kernel.arg_names.index(word),): value for word, value in constants.items()},
    )
    return triton.compile(source, target=GPUTarget("cuda", capability, 32), options=dict(EXACTLY)).asm


@pytest.mark.parametrize(
    "capability", [GENERATIONS[0], *(pytest.param(one, marks=pytest.mark.thorough(4)) for one in GENERATIONS[1:])]
)
def test_the_kernels_compile_for_every_generation_of_gpus(
    capability: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    pytest.importorskip("triton")
    from nerf_core.kernels.triton_packed import POINTS, RAYS, ROWS

    built = [
        machine_code("encode", capability, WIDTH=2, BLOCK=POINTS),
        machine_code("encode_gradient", capability, WIDTH=2, BLOCK=POINTS),
        machine_code("composite", capability, BLOCK=RAYS),
        machine_code("composite_gradient", capability, BLOCK=RAYS),
        machine_code("adam", capability, BETA1=BETA1, BETA2=BETA2, WIDTH=2, BLOCK=ROWS),
    ]
    assert all(len(code["cubin"]) > 1000 for code in built)
    for contracted in (False, True):
        marches = [
            machine_code("march", capability, CONTRACTED=contracted, WRITE=write, BLOCK=RAYS) for write in (False, True)
        ]
        # the march that counts and the one that writes must round alike, or a ray overwrites the next ray's samples
        assert all(len(march["cubin"]) > 1000 and "fma" not in march["ptx"] for march in marches)


def test_no_kernel_is_compiled_anew_for_another_number_of_rays_or_samples() -> None:
    pytest.importorskip("triton")
    code = """if True:
        from nerf_core.kernels import triton_loops as loops
        changing = {"rays", "capacity", "count"}
        for name in ("march", "encode", "encode_gradient", "composite", "composite_gradient"):
            found = [p for p in getattr(loops, name).params if p.name in changing]
            assert found and all(p.do_not_specialize for p in found), name
        slices = [p for p in loops.march.params if p.name in ("origins", "directions", "near", "far", "offsets")]
        assert len(slices) == 5 and all(p.do_not_specialize_on_alignment for p in slices)
    """
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)
