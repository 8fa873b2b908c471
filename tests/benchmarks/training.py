"""Compare the training speed of the paper's NeRF with that of the same model written plainly in float32.

    python tests/benchmarks/training.py

Both train in turns on the same batches in one process. Prints medians and spread of five rounds, in rays per second.
It measures twice: with fresh weights, where every sample has a gradient, and after `--warm` steps on the demo scene,
where most of space is known to be empty.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import torch
from torch import Tensor, nn
from torch.nn import functional

from nerf_core.common.device import describe, fast_precision, usable_cores
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.rays import Rays
from nerf_core.methods.nerf.config import NerfConfig
from nerf_core.methods.nerf.method import Nerf
from nerf_core.training.batches import Draw, PixelSampler
from nerf_core.training.trainer import nothing


class PlainNetwork(nn.Module):
    """Figure 7 of the paper, written the obvious way."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(63 if i == 0 else 319 if i == 5 else 256, 256) for i in range(8)])
        self.sigma, self.feature = nn.Linear(256, 1), nn.Linear(256, 256)
        self.branch, self.rgb = nn.Linear(283, 128), nn.Linear(128, 3)

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        h = x
        for i, layer in enumerate(self.layers):
            h = functional.relu(layer(torch.cat([x, h], -1) if i == 5 else h))
        branch = functional.relu(self.branch(torch.cat([self.feature(h), d], -1)))
        return self.sigma(h)[..., 0], torch.sigmoid(self.rgb(branch))


def encode(p: Tensor, frequencies: int) -> Tensor:
    parts = [p]
    for k in range(frequencies):
        parts += [torch.sin(2**k * p), torch.cos(2**k * p)]
    return torch.cat(parts, -1)


class PlainNerf:
    """NeRF as in the best-known PyTorch port: dense autograd, all rays at once, float32."""

    def __init__(self, white: Tensor) -> None:
        self.coarse, self.fine, self.white = PlainNetwork(), PlainNetwork(), white
        self.optimizer = torch.optim.Adam([*self.coarse.parameters(), *self.fine.parameters()], lr=5e-4, eps=1e-7)

    def load(self, method: Nerf) -> None:
        for mine, network in ((self.coarse, method.networks["coarse"]), (self.fine, method.networks["fine"])):
            values = dict(network.named_parameters())
            for layer in range(8):
                mine.layers[layer].load_state_dict({k: values[f"trunk.{layer}.{k}"] for k in ("weight", "bias")})
            heads = {"density": mine.sigma, "feature": mine.feature, "branch": mine.branch, "rgb": mine.rgb}
            for name, own in heads.items():
                own.load_state_dict({k: values[f"{name}.{k}"] for k in ("weight", "bias")})

    def render(self, network: PlainNetwork, rays: Rays, t: Tensor) -> tuple[Tensor, Tensor]:
        x = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        d = encode(rays.directions, 4)[:, None].expand(*t.shape, -1)
        sigma, rgb = network(encode(x, 10), d)
        delta = torch.cat([t[:, 1:] - t[:, :-1], torch.full_like(t[:, :1], 1e10)], -1)
        alpha = 1 - torch.exp(-functional.relu(sigma) * delta)
        ones = torch.ones_like(alpha[:, :1])
        weights = alpha * torch.cumprod(torch.cat([ones, 1 - alpha + 1e-10], -1), -1)[:, :-1]
        return (weights[..., None] * rgb).sum(1) + (1 - weights.sum(-1))[:, None] * self.white, weights

    def train(self, rays: Rays, truth: Tensor) -> None:
        t = rays.near[:, None] + (rays.far - rays.near)[:, None] * torch.linspace(0, 1, 64)
        middle = (t[:, 1:] + t[:, :-1]) / 2
        lower, upper = torch.cat([t[:, :1], middle], -1), torch.cat([middle, t[:, -1:]], -1)
        t = lower + (upper - lower) * torch.rand_like(t)
        coarse, weights = self.render(self.coarse, rays, t)
        middle = (t[:, 1:] + t[:, :-1]) / 2
        pdf = weights[:, 1:-1].detach() + 1e-5
        cdf = torch.cumsum(pdf / pdf.sum(-1, keepdim=True), -1)
        cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], -1)
        u = torch.rand(len(t), 128)
        above = torch.searchsorted(cdf, u, right=True).clamp(1, 62)
        low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
        left, right = middle.gather(1, above - 1), middle.gather(1, above)
        fine_t = left + (right - left) * ((u - low) / (high - low).clamp(min=1e-5))
        fine, _ = self.render(self.fine, rays, torch.sort(torch.cat([t, fine_t], -1), -1).values)
        loss = functional.mse_loss(coarse, truth) + functional.mse_loss(fine, truth)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=256, help="rays a step, for both")
    parser.add_argument("--warm", type=int, default=400, help="training steps before the second comparison")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(usable_cores())
    device = torch.device("cpu")
    scene = load_scene(None, LoadOptions())
    method = Nerf(scene, NerfConfig(rays=args.rays, one_image=False, precision=fast_precision(device)), device, 0)
    warm = PixelSampler(scene, 0, device, 1)
    batches = PixelSampler(scene, 0, device, 2)
    peer = PlainNerf(torch.tensor(scene.background))
    precision = method.networks["coarse"].precision
    print(f"{describe(device)}, {precision}, {args.rays} rays × (64 + 192) samples")
    print("OpenMP:", os.environ["OMP_WAIT_POLICY"], "| torch", torch.__version__)
    for label, steps in (("fresh weights", 0), (f"after {args.warm} steps of 64 rays", args.warm)):
        for step in range(steps):
            method.train(*warm.draw(Draw(64, crop=0.5 if step < 200 else 1.0)), step, None, nothing)
        peer.load(method)
        ours, plain = [], []
        for _ in range(args.rounds + 1):  # the first warms up
            batch = batches.draw(Draw(args.rays))
            ours.append(seconds(lambda batch=batch: method.train(*batch, 10**6, None, nothing)))
            plain.append(seconds(lambda batch=batch: peer.train(*batch)))
        ratios = [p / o for p, o in zip(plain[1:], ours[1:], strict=True)]
        row = [args.rays / statistics.median(v[1:]) for v in (ours, plain)]
        print(
            f"{label}: {row[0]:.0f} rays/s, plain float32 {row[1]:.0f} rays/s, ratio {statistics.median(ratios):.2f} "
            f"(min {min(ratios):.2f}, max {max(ratios):.2f})"
        )


if __name__ == "__main__":
    main()
