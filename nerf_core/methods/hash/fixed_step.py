"""The hash method's training step with fixed shapes, so that CUDA can replay it as one graph.

A step consists of about a hundred small kernels, and launching them takes longer than running them. A graph records
them once. Each step copies its inputs into the tensors that the graph reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from torch import Tensor

from nerf_core.geometry.spaces import BoxRays
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.methods.hash.field import HashField
from nerf_core.volume.cells import Cells
from nerf_core.volume.occupancy import softened

EAGER = 3  # steps before the recording, in which kernels are compiled and libraries initialised


class FixedStep:
    """Compute gradients and update the model, for `rays` rays with at most `capacity` samples in all.

    A ray whose samples do not all fit is left out of the step, because it would be composited wrongly.

    step: the distance between samples in cells.
    length: the length of a sample in box coordinates; it turns density into optical depth.
    into: the tensor that receives the table's gradient.
    update: makes the optimisers' steps after the gradients; it is recorded too.
    batch: the rays over which the error is averaged; 0: these rays alone.
    """

    def __init__(
        self, field: HashField, kernels: PackedKernels, cells: Cells, rays: int, capacity: int, step: float,
        length: float, background: Tensor, into: Tensor, update: Callable[[], None],
        batch: int = 0,
    ) -> None:  # fmt: skip
        self.field, self.kernels, self.capacity, self.step, self.length = field, kernels, capacity, step, length
        self.background, self.into, self.update = background, into, update
        self.cells = replace(cells, kinds=cells.kinds.clone(), leap=cells.leap.clone())
        self.scale = 2 / (3 * (batch or rays))
        device = background.device
        one, three = torch.zeros(rays, device=device), torch.zeros(rays, 3, device=device)
        self.rays = BoxRays(three, three.clone(), three.clone(), one, one.clone())
        self.offsets, self.truth = one.clone(), three.clone()
        self.error, self.found = torch.zeros((), device=device), torch.zeros((), dtype=torch.long, device=device)
        self.calls = 0
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, cells: Cells, rays: BoxRays, offsets: Tensor, truth: Tensor) -> tuple[float, int]:
        """Make one step. Returns the summed squared error, scaled up for the rays left out, and the samples found."""
        for f in fields(BoxRays):
            getattr(self.rays, f.name).copy_(getattr(rays, f.name))
        self.offsets.copy_(offsets)
        self.truth.copy_(truth)
        self.cells.kinds.copy_(cells.kinds)
        self.cells.leap.copy_(cells.leap)
        self.calls += 1
        if self.background.device.type != "cuda":
            self.run()
        elif self.calls <= EAGER:  # on a separate stream, like the recording
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                self.run()
            torch.cuda.current_stream().wait_stream(stream)
        else:
            if self.graph is None:
                self.graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self.graph):
                    self.run()
            self.graph.replay()
        return float(self.error), int(self.found)

    def run(self) -> None:
        """The step itself. Nothing in it waits for the device, and every shape is known in advance."""
        samples = self.kernels.march(self.cells, self.rays, self.step, self.offsets, self.capacity)
        total = samples.row_offsets[-1]
        place = torch.arange(self.capacity, device=total.device)
        ray = (torch.searchsorted(samples.row_offsets, place, right=True) - 1).clamp(max=len(self.rays) - 1)
        whole = samples.row_offsets[1:] < self.capacity
        features = self.field.encode(samples.x).requires_grad_()
        raw, geometry = self.field.geometry(features)
        rgb = self.field.radiance(geometry, self.rays.views[ray])
        tau = softened(raw) * self.length * (place < total)
        known = tau.detach(), rgb.detach(), samples, self.background
        off = torch.where(whole[:, None], self.kernels.composite(*known)[:, :3] - self.truth, 0)
        torch.autograd.backward([tau, rgb], self.kernels.composite_gradient(off * self.scale, *known))
        assert features.grad is not None
        self.kernels.encode_gradient(features.grad, self.field.levels, samples.x, self.into)
        self.update()
        self.error.copy_(off.square().sum() * len(whole) / whole.sum().clamp(min=1))
        self.found.copy_(total)
