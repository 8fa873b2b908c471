"""Time other programs and this one on the same photos, the same split and the same processor, in turns.

    python tests/benchmarks/peers/compare.py DATA --times 10 40 80 200 --peers ours opensplat --opensplat PATH

DATA is a posed capture. Its photos are downscaled and made a pinhole's, once, for all programs (`photos.py`). Those of
its test split, or else every 8th, are held out. Each program trains in a process of its own, once for each of --times,
with as many iterations (or seconds) as take so many CPU seconds: a short run, then the runs before, tell how many. CPU
seconds are user and system time of that process and its children, from its start to its end: reading, compiling and
writing count. Drawing the held-out photos does not count. PSNR is that of nerf_core.

Writes peers.json, peers.png and the pictures to --out, and prints a table. With --keep, what is in peers.json stays
but for what is measured again. A program is a file in `adapters`. None of them is part of this project.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import nerf_core  # noqa: F401  before torch: it sets how OpenMP's threads wait

# isort: split
import numpy as np
from PIL import Image

from nerf_core.common.device import usable_cores
from nerf_core.rendering.images import to_bytes
from nerf_core.training.metrics import psnr

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from machine import processor  # noqa: E402
from peers.photos import prepare  # noqa: E402

CLOSE = 0.1  # share by which CPU seconds may differ from what was asked
ATTEMPTS = 4
PATIENCE = 10  # times the CPU seconds asked for: then the process is ended


def adapters() -> dict[str, ModuleType]:
    """Load the files in `adapters`. Each has these members.

    NAME, UNIT: what the table calls the program and its amounts; --peers takes the first word of NAME.
    FIRST: the amount of the first, short run.
    OPTION, HELP: a command-line option, given to the functions as text ("" without it).
    missing(given): what to install, or "" if all is there.
    command(photos, folder, amount, given): the words that train so much and write the model into `folder`.
    render(photos, folder, given): the held-out views by that model, float (H, W, 3), in the order of test_filenames.
    """
    files = sorted((HERE / "adapters").glob("*.py"))
    found = [importlib.import_module(f"peers.adapters.{file.stem}") for file in files]
    return {peer.NAME.split()[0].lower(): peer for peer in found}


class PeerError(Exception):
    """A program failed; the text says how."""


def timed(command: list[str], log: Path, limit: float) -> dict[str, float]:
    """Run a command to its end. Returns CPU seconds, wall seconds and peak memory (GiB) of it and its children."""
    begin = time.perf_counter()
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        timer = threading.Timer(limit, process.kill)
        timer.start()
        _, status, usage = os.wait4(process.pid, 0)
        timer.cancel()
    wall = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        end = log.read_text(encoding="utf-8", errors="replace").strip()[-300:]
        ended = f"ended after {limit:g} s" if wall >= limit else f"exit status {process.returncode}"
        raise PeerError(f"{ended}: {end}")
    return {"cpu": usage.ru_utime + usage.ru_stime, "wall": wall, "peak_gib": usage.ru_maxrss / 2**20}


def next_amount(known: list[tuple[float, float]], first: float, target: float) -> float:
    """Return the amount that should take `target` CPU seconds.

    Args:
        known: (amount, CPU seconds) of the runs before, in order. The last counts most: the first may have compiled.
        first: the amount if there are none.
        target: CPU seconds.
    """
    if not known:
        return first
    amount, seconds = known[-1]
    for earlier_amount, earlier_seconds in reversed(known[:-1]):  # two runs tell the time to start apart
        slope = (amount - earlier_amount) / (seconds - earlier_seconds) if seconds != earlier_seconds else 0.0
        if slope > 0 and abs(amount / earlier_amount - 1) > CLOSE:
            return max(amount + slope * (target - seconds), amount * min(1.0, target / seconds) / 2)
    return amount * target / seconds


def measure(
    peer: ModuleType, photos: Path, out: Path, target: float, known: list[tuple[float, float]], given: str
) -> dict[str, Any]:
    """Train for about `target` CPU seconds, and compare the held-out photos. `known` grows by the runs."""
    attempt = 0
    while True:
        attempt += 1
        amount = next_amount(known, peer.FIRST, target)
        folder = out / f"{target:g}s-{attempt}-{time.time_ns()}"
        folder.mkdir(parents=True)
        found = timed(peer.command(photos, folder, amount, given), folder / "log.txt", max(600, PATIENCE * target))
        known.append((amount, found["cpu"]))
        if abs(found["cpu"] / target - 1) <= CLOSE or attempt == ATTEMPTS:
            break
    whole = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
    values = []
    for name, image in zip(whole["test_filenames"], peer.render(photos, folder, given), strict=True):
        truth = np.asarray(Image.open(photos / name)).astype(np.float32) / 255
        values.append(psnr(np.clip(image, 0, 1).astype(np.float32), truth))
        Image.fromarray(to_bytes(np.concatenate([image, truth], 1))).save(folder / Path(name).name)
    return {"asked": target, **found, "amount": amount, "psnr": statistics.mean(values), "each": values,
            "folder": str(folder)}  # fmt: skip


def table(results: dict[str, Any]) -> str:
    """Return the results as a table of Markdown."""
    lines = ["| program | CPU s | wall s | PSNR, dB | trained | peak GiB |", "|---|---|---|---|---|---|"]
    for peer in results["peers"].values():
        if peer.get("missing"):
            lines.append(f"| {peer['name']} | not measured: {peer['missing']} | | | | |")
        for run in sorted(peer.get("runs", []), key=lambda run: run["cpu"]):
            amount = f"{run['amount']:,.0f} {peer['unit']}"
            words = (f"{run['cpu']:.0f}", f"{run['wall']:.0f}", f"{run['psnr']:.2f}", amount, f"{run['peak_gib']:.1f}")
            lines.append(f"| {peer['name']} | {' | '.join(words)} |")
    return "\n".join(lines)


def plot(results: dict[str, Any], file: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(10, 4.5), dpi=120, sharey=True, layout="constrained")
    for key, axes in zip(("cpu", "wall"), panels, strict=True):
        for color, peer in enumerate(results["peers"].values()):
            runs = sorted(peer.get("runs", []), key=lambda run: run[key])
            if runs:
                axes.plot(
                    [r[key] for r in runs], [r["psnr"] for r in runs], "o-", color=f"C{color}", label=peer["name"]
                )
        axes.set(xlabel={"cpu": "CPU seconds", "wall": "wall seconds"}[key], xlim=(0, None))
        axes.grid(alpha=0.3)
    panels[0].set(ylabel="PSNR on held-out photos, dB")
    if panels[0].lines:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(f"{results['photos']}\n{results['machine']}", fontsize=9)
    figure.savefig(file)


def parser(found: dict[str, ModuleType]) -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("data", type=Path, metavar="DATA", help="a posed capture that nerf_core can load")
    made.add_argument("--times", type=float, nargs="+", default=[10, 40, 80, 200], help="CPU seconds of training")
    made.add_argument("--peers", nargs="+", default=list(found), choices=list(found))
    made.add_argument("--format", default="auto", help="dataset format of DATA")
    made.add_argument("--downscale", type=int, default=1)
    made.add_argument("--out", type=Path, default=Path("runs/peers"))
    made.add_argument("--keep", action="store_true", help="keep what peers.json holds of other programs and times")
    for peer in found.values():
        made.add_argument(f"--{peer.OPTION}", default="", help=peer.HELP)
    return made


def earlier(file: Path, photos: str, keep: bool) -> dict[str, Any]:
    """Return the programs' results in peers.json that stay. Ends the program if they are of other photos."""
    if not keep or not file.exists():
        return {}
    stored = json.loads(file.read_text(encoding="utf-8"))
    if stored["photos"] != photos:
        raise SystemExit(f"{file} is of {stored['photos']}, not of {photos}: give another --out or leave out --keep")
    return stored["peers"]


