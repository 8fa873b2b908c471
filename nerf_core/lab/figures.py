"""Draw the figures of the studies, for a page."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from nerf_core.geometry.scene import Scene
from nerf_core.lab.records import Result
from nerf_core.rendering.images import to_bytes
from nerf_core.training.eval_pictures import picture_names

INK, GRID = "0.25", "0.9"
BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"  # Okabe and Ito's
DOTS = 160  # per inch
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": "0.1",
}
CROP = 0.22  # the side of a crop, as a share of the picture's shorter side
FRAMES = (RED, BLUE)  # of the two crops


def blank_page(width: float, height: float) -> Any:
    """Return an empty figure of this size in inches, which no window shows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    page = Figure(figsize=(width, height), dpi=DOTS, layout="constrained")
    FigureCanvasAgg(page)
    return page


def png_of(page: Any) -> bytes:
    """Return a figure as a PNG."""
    data = io.BytesIO()
    page.savefig(data, format="png")
    return data.getvalue()


def memory_plot(done: Sequence[Result], value_bytes: int) -> bytes:
    """Return a PNG: PSNR and memory over the side N of a grid.

    Args:
        done: results with side and psnr, by ascending side.
        value_bytes: of a vertex.
    """
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        page = blank_page(5.2, 2.6)
        left, right = page.subplots(1, 2)
        sides = [r["side"] for r in done]
        for axes in (left, right):
            axes.set_xscale("log", base=2)
            axes.set_xticks(sides, [str(n) for n in sides])
            axes.minorticks_off()
            axes.set_xlabel("side N of the grid")
            axes.grid(color=GRID, lw=0.6)
            axes.set_axisbelow(True)
        left.plot(sides, [n**3 * value_bytes / 1e6 for n in sides], "o-", color=RED, ms=4, lw=1.4)
        left.set_yscale("log")
        left.set_ylabel("memory of the grid (MB)")
        left.set_title("memory: N³", fontsize=9, loc="left")
        right.plot(sides, [r["psnr"] for r in done], "o-", color=BLUE, ms=4, lw=1.4)
        right.set_ylabel("PSNR of held-out views (dB)")
        right.set_title("quality", fontsize=9, loc="left")
        return png_of(page)


def sampling_plot(groups: Mapping[tuple[str, int], Sequence[float]]) -> bytes:
    """Return a PNG: PSNR over network calls per ray. groups: PSNRs by (way, calls), one for each seed."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        page = blank_page(4.2, 2.8)
        axes = page.subplots()
        for way, color, mark in (("uniform", ORANGE, "s"), ("hierarchical", BLUE, "o")):
            calls = sorted(n for name, n in groups if name == way)
            if calls:
                values = [groups[way, n] for n in calls]
                axes.plot(calls, [mean(v) for v in values], mark + "-", color=color, ms=4, lw=1.4, label=way)
                for n, own in zip(calls, values, strict=True):
                    axes.plot([n] * len(own), own, ".", color=color, ms=3, alpha=0.5)
        every = sorted({n for _, n in groups})
        axes.set_xscale("log", base=2)
        axes.set_xticks(every, [str(n) for n in every])
        axes.minorticks_off()
        axes.set(xlabel="network calls per ray", ylabel="PSNR of held-out views (dB)")
        axes.grid(color=GRID, lw=0.6)
        axes.legend(frameon=False, loc="best")
        return png_of(page)


def ablation_plot(groups: Mapping[int, Sequence[float]]) -> bytes:
    """Return a PNG: each row's PSNR less that of the complete model, here and in the paper. groups: PSNRs by row."""
    import matplotlib as mpl

    from nerf_core.lab.published import ABLATIONS
    from nerf_core.lab.studies.ablate import COMPLETE, TABLE

    base = COMPLETE if COMPLETE in groups else max(groups)
    with mpl.rc_context(STYLE):
        page = blank_page(5.6, 0.7 + 0.34 * len(groups))
        axes = page.subplots()
        for place, n in enumerate(sorted(groups)):
            own = [value - mean(groups[base]) for value in groups[n]]
            axes.barh(place - 0.17, mean(own), 0.32, color=BLUE, label="here" if not place else None)
            axes.plot(own, [place - 0.17] * len(own), ".", color="black", ms=3)
            theirs = ABLATIONS[n].psnr - ABLATIONS[base].psnr
            axes.barh(place + 0.17, theirs, 0.32, color="0.75", label="published" if not place else None)
        names = [f"{n}) {TABLE[n].name}" for n in sorted(groups)]
        axes.set_yticks(range(len(groups)), names)
        axes.invert_yaxis()
        axes.axvline(0, color=INK, lw=0.8)
        axes.set_xlabel(f"PSNR less that of {TABLE[base].name.lower()} (dB)")
        axes.grid(axis="x", color=GRID, lw=0.6)
        axes.set_axisbelow(True)
        axes.legend(frameon=False, loc="best")
        return png_of(page)


