"""The layers of a ray, what the training photos say about each, and the verdict on the pixel, as plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nerf_core.probe.sightings import Sightings

Tone = Literal["good", "neutral", "warning", "error"]

# Thickness is counted in grains, see `nerf_core.probe.layers.grain_at`. An error is a mean over the channels. Shares of
# photos are of those that are asked. docs/microscope.md states the rules in which these numbers are used.
THICK, DEEP = 6.0, 20.0  # grains: the thickest surface, and the thickest one with which the photos agree
CLOUD = 10.0  # grains: a thicker layer floats only if photos contradict it, and at most HARDLY would miss it
HAZY = 0.03  # the photos agree with a thick layer if the error is under this
FEW = 2  # photos: training cannot have learnt what fewer photos see
INSIDE = 0.3  # a layer is the inside of one in front if fewer than this times as many photos see it from this side
FRONT = 1 / 3  # the layer in front has at least this share of the weight of both
WRONG = 0.05  # from this error on, something is wrong with the layer
LEAKING = 0.8  # background leaks if the error without background falls to this times the error or less
AGAINST = 1 / 4  # share of the photos that must speak against a layer for it to float
HARDLY = 1 / 8  # share of the photos that may be wrong themselves, because of their poses for example


@dataclass(frozen=True)
class Layer:
    """A peak of weight on a ray. Distances are along the ray, in world units.

    t: the distance in front of which half of the layer's weight lies.
    surface: the distance in front of which a quarter of it lies. This is where the surface is: photos carve free what
        is in front of a surface, but nothing keeps density from reaching behind it. So the middle of a thick layer lies
        too deep.
    begin, end: where the weight begins and ends, but for a thousandth on either side.
    thickness: the length that holds the weight between a tenth and nine tenths.
    grain: the length of a grain at t.
    weight: Σ w.
    light: the transmittance in front of the layer.
    color: (3,) Σ w c / Σ w.
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

    @property
    def margin(self) -> float:
        """Half the length of the stretch that counts as the layer's point t: a surface must not hide itself."""
        return self.grain + min(self.t - self.begin, THICK * self.grain)


@dataclass(frozen=True)
class Standing:
    """What the training photos say about a layer. Counts are numbers of photos; ASIDE and ASKED are in `probe.verdict`.

    layer: the layer.
    sightings: what the photos show of the layer's point t.
    training_views: photos that see the layer from the ray's side, at an angle under ASIDE to its direction.
    looked: photos that see it from any side.
    voters: the photos that are asked: those of `looked` that are nearest in angle, at most ASKED.
    against: voters that contradict the layer. They show it, and the model would match their pixel better without it.
        For an object on a plain background, it also counts if background alone would match as well as the layer.
    missing: other voters, whose pixel would be matched worse without the layer.
    blank: the remaining voters that do not show the layer, because its weight in their pixel is under COUNTS.
    shown: voters that show the layer.
    error: the difference between photo and model, a mean over channels and a median over `shown`. None if no voter
        shows the layer.
    without: the error if the layer were taken away.
    opaque: the error if no background showed from the layer's beginning on.
    reach: how far behind t the stretch ends that is taken away, in world units. Of the reaches that are tried, it is
        the one that speaks most against the layer; the shortest if several do.
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
        """Whether the photos speak against the layer.

        There are at least FEW voters, AGAINST of them or more contradict the layer or do not show it, and no more would
        miss it than these. If fewer than AGAINST contradict it, at most HARDLY of the voters may miss it: a thing that
        exists but is finer than a pixel is not shown by many photos. A cloud must be contradicted by AGAINST, and at
        most HARDLY may miss it. Haze is thin in every photo, so that none shows it: that alone is no contradiction.
        """
        enough, idle = AGAINST * self.voters, self.against + self.blank
        contradicted, cloud = self.against >= enough, self.layer.thickness > CLOUD * self.layer.grain
        if self.voters < FEW or idle < enough or (cloud and not contradicted):
            return False
        return self.missing <= (idle if contradicted and not cloud else HARDLY * self.voters)

    @property
    def leaks(self) -> bool:
        """Whether the photos would be matched better if no background showed from the layer on."""
        if self.error is None or self.opaque is None or self.shown < FEW:
            return False
        return self.error >= WRONG and self.opaque <= LEAKING * self.error

    def inside(self, front: Standing) -> bool:
        """Return whether this layer is the inside of a layer in front of it.

        The inside shows through a front that is not quite opaque. Hardly any photo of those that see the front sees it
        from this side, whereas many photos see what is behind a true veil.
        """
        if front.training_views < FEW or self.training_views >= INSIDE * front.training_views:
            return False
        return front.layer.weight >= FRONT * (front.layer.weight + self.layer.weight)

    @property
    def hazy(self) -> bool:
        """Whether the layer is too thick for a surface."""
        return self.layer.thickness > self.most_grains * self.layer.grain

    @property
    def most_grains(self) -> float:
        """The greatest thickness of a surface, in grains: DEEP if the photos agree with the layer, else THICK."""
        return DEEP if self.error is not None and self.error < HAZY else THICK


@dataclass(frozen=True)
class Verdict:
    """What kind of pixel it is: a surface, or what is wrong with it.

    kind: the name of its class in `nerf_core.probe.verdicts.VERDICTS`.
    reasons: lines of text with the numbers that decided.
    surface_t: the distance of the surface behind everything that floats, in world units; None if there is none.
    standings: the heaviest layers from front to back, with what the photos say about each.
    tone: how good or bad the kind is.
    """

    kind: str
    reasons: tuple[str, ...]
    surface_t: float | None
    standings: tuple[Standing, ...]
    tone: Tone
