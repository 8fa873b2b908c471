"""The stages by which a method explains one ray, from its samples to its colour, and the charts they consist of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nerf_core.common.language import figure, marked, phrase
from nerf_core.common.text import number, triple

if TYPE_CHECKING:
    from nerf_core.geometry.rays import Samples
    from nerf_core.volume.cells import Cells


class Stems(NamedTuple):
    """A chart of values y (S,) at the samples t (S,); `name` labels its axis."""

    name: str
    t: np.ndarray
    y: np.ndarray


class Marks(NamedTuple):
    """A chart of positions t (S,) on the ray, with the edges of their bins (empty: no bins)."""

    t: np.ndarray
    edges: np.ndarray


class BarCode(NamedTuple):
    """A chart of signed numbers as coloured bars: one row of values (N,) per name; `peak` is the largest size."""

    names: tuple[str, ...]
    values: tuple[np.ndarray, ...]
    peak: float


class Transfer(NamedTuple):
    """A chart of inverse-transform sampling: the CDF (E,) over edges (E,), levels u (D,) and their draws (D,)."""

    edges: np.ndarray
    cdf: np.ndarray
    u: np.ndarray
    draws: np.ndarray


class Colors(NamedTuple):
    """A chart of named colours (N, 3)."""

    names: tuple[str, ...]
    rgb: np.ndarray


class Pictures(NamedTuple):
    """A chart of small pictures, drawn as a stack from front to back.

    names: one for each picture.
    images: (h, w, 4) uint8 each, sRGB-encoded, with alpha that is not premultiplied.
    marks: (N, 2) a position (x, y) in pixels of each picture, where the ray meets it; NaN: none.
    """

    names: tuple[str, ...]
    images: tuple[np.ndarray, ...]
    marks: np.ndarray


Chart = Stems | Marks | BarCode | Transfer | Colors | Pictures


@dataclass(frozen=True)
class Stage:
    """One stage of a method with the ray's own values. sentence: what happens in it. rows: labelled figures.

    All texts, those of the charts too, are English, and marked or phrases: they are looked up where they are drawn.
    """

    title: str
    sentence: str
    charts: tuple[Chart, ...] = ()
    rows: tuple[tuple[str, str], ...] = ()


def nothing_stage() -> Stage:
    """Return the stage of a ray without samples."""
    return Stage(marked("No samples"), marked("There is nothing along this ray: its colour is the background."))


def field_stage(samples: Samples, sentence: str, title: str = marked("Density and colour")) -> Stage:
    """Return the stage with density and colour along the first ray of `samples`."""
    t, sigma, rgb = (v[0].float().cpu().numpy() for v in (samples.t, samples.sigma, samples.rgb))
    strongest = int(np.argmax(samples.weights[0].cpu().numpy()))
    rows = (
        (marked("largest σ"), number(float(sigma.max()))),
        (marked("colour of the strongest"), triple(rgb[strongest])),
    )
    return Stage(title, sentence, (Stems("σ", t, sigma),), rows)


def absorption_stage(samples: Samples, title: str = marked("α, T and w")) -> Stage:
    """Return the stage with α, T and w along the first ray of `samples`."""
    t, alpha, transmittance, weights = (
        v[0].float().cpu().numpy() for v in (samples.t, samples.alpha, samples.transmittance, samples.weights)
    )
    total = float(weights.sum())
    sentence = marked(
        "Each sample absorbs the share α = 1 − exp(−σδ) of the light that reaches it. The transmittance T, the product "
        "of all (1 − α) in front of it, is the share that reaches it. Its weight in the pixel is w = T α."
    )
    rows = (("Σ w", number(total)), (marked("left for what is behind"), number(1 - total)))
    return Stage(title, sentence, (Stems("α", t, alpha), Stems("T", t, transmittance), Stems("w", t, weights)), rows)


def skipped_stage(samples: Samples, cells: Cells, step: float) -> Stage:
    """Return the stage with the occupied cells, where the first ray takes samples. step: cells between two samples."""
    count = 0 if samples.count is None else int(samples.count[0])
    t = samples.t[0, :count].cpu().numpy()
    share = np.count_nonzero(cells.kinds.cpu().numpy()) / cells.kinds.numel()
    return Stage(
        marked("Skipped space"),
        phrase(
            "{share:.1%} of {cells:,} cells may hold something. The ray skips the others and takes a sample every "
            "{step:g} cells: {count} in all.",
            share=share,
            cells=cells.kinds.numel(),
            step=step,
            count=count,
        ),
        (Marks(t, np.zeros(0, np.float32)),),
        ((marked("grid"), " × ".join(figure(n, ",") for n in cells.size)), (marked("samples"), figure(count, ","))),
    )
