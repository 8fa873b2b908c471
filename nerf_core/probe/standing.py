"""The layers of a ray, what the training photos say of each, and the verdict on the pixel, as plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nerf_core.probe.sightings import Sightings

Tone = Literal["good", "neutral", "warning", "error"]

THICK, DEEP = 6.0, 20.0  # grains: a thicker layer is a surface only where photos agree with it, and none at all
CLOUD = 10.0  # grains: a thicker layer floats only where hardly anybody would miss it
HAZY = 0.03  # mean error of a channel in the photos that see a thick layer, from which on they do not agree with it
FEW = 2  # photos: what fewer see, nobody can have learnt
INSIDE = 0.3  # of the photos that see a layer: what fewer see behind it is its own inside
FRONT = 1 / 3  # of the weight of a front and of what shows through it: a lighter one is no front
WRONG = 0.05  # mean error of a channel in the photos that see a layer, from which on something is wrong
LEAKING = 0.8  # times the error: what no background from a layer on must bring it down to
AGAINST = 1 / 4  # of the photos that see a layer: what so many contradict, and no more would miss, is not there
HARDLY = 1 / 8  # of the photos that see a layer: so few may themselves be wrong, as by their poses


@dataclass(frozen=True)
class Layer:
    """A stretch of a ray where weight gathers. t: where half of its weight lies; all are world distances.

    surface: where a quarter of it lies. Photos carve free what is in front of a surface, while nothing keeps density
    from reaching behind it: the middle of a layer that is not thin lies deeper than what it stands for.

    begin, end: where its weight begins and ends; thickness: between a tenth and nine tenths of it; grain: the length
    that counts as one there. weight: Σ w; light: transmittance in front of it. color: Σ w c / Σ w, (3,).
    """

    t: float
    surface: float
    begin: float
    end: float
    thickness: float
    grain: float
    weight: float
    light: float
    color: np.ndarray


@dataclass(frozen=True)
class Standing:
    """What the training photos say about a layer. Counts are numbers of photos.

    training_views: those that see the layer from the ray's side, under ASIDE from its direction.
    looked: those that see it from anywhere. voters: those of them that are asked, at most ASKED.
    against: voters that contradict the layer. Their pixel is matched better without it, or as well by the bare
        background where that is known.
    missing: other voters whose pixel is matched worse without it.
    blank: the remaining voters that do not show it, since its weight in their pixel is small.
    shown: voters in whose pixel its weight counts.
    error: median over those of the mean difference between their pixel and the model's; None if it is shown in none.
    without: the same without the layer. opaque: the same if no background showed behind the layer's beginning.
    reach: the world distance behind the layer's middle from which on it is taken away: of REACHES the one at which the
        layer floats and most voters contradict it, the shortest of equals.
    """

    layer: Layer
    sightings: Sightings
    training_views: int
    looked: int
    voters: int
    against: int
    missing: int
    blank: int
    shown: int
    error: float | None
    without: float | None
    opaque: float | None
    reach: float

    @property
    def floats(self) -> bool:
        """Not few of the photos that see it contradict it, and no more would miss it than contradict it or do not show
        it. Of a cloud, or what is contradicted only by not being shown, hardly one would: a thing finer than a pixel is
        beside the middle of many."""
        enough, idle = AGAINST * self.voters, self.against + self.blank
        if self.voters < FEW or idle < enough:
            return False
        sure = self.against >= enough and self.layer.thickness <= CLOUD * self.layer.grain
        return self.missing <= (idle if sure else HARDLY * self.voters)

    @property
    def leaks(self) -> bool:
        """The photos would be matched better, if no background showed from it on."""
        if self.error is None or self.opaque is None or self.shown < FEW:
            return False
        return self.error >= WRONG and self.opaque <= LEAKING * self.error

    def inside(self, front: Standing) -> bool:
        """Whether this is what shows through a layer in front that is not quite opaque: the inside of it, as hardly a
        photo of those that see the front sees it from this side. Behind a true veil, a good part of them does."""
        if front.training_views < FEW or self.training_views >= INSIDE * front.training_views:
            return False
        return front.layer.weight >= FRONT * (front.layer.weight + self.layer.weight)

    @property
    def hazy(self) -> bool:
        """Too thick for a surface."""
        return self.layer.thickness > self.most_grains * self.layer.grain

    @property
    def most_grains(self) -> float:
        """Of a surface that the photos agree with this much."""
        return DEEP if self.error is not None and self.error < HAZY else THICK


@dataclass(frozen=True)
class Verdict:
    """What is wrong with a pixel, if anything.

    kind: the name of its class, one of `probe.verdicts`. tone: how good or bad that is. reasons: a line each, with
    numbers. surface_t: the distance at which an eye should rest, behind what floats; None where there is nothing to
    rest on. standings: the layers, front to back.
    """

    kind: str
    reasons: tuple[str, ...]
    surface_t: float | None
    standings: tuple[Standing, ...]
    tone: Tone
