"""Adam is torch's own, step by step, and does not load torch's compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import torch

from nerf_core.methods.adam import Adam, adam_state, load_adam

ROOT = Path(__file__).parents[3]


def test_every_step_is_that_of_torch() -> None:
    ours, theirs = (torch.linspace(-1, 1, 7).reshape(7, 1).requires_grad_() for _ in range(2))
    one = Adam([ours], lr=0.1, eps=1e-6)
    other = torch.optim.Adam([theirs], lr=0.1, eps=1e-6, fused=True)
    for k in range(6):
        for parameter, optimizer in ((ours, one), (theirs, other)):
            optimizer.zero_grad()
            (parameter * k - 1).square().sum().backward()
            optimizer.step()
        assert torch.equal(ours, theirs)
        again = Adam([ours], lr=0.1, eps=1e-6)
        load_adam(again, [ours], adam_state(one))
        one = again
        one.param_groups[0]["lr"] = other.param_groups[0]["lr"] = 0.1 / (k + 1)
    assert adam_state(one).keys() == adam_state(other).keys()


def test_torchs_compiler_is_not_loaded() -> None:
    """It takes time and memory at the start of every run, in a window too."""
    code = (
        "import sys, torch; from nerf_core.methods.adam import Adam; p = torch.ones(3).requires_grad_();"
        "o = Adam([p], lr=0.1); p.sum().backward(); o.step(); o.zero_grad(); o.load_state_dict(o.state_dict());"
        "print(p.tolist(), 'torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.startswith("[0.9")
    assert done.stdout.endswith("False\n")
