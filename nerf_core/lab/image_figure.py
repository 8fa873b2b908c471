"""Draw what the encodings learned of a photo as a figure for a page.

It has the pictures, a detail of them, their spectra, and curves: PSNR over steps and power over frequency.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from nerf_core.common.colormaps import colored
from nerf_core.lab.spectrum import map_range, radial_profile, spectrum

# Okabe and Ito's, from the encoding that learns the least to the one that learns the most.
COLORS = {"none": "#d55e00", "basic": "#e69f00", "positional": "#56b4e9", "gaussian": "#0072b2"}
OTHER = "#009e73"  # of an encoding of another name
DASHES = (0, (3, 2))
DETAIL = 5  # the detail's side is this part of the photo's shorter side
PLACES = 8  # where a detail may begin: so many places along its side

# All in inches. The width is that of a page's text.
WIDTH, LEFT, RIGHT, TOP, BOTTOM, GAP = 7.0, 0.30, 0.46, 0.50, 0.42, 0.06
CURVES, BETWEEN = 1.95, 0.42  # height of the curves, and the room above them
DOTS = 250  # per inch

STYLE: dict[Any, Any] = {
    "font.size": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
}


@dataclass(frozen=True)
class Learned:
    """What one encoding learned.

    name: of the mapping; it chooses the colour.
    remark: its frequencies in words, such as "σ = 10 cycles".
    picture: (H, W, 3) float32 in [0, 1].
    steps: (S,) the steps at which PSNR was measured; at least one.
    train, test: (S,) PSNR in dB over the training pixels and over the test pixels; the last one is the picture's.
    """

    name: str
    remark: str
    picture: np.ndarray
    steps: np.ndarray
    train: np.ndarray
    test: np.ndarray

    @property
    def color(self) -> str:
        return COLORS.get(self.name, OTHER)


def draw_figure(photo: np.ndarray, results: Sequence[Learned], kind: str = "png") -> bytes:
    """Return the figure as the bytes of a file.

    Args:
        photo: (H, W, 3) float32 in [0, 1]: what was learned.
        results: one for each encoding, from the left to the right.
        kind: "png", "pdf" or "svg".
    """
    import matplotlib as mpl

    data = io.BytesIO()
    with mpl.rc_context(STYLE):
        page = _Page(photo, results)
        page.pictures()
        page.curves()
        page.profiles()
        page.figure.savefig(data, format=kind)
    return data.getvalue()


def detail(photo: np.ndarray, results: Sequence[Learned]) -> tuple[int, int, int]:
    """Return the square (row, column, side) in which the last encoding gains most over the first in squared error."""
    side = max(1, min(photo.shape[:2]) // DETAIL)
    gain = np.square(results[0].picture - photo).sum(-1) - np.square(results[-1].picture - photo).sum(-1)
    total = np.pad(gain.astype(np.float64), ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    gains = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    stride = max(1, side // PLACES)
    gains = gains[::stride, ::stride]
    row, column = np.unravel_index(gains.argmax(), gains.shape)
    return int(row) * stride, int(column) * stride, side


class _Page:
    """The page in work: a column for the photo and one for each result; rows for pictures, details and spectra."""

    def __init__(self, photo: np.ndarray, results: Sequence[Learned]) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.photo, self.results = photo, results
        count = len(results) + 1
        self.side = (WIDTH - LEFT - RIGHT - GAP * (count - 1)) / count  # width of a picture
        self.tall = self.side * photo.shape[0] / photo.shape[1]
        self.height = TOP + 2 * self.tall + self.side + 2 * GAP + BETWEEN + CURVES + BOTTOM
        self.figure = Figure(figsize=(WIDTH, self.height), dpi=DOTS)
        FigureCanvasAgg(self.figure)

    def axes(self, left: float, top: float, width: float, height: float, **given: Any) -> Any:
        """Return axes at a place in inches from the left and from the top."""
        place = left / WIDTH, 1 - (top + height) / self.height, width / WIDTH, height / self.height
        return self.figure.add_axes(place, **given)

    def text(self, left: float, top: float, text: str, **given: Any) -> None:
        self.figure.text(left / WIDTH, 1 - top / self.height, text, **given)

    # ---- pictures -------------------------------------------------------------------------------------------------

    def pictures(self) -> None:
        """Draw the three rows of pictures."""
        row, column, side = detail(self.photo, self.results)
        low, high = map_range(spectrum(self.photo))
        tops = TOP, TOP + self.tall + GAP, TOP + self.tall + self.side + 2 * GAP
        heights = self.tall, self.side, self.tall
        for k, picture in enumerate([self.photo, *(one.picture for one in self.results)]):
            left = LEFT + k * (self.side + GAP)
            self._heading(left + self.side / 2, None if k == 0 else self.results[k - 1])
            crop = picture[row : row + side, column : column + side]
            maps = colored(spectrum(picture), low, high)
            whole, _, spectra = (
                self._image(shown, left, top, height)
                for shown, top, height in zip((picture, crop, maps), tops, heights, strict=True)
            )
            self._frame(whole, column, row, side, side, linewidth=1.7, edgecolor="black")
            self._frame(whole, column, row, side, side, linewidth=0.8, edgecolor="white")
            self._training_frame(spectra)
        for top, height, name in zip(tops, heights, ("picture", "detail", "spectrum"), strict=True):
            self.text(LEFT - 0.07, top + height / 2, name, ha="right", va="center", rotation=90)
        self._scale(low, high, tops[2])

    def _heading(self, middle: float, one: Learned | None) -> None:
        name, color = ("photo", "black") if one is None else (one.name, one.color)
        height, width = self.photo.shape[:2]
        remark = f"{width} × {height}" if one is None else one.remark
        under = "" if one is None else f"{one.test[-1]:.2f} dB"
        given: dict[str, Any] = {"ha": "center", "va": "baseline"}
        self.text(middle, TOP - 0.33, name, fontsize=8.5, weight="bold", color=color, **given)
        self.text(middle, TOP - 0.20, remark, color="0.35", **given)
        self.text(middle, TOP - 0.07, under, **given)

    def _image(self, shown: np.ndarray, left: float, top: float, height: float) -> Any:
        axes = self.axes(left, top, self.side, height)
        axes.imshow(shown, interpolation="nearest", aspect="auto")
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        return axes

    def _frame(self, axes: Any, left: float, top: float, width: float, height: float, **given: Any) -> None:
        """Draw a frame around pixels; pixel centres are whole numbers."""
        from matplotlib.patches import Rectangle

        axes.add_patch(Rectangle((left - 0.5, top - 0.5), width, height, fill=False, **given))

    def _training_frame(self, axes: Any) -> None:
        """Frame the frequencies that the training pixels can hold: those are every second pixel each way."""
        height, width = self.photo.shape[:2]
        given = {"edgecolor": "white", "linewidth": 0.7, "linestyle": DASHES}
        self._frame(axes, width // 2 - width / 4, height // 2 - height / 4, width / 2, height / 2, **given)

    def _scale(self, low: float, high: float, top: float) -> None:
        """Draw the scale of the spectra at the right of their row."""
        axes = self.axes(WIDTH - RIGHT + GAP, top, 0.07, self.tall)
        axes.imshow(colored(np.linspace(high, low, 256)[:, None], low, high), aspect="auto", extent=(0, 1, low, high))
        axes.set(xticks=[])
        axes.yaxis.tick_right()
        axes.tick_params(length=2, labelsize=6, pad=1.5)
        axes.spines[:].set_visible(False)
        self.text(WIDTH - RIGHT + GAP, top + self.tall + 0.11, "dB", fontsize=6, ha="left", va="baseline")

    # ---- curves ---------------------------------------------------------------------------------------------------

    def curves(self) -> None:
        """Draw PSNR over steps: solid lines for test pixels, dotted ones for training pixels."""
        axes = self._plot(LEFT + 0.22, 2.55, "PSNR over steps, in dB")
        ends = np.array([one.test[-1] for one in self.results])
        low, high = min(one.train.min() for one in self.results), max(one.train.max() for one in self.results)
        apart = 0.055 * (high - low)  # names that would overlap are moved apart
        for one, at in zip(self.results, _spread(ends, apart), strict=True):
            axes.plot(one.steps, one.train, color=one.color, linewidth=0.9, linestyle=(0, (1, 1.3)))
            axes.plot(one.steps, one.test, color=one.color, linewidth=1.6)
            place = one.steps[-1], at
            axes.annotate(one.name, place, (4, 0), textcoords="offset points", va="center", color=one.color)
        axes.set(xscale="log", xlabel="steps")
        axes.plot([], [], color="0.3", linewidth=1.6, label="test pixels")
        axes.plot([], [], color="0.3", linewidth=0.9, linestyle=(0, (1, 1.3)), label="training pixels")
        axes.legend(frameon=False, loc="upper left", handlelength=1.8, labelspacing=0.25, borderaxespad=0.2)
        _plain_numbers(axes.xaxis)

    def profiles(self) -> None:
        """Draw power over frequency, of the photo and of what was learned."""
        left = LEFT + 0.22 + 2.55 + 1.05
        axes = self._plot(left, WIDTH - left - 0.12, "Power over frequency")
        frequency, power = radial_profile(self.photo)
        axes.plot(frequency, power, color="black", linewidth=1.6, label="photo")
        for one in self.results:
            axes.plot(frequency, radial_profile(one.picture)[1], color=one.color, linewidth=1.3, label=one.name)
        limit = max(self.photo.shape[:2]) / 4
        axes.axvline(limit, color="0.4", linewidth=0.7, linestyle=DASHES)
        given: dict[str, Any] = {"ha": "right", "va": "top", "color": "0.35", "fontsize": 6}
        axes.text(limit * 0.95, 0.99, "limit of the training pixels", transform=axes.get_xaxis_transform(), **given)
        axes.set(xscale="log", yscale="log", xlabel="cycles per picture", xlim=(frequency[0], frequency[-1]))
        axes.legend(frameon=False, loc="lower left", handlelength=1.6, labelspacing=0.25, borderaxespad=0.2)
        _plain_numbers(axes.xaxis)

    def _plot(self, left: float, width: float, title: str) -> Any:
        top = self.height - BOTTOM - CURVES
        self.text(left, top - 0.09, title, ha="left", va="baseline", weight="bold")
        axes = self.axes(left, top, width, CURVES)
        axes.tick_params(which="both", length=2.5, pad=2)
        return axes


def _plain_numbers(axis: Any) -> None:
    """Write 1, 2, 5, 10, 20 … on a logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axis.set_minor_formatter(NullFormatter())


def _spread(heights: np.ndarray, apart: float) -> np.ndarray:
    """Move heights upwards, from the lowest on, until each is at least `apart` above the one below."""
    moved = heights.astype(np.float64)
    order = np.argsort(moved, kind="stable")
    for below, above in pairwise(order):
        moved[above] = max(moved[above], moved[below] + apart)
    return moved
