"""What a method has to tell of one ray, from where it looks to the light that arrives: a walk of several stages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from nerf_core.geometry.rays import Samples
    from nerf_core.volume.cells import Cells


class Stems(NamedTuple):
    """A value y (S,) at each sample t (S,); name says what it is, on the axis."""

    name: str
    t: np.ndarray
    y: np.ndarray


class Marks(NamedTuple):
    """Places t (S,) on the ray, within bins whose edges are `edges` (empty: none are shown)."""

    t: np.ndarray
    edges: np.ndarray


class BarCode(NamedTuple):
    """Numbers as coloured bars, a row of them for each name: values, (N,) each; signed, `peak` the largest."""

    names: tuple[str, ...]
    values: tuple[np.ndarray, ...]
    peak: float


class Transfer(NamedTuple):
    """Inverse-transform sampling: the CDF (E,) over edges (E,); levels u (D,), and where they fall, draws (D,)."""

    edges: np.ndarray
    cdf: np.ndarray
    u: np.ndarray
    draws: np.ndarray


class Colors(NamedTuple):
    """Colours (N, 3), named."""

    names: tuple[str, ...]
    rgb: np.ndarray


Chart = Stems | Marks | BarCode | Transfer | Colors


@dataclass(frozen=True)
class Stage:
    """A step of the method with this ray's values. sentence: what happens there. rows: labelled figures."""

    title: str
    sentence: str
    charts: tuple[Chart, ...] = ()
    rows: tuple[tuple[str, str], ...] = ()


def number(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}g}"


def triple(values: np.ndarray) -> str:
    return "  ".join(f"{float(v):.3f}" for v in values)


def nothing_stage() -> Stage:
    """Of a ray without samples."""
    return Stage("No samples", "Nothing along this ray is worth a look: what comes back is the background alone.")


def field_stage(samples: Samples, sentence: str, title: str = "Density and colour") -> Stage:
    """Density and colour along the first ray of `samples`."""
    t, sigma, rgb = (v[0].float().cpu().numpy() for v in (samples.t, samples.sigma, samples.rgb))
    strongest = int(np.argmax(samples.weights[0].cpu().numpy()))
    rows = (("largest σ", number(float(sigma.max()))), ("colour of the strongest", triple(rgb[strongest])))
    return Stage(title, sentence, (Stems("σ", t, sigma),), rows)


def absorption_stage(samples: Samples, title: str = "α, T and w") -> Stage:
    """What the first ray of `samples` composites."""
    t, alpha, transmittance, weights = (
        v[0].float().cpu().numpy() for v in (samples.t, samples.alpha, samples.transmittance, samples.weights)
    )
    total = float(weights.sum())
    sentence = (
        "Each sample absorbs α = 1 − exp(−σδ) of the light that reaches it; T is what is left of the light before it, "
        "the product of all (1 − α) in front; its weight in the pixel is w = T α."
    )
    rows = (("Σ w", number(total)), ("left for what is behind", number(1 - total)))
    return Stage(title, sentence, (Stems("α", t, alpha), Stems("T", t, transmittance), Stems("w", t, weights)), rows)


def skipped_stage(samples: Samples, cells: Cells, step: float) -> Stage:
    """Where the first ray looks at all: in cells that may hold something. step: cells between two samples."""
    count = 0 if samples.count is None else int(samples.count[0])
    t = samples.t[0, :count].cpu().numpy()
    share = np.count_nonzero(cells.occupied.cpu().numpy()) / cells.occupied.numel()
    return Stage(
        "Skipped space",
        f"Of {cells.occupied.numel():,} cells {share:.1%} may hold something. The ray leaps over the others and takes "
        f"a sample every {step:g} cells where it is worth it: {count} in all.",
        (Marks(t, np.zeros(0, np.float32)),),
        (("grid", " × ".join(f"{n:,}" for n in cells.size)), ("samples", f"{count:,}")),
    )
