"""The figure of a ray without samples: its colour, and the places that the method looked at, if it tells them."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerf_core.probe.records import RayProbe

VISIT, DEPTH = "#0072b2", "black"  # Okabe and Ito's
NUMBERED = 24  # visits: more than these are dots without numbers


def draw_visits(axes: Any, ray: RayProbe) -> None:
    """Draw the visits over t, the first on top, and a line at the depth. Without visits, the axes say so."""
    t, count = ray.visited.astype(np.float64), len(ray.visited)
    if not count:
        axes.set(xticks=[], yticks=[], frame_on=False)
        axes.text(0.5, 0.5, "no samples along the ray", transform=axes.transAxes, ha="center", va="center", color="0.3")
        return
    order = np.arange(1, count + 1)
    numbered = count <= NUMBERED
    axes.plot(t, order, "-", color=VISIT, lw=0.8, alpha=0.6)
    axes.plot(t, order, "o", color=VISIT, ms=7.5 if numbered else 3, mec="white", mew=0.6, label="visit")
    for k, place in zip(order.tolist() if numbered else (), t.tolist(), strict=False):
        if np.isfinite(place):
            axes.text(place, k, f"{k}", color="white", fontsize=5.5, ha="center", va="center_baseline", clip_on=True)
    if ray.depth_expected is not None:
        axes.axvline(ray.depth_expected, color=DEPTH, lw=0.8, zorder=0, label="depth")
    axes.set(ylim=(count + 0.8, 0.2), xlabel="t (world units)", ylabel="visit")
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.legend(frameon=False, fontsize=6, loc="lower left", ncols=2, bbox_to_anchor=(0, 1.02), borderaxespad=0)


def draw_color(axes: Any, ray: RayProbe) -> None:
    """Draw the pixel's colour as a square, with its numbers."""
    from matplotlib.patches import Rectangle

    axes.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[], aspect="equal", frame_on=False)
    color = np.nan_to_num(ray.color.astype(np.float64)).clip(0, 1)
    axes.add_patch(Rectangle((-0.95, -0.95), 1.9, 1.9, facecolor=color, edgecolor="black", lw=0.6))
    axes.set_title("the pixel's colour", fontsize=8)
    numbers = ", ".join(f"{v:.3f}" for v in ray.color.tolist())
    depth = "no depth" if ray.depth_expected is None else f"depth {ray.depth_expected:.4g}"
    axes.set_xlabel(f"{numbers}\nopacity {ray.opacity:.3f}, {depth}", fontsize=7)