def comparison(
    scene: Scene, views: Sequence[int], results: Mapping[str, Result], names: Sequence[str], pictures: Path
) -> bytes:
    """Return a PNG: for each view its photo, two crops of it, and the same crops of every method.

    The crops are where the photo has most detail.

    Args:
        scene: the scene.
        views: held-out views.
        results: by method; `images` has the PSNR of each view.
        names: the methods, in their order.
        pictures: the folder with a folder of pictures for each method.
    """
    import matplotlib as mpl
    from matplotlib.patches import Rectangle
    from PIL import Image

    pngs = picture_names([view.name for view in scene.views])
    with mpl.rc_context(STYLE):
        page = blank_page(2.1 + 1.05 * (len(names) + 1), 2.25 * len(views))
        grid = page.add_gridspec(2 * len(views), 2 + len(names), width_ratios=[2.1, *([1.0] * (len(names) + 1))])
        for k, index in enumerate(views):
            truth = to_bytes(scene.images[index].astype(np.float32) / 65535)
            files = {name: pictures / name / pngs[scene.views[index].name] for name in names}
            shown = {name: np.asarray(Image.open(file).convert("RGB")) for name, file in files.items()}
            whole = page.add_subplot(grid[2 * k : 2 * k + 2, 0])
            whole.imshow(truth, interpolation="nearest")
            whole.set_axis_off()
            whole.set_title(scene.views[index].name, fontsize=7, loc="left")
            side = max(4, round(CROP * min(truth.shape[:2])))
            for j, (y, x) in enumerate(detailed(truth, side, len(FRAMES))):
                whole.add_patch(Rectangle((x - 0.5, y - 0.5), side, side, fill=False, ec=FRAMES[j], lw=1.2))
                for column, name in enumerate(["photo", *names]):
                    axes = page.add_subplot(grid[2 * k + j, 1 + column])
                    picture = truth if name == "photo" else shown[name]
                    axes.imshow(picture[y : y + side, x : x + side], interpolation="nearest")
                    axes.set(xticks=[], yticks=[])
                    for spine in axes.spines.values():
                        spine.set(visible=True, edgecolor=FRAMES[j], linewidth=1.2)
                    if j == 0:
                        psnr = "" if name == "photo" else f"\n{results[name]['images'][k]['psnr']:.1f} dB"
                        axes.set_title(f"{name}{psnr}", fontsize=7)
        return png_of(page)


def detailed(image: np.ndarray, side: int, count: int) -> list[tuple[int, int]]:
    """Return the upper left corners (y, x) of the `count` squares of an image with most detail, which do not overlap.

    Detail is the sum of squared differences between neighbouring pixels.

    Args:
        image: (H, W, 3) uint8.
        side: of the squares, in pixels.
        count: of squares.
    """
    gray = image.astype(np.float64).mean(-1)
    change = np.zeros_like(gray)
    change[1:] += np.diff(gray, axis=0) ** 2
    change[:, 1:] += np.diff(gray, axis=1) ** 2
    total = np.pad(change, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    score = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    found: list[tuple[int, int]] = []
    for _ in range(count):
        y, x = np.unravel_index(int(score.argmax()), score.shape)
        found.append((int(y), int(x)))
        score[max(0, y - side + 1) : y + side, max(0, x - side + 1) : x + side] = -1.0
    return found