def main() -> None:
    found = adapters()
    args = parser(found).parse_args()
    photos = args.out / "photos"
    whole = prepare(args.data, args.format, args.downscale, photos)
    frame, counts = whole["frames"][0], [len(whole[f"{split}_filenames"]) for split in ("train", "test")]
    words = f"{args.data.name}, {frame['w']}×{frame['h']}, {counts[0]} photos to train on, {counts[1]} held out"
    machine = f"{processor()}, {usable_cores()} cores, {platform.system()}"
    print(f"{words}\n{machine}", flush=True)
    file = args.out / "peers.json"
    results = {"photos": words, "machine": machine, "peers": earlier(file, words, args.keep)}
    for time_asked in sorted(args.times):
        for name in args.peers:
            peer, given = found[name], getattr(args, found[name].OPTION.replace("-", "_"))
            entry = results["peers"].setdefault(name, {"name": peer.NAME, "unit": peer.UNIT, "runs": [], "known": []})
            entry["missing"] = done = peer.missing(given)
            if not done:
                try:
                    run = measure(peer, photos, args.out / name, time_asked, entry["known"], given)
                    done = "{asked:g} CPU s: {cpu:.1f} taken, {wall:.1f} s, {psnr:.2f} dB".format(**run)
                    entry["runs"] = [r for r in entry["runs"] if r["asked"] != time_asked]
                    entry["runs"].append({**run, "machine": machine})
                except PeerError as error:
                    entry["missing"] = done = str(error)
            print(f"{name}: {done}", flush=True)
            file.write_text(json.dumps(results, indent=1), encoding="utf-8")
    plot(results, args.out / "peers.png")
    print(table(results))


if __name__ == "__main__":
    main()
