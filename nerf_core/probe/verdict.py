"""What is wrong with a pixel, in words: its layers, what the photos say of each, and the conclusion.

Questions to the photos decide more than any threshold on shapes. How many of those that see a layer contradict it, as
they would be matched better if it were not there, or as well if there were nothing but background; and how many would
miss it? Where not few contradict it, and no more would miss it, it is a floater. Would the photos be matched better if
no background showed from there on? Then it leaks through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from nerf_core.geometry.rays import Rays
from nerf_core.methods import Method, traced
from nerf_core.probe.evidence import Witnesses
from nerf_core.probe.layers import layers_of, pass_layers
from nerf_core.probe.ray import passes_of
from nerf_core.probe.records import RayProbe
from nerf_core.probe.standing import FEW, THICK, WRONG, Kind, Layer, Standing, Verdict

NOTHING = 0.05  # opacity under which a ray has met nothing that one could see
LEAK = 0.1  # transmittance behind the last layer from which on what is behind shows
SOLID = 0.5  # of the layers' weight must lie in layers that are not hazy, or the ray is in fog
ALIKE, NOISE = 0.01, 0.25  # mean error of a channel, and share of a photo's own: the larger is no difference
COUNTS = 0.1  # weight of a layer that is worth a verdict, in this pixel and in a photo's
ASIDE = np.radians(75)  # between looks at a point: a photo that sees it from farther round does not see this side of it
ASKED = 16  # photos that see a layer, the nearest in angle: they are asked how they would look otherwise
REACHES = np.array([1.0, 3.0, 8.0, 20.0])  # grains behind a layer's end at which it may be over, where it hides that
MOST_LAYERS, MOST_HIDDEN = 4, 8


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
        last = passes_of(scene, rays, traced(method, rays), 0)[-1]
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
