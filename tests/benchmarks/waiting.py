"""Measure the training speed for several spin counts of OpenMP's threads, alone and beside a busy process.

    python tests/benchmarks/waiting.py

Threads that wait spin so many times before they sleep. Each measurement is a fresh process that trains the paper's NeRF
on the demo scene, and gives the rays per second of its last 40 steps. The counts take turns, and each figure is the
median of `--rounds` measurements. The busy process keeps one core busy.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time

COUNTS = ("default", "0", "300", "1000", "3000", "10000", "100000")
WARM, STEPS = 40, 40


def train() -> None:
    """Train in this child process, and print rays per second."""
    from nerf_core.datasets import LoadOptions, load_scene
    from nerf_core.training.settings import RunSettings
    from nerf_core.training.trainer import Trainer

    trainer = Trainer(load_scene(None, LoadOptions(downscale=4)), RunSettings(method="nerf", preset="quick"))
    for _ in range(WARM):
        trainer.step()
    begin = time.perf_counter()
    for _ in range(STEPS):
        trainer.step()
    print(STEPS * trainer.method.config.rays / (time.perf_counter() - begin))


def measured(count: str) -> float:
    # GNU OpenMP's default is 300,000 spins if there is a core for every thread
    environment = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "300000" if count == "default" else count}
    done = subprocess.run(
        [sys.executable, __file__, "--child"], env={**os.environ, **environment}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return float(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        train()
        return
    for crowded in (False, True):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if crowded else None
        try:
            rates: dict[str, list[float]] = {count: [] for count in COUNTS}
            for _ in range(args.rounds):
                for count in COUNTS:
                    rates[count].append(measured(count))
        finally:
            if busy is not None:
                busy.kill()
                busy.wait()
        print("beside a busy process:" if crowded else "alone:")
        for count, values in rates.items():
            print(
                f"  {count:>8} {statistics.median(values):6.0f} rays/s (min {min(values):.0f}, max {max(values):.0f})"
            )


if __name__ == "__main__":
    main()
