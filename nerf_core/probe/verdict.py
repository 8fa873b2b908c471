"""What is wrong with a pixel, in words: its layers, what the photos say of each, and the conclusion.

Questions to the photos decide more than any threshold on shapes. How many of those that see a layer contradict it, as
they would be matched better if it were not there, or as well if there were nothing but background; and how many would
miss it? Where not few contradict it, and no more would miss it, it is a floater. Would the photos be matched better if
no background showed from there on? Then it leaks through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from nerf_core.geometry.rays import Rays
from nerf_core.methods import Method
from nerf_core.probe.evidence import Sightings, Witnesses
from nerf_core.probe.layers import Layer, layers_of, pass_layers
from nerf_core.probe.ray import RayProbe, passes_of

Kind = Literal["surface", "several surfaces", "floater", "fog", "background leak", "unobserved", "background"]

NOTHING = 0.05  # opacity under which a ray has met nothing that one could see
LEAK = 0.1  # transmittance behind the last layer from which on what is behind shows
THICK, DEEP = 6.0, 20.0  # grains: a thicker layer is a surface only where photos agree with it, and none at all
CLOUD = 10.0  # grains: a thicker layer floats only where hardly anybody would miss it
HAZY = 0.03  # mean error of a channel in the photos that see a thick layer, from which on they do not agree with it
SOLID = 0.5  # of the layers' weight must lie in layers that are not hazy, or the ray is in fog
FEW = 2  # photos: what fewer see, nobody can have learnt
ASIDE = np.radians(75)  # between looks at a point: a photo that sees it from farther round does not see this side of it
INSIDE = 0.3  # of the photos that see a layer: what fewer see behind it is its own inside
FRONT = 1 / 3  # of the weight of a front and of what shows through it: a lighter one is no front
WRONG = 0.05  # mean error of a channel in the photos that see a layer, from which on something is wrong
LEAKING = 0.8  # times the error: what no background from a layer on must bring it down to
ALIKE, NOISE = 0.01, 0.25  # mean error of a channel, and share of a photo's own: the larger is no difference
AGAINST = 1 / 4  # of the photos that see a layer: what so many contradict, and no more would miss, is not there
COUNTS = 0.1  # weight of a layer that is worth a verdict, in this pixel and in a photo's
HARDLY = 1 / 8  # of the photos that see a layer: so few may themselves be wrong, as by their poses
ASKED = 16  # photos that see a layer, the nearest in angle: they are asked how they would look otherwise
REACHES = np.array([1.0, 3.0, 8.0, 20.0])  # grains behind a layer's end at which it may be over, where it hides that
MOST_LAYERS, MOST_HIDDEN = 4, 8


@dataclass(frozen=True)
class Standing:
    """A layer before the photos. witnesses: how many see it from the ray's side, under ASIDE from its look; looked: how
    many do from anywhere; voters: those of them that are asked, ASKED at most. against: how many voters contradict it,
    as they would be matched better if it were not there, or as well by the bare background, where one is known;
    missing: how many of the others would be matched worse; blank: how many of the rest do not show it, since it does
    not count in their pixel. shown: in how many of the voters' pixels it counts.

    error: median over those of the mean difference between their pixel and the model's; without, opaque: the same if
    the layer were away, or if from it on no background showed; None where it is shown in none. reach: the world
    distance behind its middle from which on it is away: that of REACHES at which it floats and most are against it, of
    those alike the shortest.
    """

    layer: Layer
    sightings: Sightings
    witnesses: int
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
        if front.witnesses < FEW or self.witnesses >= INSIDE * front.witnesses:
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
    """kind: one word for the pixel; reasons: a line each, with numbers. surface_t: the distance at which an eye should
    rest, behind what floats; None where there is nothing to rest on. standings: the layers, front to back."""

    kind: Kind
    reasons: tuple[str, ...]
    surface_t: float | None
    standings: tuple[Standing, ...]


def judge(method: Method, witnesses: Witnesses, ray: RayProbe) -> Verdict:
    """Open the ray's layers, ask the photos, and conclude."""
    *_, verdict = judging(method, witnesses, ray)
    assert verdict is not None
    return verdict


def judging(method: Method, witnesses: Witnesses, ray: RayProbe) -> Iterator[Verdict | None]:
    """`judge` in pieces, a layer at a time; the last is the verdict."""
    found = layers_of(ray, witnesses.scene)
    standings = []
    for layer in sorted(sorted(found, key=lambda one: -one.weight)[:MOST_LAYERS], key=lambda one: one.t):
        standings.append(stand(method, witnesses, ray, layer))
        yield None
    verdict = conclude(ray, tuple(standings))
    if verdict.kind == "floater":
        last = max(s.layer.t for s in standings if s.floats and s.layer.weight >= COUNTS)
        # what photos know nothing of may well be the floater's inside
        behind = [s.layer for s in _outer(standings) if s.layer.t > last and s.witnesses >= FEW]
        rest = max(behind, key=lambda layer: layer.weight, default=None)
        t = rest.surface if rest is not None else _hidden_surface(method, witnesses, ray, verdict.standings)
        verdict = replace(verdict, surface_t=t)
    yield verdict


