"""The bench of "Ray by hand": its samples, the one that is chosen, what can be undone, and rays to begin with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from nerf_core.common.language import marked
from nerf_core.common.text import number
from nerf_core.probe import HandRay, HandTerms, RayProbe, hand_ray_of, hand_terms
from nerf_core.probe.axis import weighty_part

MOST = 10  # samples
UNDOS = 100
NEAR, FAR = 2.0, 6.0  # of the presets, in world units
BEHIND = 0.12  # of the ray's length: the axis goes on so far behind its end, so that the end can be dragged
APART = 1e-3  # of the ray's length: the last sample keeps this distance from the end
WHITE = np.ones(3)
BEGIN = marked("Drag a sample: to the sides for t, up and down for σ. A double click in the plot adds one.")
TAKEN = marked(
    "{samples} samples merged into {few}: the pixel differs by {error}. "
    "Left out: a weight of {share} %, outside t = {low} … {high}."
)


class Preset(NamedTuple):
    """A ray to begin with. mark: of its button. says: what it shows, in a line. make: its samples."""

    mark: str
    label: str
    says: str
    make: Callable[[], HandRay]


def _ray(*samples: tuple[float, float, tuple[float, float, float]]) -> HandRay:
    """A ray of samples (t, σ, colour) over white."""
    t, sigma, rgb = zip(*samples, strict=True)
    return HandRay(np.array(t), np.array(sigma), np.array(rgb), NEAR, FAR, WHITE)


def _fog() -> HandRay:
    violet, sand = np.array([0.42, 0.45, 0.62]), np.array([0.86, 0.80, 0.66])
    shares = np.linspace(0, 1, 8)
    colors = [tuple((violet + share * (sand - violet)).round(3).tolist()) for share in shares]
    return _ray(*((round(2.3 + 0.45 * k, 2), 0.3, color) for k, color in enumerate(colors)))


def _wall() -> HandRay:
    return _ray(
        (2.3, 0.02, (0.62, 0.70, 0.80)), (3.9, 9.0, (0.86, 0.42, 0.20)), (4.5, 9.0, (0.22, 0.56, 0.36)),
        (5.2, 0.0, (0.62, 0.70, 0.80)),
    )  # fmt: skip


def _glass() -> HandRay:
    return _ray(
        (2.8, 1.5, (0.36, 0.68, 0.62)), (3.1, 0.0, (0.62, 0.70, 0.80)), (4.5, 8.0, (0.86, 0.42, 0.20)),
        (4.9, 8.0, (0.60, 0.24, 0.14)), (5.4, 0.0, (0.62, 0.70, 0.80)),
    )  # fmt: skip


PRESETS = (
    Preset("fog", marked("Fog"), marked("Thin density everywhere: every sample has a small part in the pixel."), _fog),
    Preset(
        "wall",
        marked("Wall"),
        marked("The first dense sample takes all the light: what lies behind it weighs nothing."),
        _wall,
    ),
    Preset(
        "glass",
        marked("Glass, wall"),
        marked("Glass before a wall: the glass takes a third of the light, the wall gets what is left."),
        _glass,
    ),
)


class Note(NamedTuple):
    """What is to be known of the samples: a text to be translated, and the numbers to fill into it."""

    text: str = ""
    values: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class _Moment:
    ray: HandRay
    chosen: int
    note: Note


class HandBench:
    """The samples, always in order of t. Every change can be undone; the steps of one gesture are one change.

    chosen: the index of the chosen sample; −1 if there are no samples.
    changes: how many changes were begun, undone ones included.
    note: what is to be known of the samples. An empty text: nothing.
    """

    def __init__(self) -> None:
        self._now = _Moment(PRESETS[-1].make(), 0, Note(BEGIN))
        self._past: list[_Moment] = []
        self._gesture = ""
        self.changes = 0
        self._terms_of, self._terms = self.ray, hand_terms(self.ray)

    @property
    def ray(self) -> HandRay:
        return self._now.ray

    @property
    def terms(self) -> HandTerms:
        """The terms of the ray's colour. They are computed once for each ray: several plots and tables show them."""
        if self._terms_of is not self.ray:
            self._terms_of, self._terms = self.ray, hand_terms(self.ray)
        return self._terms

    @property
    def chosen(self) -> int:
        return self._now.chosen

    @property
    def note(self) -> Note:
        return self._now.note

    @property
    def can_undo(self) -> bool:
        return bool(self._past)

    def choose(self, index: int) -> None:
        """Choose a sample. This is no change."""
        self._now = replace(self._now, chosen=index)

    def undo(self) -> None:
        if self._past:
            self._now, self._gesture = self._past.pop(), ""
            self.changes += 1

    def end_gesture(self) -> None:
        """Make what follows a change of its own."""
        self._gesture = ""

    def load(self, preset: Preset) -> None:
        ray = preset.make()
        self._change(ray, int(np.argmax(hand_terms(ray).weights)), note=Note())

    def take(self, ray: RayProbe, radius: float) -> None:
        """Take the samples of an opened ray, merged into as many as the bench holds. radius: the scene's.

        The ray needs a pass with samples.
        """
        last = replace(ray.last, weights=np.nan_to_num(ray.last.weights))
        low, high = weighty_part(ray, (last,), radius)
        taken = hand_ray_of(last, low, high, ray.background.astype(np.float64), MOST)
        if not len(taken.t):
            return
        terms = hand_terms(taken)
        outside = float(last.weights[(last.t < low) | (last.t >= high)].sum())
        values = {
            "samples": f"{len(last.t):,}",
            "few": str(len(taken.t)),
            "error": f"{np.abs(terms.pixel - ray.color).max():.3f}",
            "low": number(low, 3),
            "high": number(high, 3),
            "share": f"{100 * outside:.2f}",
        }
        self._change(taken, int(np.argmax(terms.weights)), note=Note(TAKEN, values))

    def move(self, index: int, t: float, sigma: float, gesture: str = "") -> None:
        """Move a sample. It may pass others: it then takes its place among them, and stays chosen."""
        ray = self.ray
        places, sigmas = ray.t.copy(), ray.sigma.copy()
        places[index] = np.clip(t, ray.near, ray.far - APART * (ray.far - ray.near))
        sigmas[index] = max(sigma, 0.0)
        order = np.argsort(places, kind="stable")
        moved = replace(ray, t=places[order], sigma=sigmas[order], rgb=ray.rgb[order])
        self._change(moved, int(np.flatnonzero(order == index)[0]), gesture)

    def paint(self, index: int, rgb: np.ndarray, gesture: str = "") -> None:
        """Give a sample another colour; −1: the background."""
        ray = self.ray
        if index < 0:
            self._change(replace(ray, background=rgb), self.chosen, gesture)
        else:
            colors = ray.rgb.copy()
            colors[index] = rgb
            self._change(replace(ray, rgb=colors), index, gesture)

    def stretch(self, far: float, gesture: str = "") -> None:
        """Move the end of the ray: the last sample's stretch ends there."""
        ray, least = self.ray, APART * (self.ray.far - self.ray.near)
        last = float(ray.t[-1]) if len(ray.t) else ray.near
        self._change(replace(ray, far=max(far, last + least)), self.chosen, gesture)

    def add(self, t: float, sigma: float) -> None:
        """Add a sample, if there is room. It takes the colour of the stretch in which it lies."""
        ray = self.ray
        if len(ray.t) >= MOST:
            return
        t = float(np.clip(t, ray.near, ray.far - APART * (ray.far - ray.near)))
        at = int(np.searchsorted(ray.t, t, side="right"))
        color = ray.rgb[max(at - 1, 0)] if len(ray.t) else np.array([0.5, 0.5, 0.5])
        added = replace(
            ray,
            t=np.insert(ray.t, at, t),
            sigma=np.insert(ray.sigma, at, max(sigma, 0.0)),
            rgb=np.insert(ray.rgb, at, color, axis=0),
        )
        self._change(added, at)

    def add_in_widest(self) -> None:
        """Add a sample in the middle of the longest stretch, as dense as that."""
        edges = np.concatenate([[self.ray.near], self.ray.edges])
        k = int(np.argmax(np.diff(edges)))
        self.add(float(edges[k : k + 2].mean()), float(self.ray.sigma[k - 1]) if k else 1.0)

    def delete(self, index: int) -> None:
        ray = self.ray
        if 0 <= index < len(ray.t):
            t, sigma = np.delete(ray.t, index), np.delete(ray.sigma, index)
            left = replace(ray, t=t, sigma=sigma, rgb=np.delete(ray.rgb, index, axis=0))
            self._change(left, min(index, len(t) - 1))

    def _change(self, ray: HandRay, chosen: int, gesture: str = "", note: Note | None = None) -> None:
        if not gesture or gesture != self._gesture:
            self._past = [*self._past[-UNDOS + 1 :], self._now]
            self.changes += 1
        self._gesture = gesture
        self._now = _Moment(ray, chosen, note or Note())  # what was known of the samples holds no longer
