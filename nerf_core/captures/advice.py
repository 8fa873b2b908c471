"""Say in plain words why photos could not be placed, and what to photograph instead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from nerf_core.common.language import marked, phrase, phrases

FEW_FEATURES = 300  # of some thousands that a sharp photo with texture has
OVERLAP = 30  # verified matches: COLMAP registers no photo with fewer
ALIKE = marked(
    "Sides that look alike were taken for one. Therefore only photos that follow one another were matched: their names "
    "must be in the order in which they were taken."
)
SOME = 0.2  # a smaller share of lost photos needs no advice: their own reasons say enough
MOST = 0.5  # more than this share of photos is "most"

TURNED = marked(
    "The camera was turned on the spot: without moving there is no depth. Take a step between photos, around the "
    "object or along it."
)
NO_TEXTURE = marked(
    "Most photos have hardly a point that can be found again: they are blurred, dark, or show plain surfaces. "
    "Photograph in good light, hold still, and let textured things be in the picture: a newspaper under the object "
    "helps."
)
NO_OVERLAP = marked(
    "The photos do not show enough of the same: each should share two thirds of its picture with the one before. Walk "
    "around the object slowly, one photo every 5 to 10 degrees."
)
MANY_SCENES = marked(
    "The photos fall into groups that do not join: photograph the way from one to the other as well, one photo a step."
)
DISAGREE = marked(
    "Photos match, but do not agree on where the cameras were: something that repeats (tiles, windows, leaves) looks "
    "the same in different places, or what was photographed moved. Photograph a still scene, with things in it that "
    "are there only once."
)


def reason(features: int, best: int) -> str:
    """Say why one photo has no pose. features: found in it. best: matches with the photo that fits it best."""
    if features < FEW_FEATURES:
        return phrases(
            "{n} feature: blurred, dark or without texture",
            "{n} features: blurred, dark or without texture",
            features,
        )
    if best < OVERLAP:
        return phrase("{best} matches with its best neighbour: it shows too little of what the others show", best=best)
    return phrase("its {best} matches contradict the others: something repeats or moved", best=best)


def advice(
    features: Sequence[int],
    best: Sequence[int],
    pairs: Sequence[int],
    turned: Sequence[int],
    placed: Sequence[int],
    models: Sequence[int],
) -> str:
    """Return what to photograph instead, as one paragraph; empty if most have a pose.

    Args:
        features, best: (N,) as in `reason`.
        pairs, turned: (N,) the pairs of each photo that match, and how many of them show a camera that only turned.
        placed: the indices of the photos that have a pose.
        models: the photos of each model, the largest first.
    """
    count = len(features)
    lost = [i for i in range(count) if i not in set(placed)]
    if len(lost) <= SOME * count:
        return ""
    if sum(turned) > MOST * max(sum(pairs), 1):
        return TURNED
    if sum(features[i] < FEW_FEATURES for i in lost) > MOST * len(lost):
        return NO_TEXTURE
    if sum(best[i] < OVERLAP for i in lost) > MOST * len(lost):
        return NO_OVERLAP
    return MANY_SCENES if len(models) > 1 else DISAGREE


def too_few(count: int) -> str:
    """Say that there are too few photos to begin; empty if there are enough."""
    if count >= 3:
        return ""
    return phrases("{n} photo: at least 3 are needed, and 30 to 100 are good",
                   "{n} photos: at least 3 are needed, and 30 to 100 are good", count)  # fmt: skip


def summary(result: Mapping[str, list[int]]) -> str:
    """Return `advice` for a result of the program."""
    return advice(*(result[key] for key in ("features", "best", "pairs", "turned", "placed", "models")))