def stand(method: Method, witnesses: Witnesses, ray: RayProbe, layer: Layer) -> Standing:
    """What the photos say of a layer."""
    point = ray.origin.astype(np.float64) + layer.t * ray.direction.astype(np.float64)
    margin = layer.grain + min(layer.t - layer.begin, THICK * layer.grain)
    sightings = witnesses.look(method, point, ray.direction.astype(np.float64), margin)
    counts = int((sightings.seen & (sightings.angle < ASIDE)).sum()), int(sightings.seen.sum())
    asked = sightings.at(np.flatnonzero(sightings.seen)[:ASKED])
    if not len(asked.views):
        return Standing(layer, sightings, *counts, 0, 0, 0, 0, 0, None, None, None, layer.end - layer.t)
    reaches = margin + REACHES * layer.grain
    without, opaque, bare = witnesses.otherwise(method, asked, reaches)
    error, shown = _off(asked.predicted, asked.observed), asked.share >= COUNTS
    slack = _slack(error)
    needless = _off(bare, asked.observed) <= error + slack if witnesses.scene.synthetic else np.zeros(len(error), bool)

    def median(off: np.ndarray) -> float | None:
        return float(np.median(off[shown])) if shown.any() else None

    middle, opaquely, found = median(error), median(_off(opaque, asked.observed)), []
    for reach, instead in zip(reaches.tolist(), _off(without, asked.observed), strict=True):
        against = shown & ((instead < error - slack) | needless)
        missing = (instead > error + slack) & ~against
        blank = ~shown & ~missing
        found.append(Standing(
            layer, sightings, *counts, len(error), int(against.sum()), int(missing.sum()), int(blank.sum()),
            int(shown.sum()), middle, median(instead), opaquely, reach,
        ))  # fmt: skip
    return max(found, key=lambda one: (one.floats, one.against, -one.missing))  # of those alike the first


def _hidden_surface(
    method: Method, witnesses: Witnesses, ray: RayProbe, standings: tuple[Standing, ...]
) -> float | None:
    """Where the first layer lies that photos know and that does not float, behind what lets no light through."""
    scene = witnesses.scene
    begin = max(s.layer.t + s.reach for s in standings if s.floats and s.layer.weight >= COUNTS)
    for _ in range(MOST_HIDDEN):
        o, d, near, far = (torch.as_tensor(v, dtype=torch.float32)[None] for v in (
            ray.origin, ray.direction, ray.near, ray.far))  # fmt: skip
        rays = witnesses.beginning(Rays(o, d, near, far), torch.tensor([begin]))
        shift = float((rays.origins[0] - o[0]).norm())
        last = passes_of(scene, rays, method.trace(rays), 0)[-1]
        found = pass_layers(replace(last, t=last.t + shift, until=last.until + shift), ray.far, scene.radius)
        heavy = [layer for layer in found if layer.weight >= COUNTS]
        if not heavy:
            return None
        behind = stand(method, witnesses, ray, heavy[0])
        if not behind.floats and behind.witnesses >= FEW:
            return heavy[0].surface
        begin = heavy[0].end  # its reach would not do: for photos that see it from behind, that is the whole floater
    return None


def conclude(ray: RayProbe, standings: tuple[Standing, ...]) -> Verdict:
    """The verdict on what is known; no more is asked."""
    heavy = [s for s in standings if s.layer.weight >= COUNTS]
    surface = max(_outer(standings), key=lambda s: s.layer.weight, default=None)
    kind, reasons = _concluded(ray, standings, heavy, surface)
    rest = surface is not None and kind != "background"
    return Verdict(kind, reasons, surface.layer.surface if rest and surface is not None else None, standings)


def _outer(standings: Iterable[Standing]) -> list[Standing]:
    """Those of weight that neither float nor are another's inside, front to back."""
    found: list[Standing] = []
    for s in standings:
        if s.layer.weight >= COUNTS and not s.floats and not any(s.inside(front) for front in found):
            found.append(s)
    return found


