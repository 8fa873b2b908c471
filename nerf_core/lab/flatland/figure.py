"""Draw the figure of Flatland's report: the fields of all rows, and their PSNR over steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nerf_core.lab.figures import BLUE, GREEN, GRID, ORANGE, RED, STYLE, blank_page, png_of
from nerf_core.lab.records import Result

COLORS = (BLUE, ORANGE, GREEN, RED, "#cc79a7", "#56b4e9", "#f0e442", "0.4")  # Okabe and Ito's
COLUMNS = 5


def draw_figure(results: Mapping[str, Result], pictures: Path) -> bytes:
    """Return a PNG.

    Args:
        results: by row.
        pictures: the folder with a folder of pictures for each row.
    """
    import matplotlib as mpl
    from PIL import Image

    shown = {"the world": Image.open(pictures / next(iter(results)) / "truth.png")}
    shown |= {f"{key}: {one['psnr']:.1f} dB": Image.open(pictures / key / "field.png") for key, one in results.items()}
    columns = min(len(shown), COLUMNS)
    rows = -(-len(shown) // columns)
    with mpl.rc_context(STYLE):
        page = blank_page(max(1.5 * columns, 4.2), 1.65 * rows + 2.2)
        above, below = page.subfigures(2, 1, height_ratios=[1.65 * rows, 2.2])
        grid = above.subplots(rows, columns, squeeze=False).flatten()
        for axes in grid:
            axes.set_axis_off()
        for axes, (title, picture) in zip(grid, shown.items(), strict=False):
            axes.imshow(np.asarray(picture))
            axes.set_title(title, fontsize=8)
        axes = below.subplots()
        for color, (key, one) in zip(COLORS, results.items(), strict=False):
            axes.plot(*one["curve"], color=color, lw=1.4, label=key)
        axes.set(xlabel="steps", ylabel="PSNR of held-out photos (dB)")
        axes.grid(color=GRID, lw=0.6)
        if len(results) > 1:
            axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return png_of(page)
