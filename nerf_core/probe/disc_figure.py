"""The disc of an opened pixel's figure: the radiance of a point in all directions of a half space."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerf_core.probe.directions import DISC_SIZE, disc_grid
from nerf_core.probe.records import Opened
from nerf_core.probe.sightings import unseen


def draw_disc(axes: Any, one: Opened) -> None:
    """Draw the radiance of an opened pixel, the photos that see the point, and the ray. Axes stay empty without it."""
    import matplotlib as mpl
    from matplotlib.patches import Circle

    axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), xticks=[], yticks=[], aspect="equal", frame_on=False)
    radiance = one.radiance
    if radiance is None:
        return
    rim = axes.add_patch(Circle((0, 0), 1, fill=False, lw=0.6))
    x, y, inside = disc_grid()
    rgb = np.nan_to_num(_over_the_rim(radiance.disc_image()[..., :3])).clip(0, 1)
    axes.imshow(rgb, extent=(-1, 1, -1, 1), interpolation="bilinear", zorder=0).set_clip_path(rim)
    ink = "black" if rgb[inside].mean() > 0.4 else "white"
    far = np.zeros(inside.shape)
    far[inside] = unseen(radiance.directions[-int(inside.sum()) :], one.evidence)
    if far.any():
        with mpl.rc_context({"hatch.color": ink}):
            hatched = axes.contourf(x, y, _over_the_rim(far), levels=[0.5, 1.5], colors="none", hatches=["/////"])
        hatched.set_clip_path(rim)
    drawn = False
    if one.evidence is not None:
        seen = one.evidence.directions[one.evidence.seen]
        places = radiance.disc_position(seen)  # NaN is not drawn
        drawn = bool(np.isfinite(places).any())
        axes.plot(places[:, 0], places[:, 1], "o", ms=2.5, mfc="white", mec="black", mew=0.5)
    axes.plot(*radiance.disc_position(-one.ray.direction), "+", color=ink, ms=7, mew=1)
    where, dependence = f"at the point, t = {radiance.t:.3g}", radiance.dependence
    if radiance.default == "layer" and radiance.layer is not None:
        where, dependence = f"of the layer at t = {radiance.t:.3g}", radiance.layer_dependence
    axes.set_title(f"radiance {where}", fontsize=8)
    notes = [f"view-dependence {dependence:.3f}", "+ this ray" + (", ○ photos" if drawn else "")]
    axes.set_xlabel("\n".join(notes + ["hatched: no photo looked from there"] * bool(far.any())), fontsize=7)


def _over_the_rim(values: np.ndarray) -> np.ndarray:
    """Extend values (DISC_SIZE, DISC_SIZE, ...) over the rim: a pixel outside the disc gets the nearest inside."""
    x, y, inside = disc_grid()
    out = np.where(inside, 1, np.hypot(x, y) / (1 - 1.5 / DISC_SIZE))
    row, column = (np.rint((v / out * DISC_SIZE + DISC_SIZE - 1) / 2).astype(int) for v in (-y, x))
    return values[row, column]