def _concluded(
    ray: RayProbe, standings: tuple[Standing, ...], heavy: list[Standing], surface: Standing | None
) -> tuple[Kind, tuple[str, ...]]:
    """What is worst comes first."""
    floaters = [s for s in heavy if s.floats]
    whole = sum(s.layer.weight for s in standings)
    thin = sum(s.layer.weight for s in standings if not s.hazy)
    real = _outer(standings)
    leaking, left = next((s for s in reversed(real) if s.leaks), None), 1 - ray.opacity  # a veil in front leaks as well
    kind: Kind = "surface"
    if ray.opacity < NOTHING:
        kind, reasons = "background", (f"the ray met nothing: its opacity is {ray.opacity:.3f}",)
    elif floaters:
        kind, reasons = "floater", tuple(map(_floater_reason, floaters))
    elif surface is not None and min(surface.witnesses, max(surface.shown, surface.missing)) < FEW:
        kind, reasons = "unobserved", (_unobserved_reason(surface),)
    elif left >= LEAK and leaking is not None:
        kind, reasons = "background leak", (_leak_reason(leaking, left),)
    elif surface is None or thin < SOLID * whole:
        kind, reasons = "fog", _fog_reasons(heavy, thin / max(whole, 1e-12))
    elif len(real) > 1:
        parts = ", ".join(f"{s.layer.weight:.0%} at {s.layer.t:.3g}" for s in real)
        kind, reasons = "several surfaces", (f"{len(real)} layers make the pixel: {parts}",)
    else:
        inner = [s for s in heavy if not s.floats and s is not surface]
        reasons = (_surface_reason(surface), *map(_inner_reason, inner))
    return kind, reasons


def _off(colors: np.ndarray, photos: np.ndarray) -> np.ndarray:
    """The mean difference of a channel in each photo, (V,)."""
    return np.abs(colors - photos).mean(-1)


def _slack(error: Any) -> Any:
    """What differs from an error (or each of an array) by less is as good."""
    return np.maximum(ALIKE, NOISE * error)


def _floater_reason(s: Standing) -> str:
    said = ((s.against, "contradict it"), (s.blank, "do not show it"), (s.missing, "would miss it"))
    *rest, last = [f"{count} {what}" for count, what in said if count]
    votes = f"{', '.join(rest)} and {last}" if rest else last
    better = s.error is not None and s.without is not None and s.without < s.error - _slack(s.error)
    error = f": error {s.error:.3f}, without it {s.without:.3f}" if better else ""
    layer = f"a layer at {s.layer.t:.3g} makes {s.layer.weight:.0%} of the pixel"
    return f"{layer}, but of {s.voters} photos that see it {votes}{error}"


def _fog_reasons(heavy: list[Standing], share: float) -> tuple[str, ...]:
    if not heavy:
        return (f"nothing on the ray makes a pixel: no layer weighs {COUNTS:g}",)
    thickest = max(heavy, key=lambda s: s.layer.thickness)
    error = "" if thickest.error is None else f", with an error of {thickest.error:.3f}"
    return (
        f"only {share:.0%} of what is seen lies in thin layers, or in ones that the photos agree with",
        f"its thickest layer, at {thickest.layer.t:.3g}, is {thickest.layer.thickness:.3g} deep{error}: "
        f"a surface would be under {thickest.most_grains * thickest.layer.grain:.3g}",
    )


def _unobserved_reason(s: Standing) -> str:
    if s.witnesses >= FEW:
        shown = "one shows it" if s.shown else "none shows it"
        return f"of {s.voters} training photos that see the point at {s.layer.t:.3g}, {shown}"
    seen = {0: "no training photo sees", 1: "one training photo alone sees"}[s.witnesses]
    return (
        f"{seen} the point at {s.layer.t:.3g} from this side ({s.sightings.framed} of {s.sightings.asked} have it in "
        f"their frame, {s.looked} see it from anywhere)"
    )


def _leak_reason(s: Standing, left: float) -> str:
    return (
        f"{left:.0%} of what is behind shows through the layer at {s.layer.t:.3g}; if no background did, the median "
        f"error of {s.shown} photos that show it would be {s.opaque:.3f} instead of {s.error:.3f}"
    )


def _inner_reason(s: Standing) -> str:
    seen = {0: "no photo sees", 1: "one photo sees"}.get(s.witnesses, f"{s.witnesses} photos see")
    return f"another {s.layer.weight:.0%} shines through it, from {s.layer.t:.3g}, where {seen} from this side"


def _surface_reason(s: Standing) -> str:
    error = "" if s.error is None else f", with an error of {s.error:.3f}"
    if s.error is not None and s.error >= WRONG:
        error += ": there is something, but its colour is wrong"
    return (
        f"one layer at {s.layer.t:.3g}, {s.layer.thickness:.2g} thick, makes {s.layer.weight:.0%} of the pixel; "
        f"{s.witnesses} training photos see it from this side{error}"
    )
