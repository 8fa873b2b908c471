"""Verdicts on faults that are planted into scenes known in closed form."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from balls import Ball, looking, model_of, ring_scene

from nerf_core.common.language import said
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.probe import TrainingViews, Verdict, judge, open_pixel, open_ray
from nerf_core.probe.standing import DEEP, HAZY, THICK, Tone
from nerf_core.probe.verdict import conclude
from nerf_core.probe.verdicts import COUNTS, VERDICTS, Facts
from nerf_core.probe.verdicts.fog import _fog_reasons

RED = Ball((0.0, 0.0, 0.0), 0.7, (0.8, 0.2, 0.15))
FLOATER = Ball((1.5, 0.0, 0.35), 0.25, (0.1, 0.2, 0.9))
CAMERA = looking((4.0, 0.0, 0.9), 41)
MIDDLE = (20, 20)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(RED)


def verdict_of(method: Method, scene: Scene, pixel: tuple[int, int] = MIDDLE) -> Verdict:
    return judge(method, TrainingViews(scene), open_ray(method, scene, CAMERA, pixel, 0))


def facts_of(scene: Scene, *balls: Ball, pixel: tuple[int, int] = MIDDLE) -> Facts:
    """What the classes judge by, for a model of `balls` in a scene."""
    method = model_of(scene, *balls)
    ray = open_ray(method, scene, CAMERA, pixel, 0)
    return Facts(ray, judge(method, TrainingViews(scene), ray).standings)


def front_of(ball: Ball) -> float:
    """The distance at which the middle pixel's ray meets a ball."""
    ray = open_ray(model_of(ring_scene(RED, count=3, size=4), RED), ring_scene(RED, count=3, size=4), CAMERA, MIDDLE, 0)
    o = ray.origin - np.array(ball.center)
    along = o @ ray.direction
    return float(-along - np.sqrt(along**2 - o @ o + ball.radius**2))


def test_a_ball_is_a_surface(scene: Scene) -> None:
    verdict = verdict_of(model_of(scene, RED), scene)
    assert verdict.kind == "surface"
    assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.05)
    (standing,) = verdict.standings
    assert standing.training_views >= 8
    assert standing.error is not None
    assert standing.error < 0.02


def test_the_wrong_colour_of_a_surface_is_reported(scene: Scene) -> None:
    """The class is asked alone, since another class may be named after the wrong colour."""
    facts = facts_of(scene, RED)
    surface = VERDICTS.get("surface")
    assert "colour is wrong" not in surface.reasons(facts)[0]
    off = tuple(replace(s, error=0.14, opaque=0.14) for s in facts.standings)
    reason = surface.reasons(replace(facts, standings=off))[0]
    assert "with an error of 0.140: there is something, but its colour is wrong" in reason


def test_past_the_ball_there_is_background(scene: Scene) -> None:
    verdict = verdict_of(model_of(scene, RED), scene, (1, 1))
    assert (verdict.kind, verdict.surface_t, verdict.standings) == ("background", None, ())


@pytest.mark.parametrize("density", [80.0, 4.0])
def test_a_ball_that_no_photo_shows_is_a_floater(scene: Scene, density: float) -> None:
    """An opaque one hides the red ball; a thin one shares the pixel with it. surface_t lies on the red ball."""
    verdict = verdict_of(model_of(scene, RED, replace(FLOATER, density=density)), scene)
    assert verdict.kind == "floater"
    assert re.search(r"of (\d+) photos that see it \1 contradict it: error", verdict.reasons[0])
    assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.05)


@pytest.mark.parametrize("known", [True, False])
def test_a_white_ball_is_a_floater_before_a_known_white_background(scene: Scene, known: bool) -> None:
    """No photo is matched worse with the white ball, but few photos need it.

    The background of real photographs is unknown, so there the photos do not contradict the ball.
    """
    white = replace(FLOATER, color=(1.0, 1.0, 1.0))
    verdict = verdict_of(model_of(scene, RED, white), replace(scene, synthetic=known))
    (standing,) = verdict.standings
    assert standing.error is not None
    assert standing.error < 0.02
    if known:
        assert standing.against >= standing.voters / 2
        assert verdict.kind == "floater"
        assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.05)
    else:
        assert standing.against < standing.voters / 4  # the photos in which it hides the red ball
        assert verdict.kind == "surface"


GRAIN = Ball((1.5, 0.0, 0.3375), 0.0, FLOATER.color, density=400.0)


def test_a_grain_that_no_photo_contains_is_a_floater() -> None:
    """The grain lies between the pixel centres of most photos, so it counts in few of their pixels."""
    coarse = ring_scene(RED, size=8)
    verdict = verdict_of(model_of(coarse, RED, replace(GRAIN, density=30.0)), coarse)
    front = verdict.standings[0]
    assert front.voters >= 10
    assert front.shown <= 4
    assert front.against + front.blank == front.voters
    assert verdict.kind == "floater"
    assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.05)


def test_a_true_grain_finer_than_a_pixel_is_no_floater() -> None:
    """The photos contain the grain. Those whose pixel centres miss it do not contradict it."""
    coarse = ring_scene(RED, GRAIN, size=8)
    verdict = verdict_of(model_of(coarse, RED, GRAIN), coarse)
    front = verdict.standings[0]
    assert front.blank >= 4
    assert front.missing >= 3
    assert verdict.kind != "floater"


def test_true_haze_is_no_floater() -> None:
    """The haze is so thin that the part around its middle counts in no pixel, but all photos would miss the whole."""
    haze = Ball((0.0, 0.0, 0.0), 0.7, (0.2, 0.2, 0.3), density=0.17)
    scene = ring_scene(haze, size=16, count=12)
    verdict = verdict_of(model_of(scene, haze), scene)
    assert verdict.kind == "fog"
    assert all(s.missing == s.voters for s in verdict.standings)


def test_fog_says_under_which_limits_it_would_be_a_surface(scene: Scene) -> None:
    one = verdict_of(model_of(scene, RED, FLOATER), scene).standings[0]
    grain = one.layer.grain
    thick = replace(one.layer, thickness=10 * grain)
    disputed, agreed = (_fog_reasons([replace(one, layer=thick, error=e)], 0.0)[1] for e in (0.04, 0.01))
    limit = f"under {THICK * grain:.3g}, or under {DEEP * grain:.3g} with an error under {HAZY:g}"
    assert said(disputed).endswith(limit)
    assert said(agreed).endswith(f"under {DEEP * grain:.3g}")


def test_the_photos_votes_decide_whether_a_layer_floats(scene: Scene) -> None:
    one = verdict_of(model_of(scene, RED, FLOATER), scene).standings[0]

    def floats(voters: int, against: int, missing: int, blank: int = 0, grains: float = 3.0) -> bool:
        layer = replace(one.layer, thickness=grains * one.layer.grain)
        return replace(one, layer=layer, voters=voters, against=against, missing=missing, blank=blank).floats

    assert floats(16, 4, 4)
    assert not floats(16, 3, 0)
    assert not floats(16, 4, 5)
    assert floats(16, 4, 6, blank=2)
    assert floats(2, 1, 1)
    assert not floats(1, 1, 0)
    assert floats(16, 14, 2, grains=12.0)
    assert not floats(16, 13, 3, grains=12.0)
    assert floats(16, 4, 0, blank=12, grains=40.0)
    assert not floats(16, 3, 0, blank=13, grains=40.0)  # haze that the photos merely do not show
    assert floats(16, 0, 2, blank=4)
    assert not floats(16, 0, 3, blank=13)


def test_a_radiance_point_lands_behind_the_floater(scene: Scene) -> None:
    opened = open_pixel(model_of(scene, RED, FLOATER), scene, CAMERA, MIDDLE, 0)
    assert opened.radiance is not None
    assert opened.radiance.t == pytest.approx(front_of(RED), abs=0.05)
    assert opened.ray.depth_median is not None
    assert opened.ray.depth_median < front_of(RED) - 0.5
    asked = open_pixel(model_of(scene, RED, FLOATER), scene, CAMERA, MIDDLE, 0, point_t=2.5)
    assert asked.radiance is not None
    assert asked.radiance.t == 2.5


def test_a_ball_that_transmits_the_background_leaks(scene: Scene) -> None:
    verdict = verdict_of(model_of(scene, replace(RED, density=0.6)), scene)
    assert verdict.kind in ("background leak", "fog")  # the layer is as thick as the ball, so both are true
    hollow = replace(RED, density=6.0, skin=0.05)
    assert verdict_of(model_of(scene, hollow), scene).kind == "background leak"


def test_what_leaks_through_the_far_wall_of_something_hollow_is_a_leak(scene: Scene) -> None:
    """Though the near wall, whose colour is right by itself, would not leak."""
    facts = facts_of(scene, replace(RED, density=6.0, skin=0.05))
    near, far = facts.standings
    near = replace(near, error=0.04, opaque=0.035)
    far = replace(far, error=0.1, opaque=0.03, training_views=1)
    assert far.layer.weight >= COUNTS
    assert far.inside(near)
    assert conclude(facts.ray, (near, far)).kind == "background leak"
    assert conclude(facts.ray, (near, replace(far, opaque=0.09))).kind == "surface"


def test_a_true_veil_before_a_ball_is_several_surfaces() -> None:
    veil = replace(FLOATER, density=8.0, skin=0.03)
    scene = ring_scene(RED, veil)
    verdict = verdict_of(model_of(scene, RED, veil), scene)
    assert verdict.kind == "several surfaces"
    assert len(verdict.standings) >= 2


def test_the_inside_that_shines_through_a_surface_is_no_second_surface(scene: Scene) -> None:
    """The front of the hollow ball absorbs four fifths. Photos cannot tell such a ball from an opaque one."""
    verdict = verdict_of(model_of(scene, replace(RED, density=16.0, skin=0.05)), scene)
    assert [s.layer.weight > 0.1 for s in verdict.standings] == [True, True]
    assert verdict.kind == "surface"
    assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.06)
    assert "shines through it" in verdict.reasons[1]


def test_what_no_photo_has_in_view_is_unobserved(scene: Scene) -> None:
    """The training views are those on the far side of the ball."""
    behind = tuple(k for k, view in enumerate(scene.views) if view.camera.c2w[0, 3] < -2)
    blind = replace(scene, splits={"train": behind})
    verdict = verdict_of(model_of(blind, RED), blind)
    assert verdict.kind == "unobserved"
    assert verdict.surface_t == pytest.approx(front_of(RED), abs=0.05)


def test_faint_density_everywhere_is_fog(scene: Scene) -> None:
    assert verdict_of(model_of(scene, Ball((0.0, 0.0, 0.0), 1.4, (0.6, 0.4, 0.4), 0.8)), scene).kind == "fog"


# ---- the rules for every class, whichever file registers it ---------------------------------------------------------


@pytest.fixture(scope="module")
def all_facts(scene: Scene) -> dict[str, Facts]:
    """A ray that meets nothing, one that meets a surface, others that meet faults, and one that no photo sees."""
    behind = tuple(k for k, view in enumerate(scene.views) if view.camera.c2w[0, 3] < -2)
    surface = facts_of(scene, RED)
    return {
        "nothing": facts_of(scene, RED, pixel=(1, 1)),
        "surface": surface,
        "floater": facts_of(scene, RED, FLOATER),
        "fog": facts_of(scene, Ball((0.0, 0.0, 0.0), 1.4, (0.6, 0.4, 0.4), 0.8)),
        "unobserved": facts_of(replace(scene, splits={"train": behind}), RED),
        "no layer": replace(surface, standings=()),
    }


@pytest.mark.parametrize("name", VERDICTS.names())
def test_a_class_of_verdicts_answers_for_every_ray(all_facts: dict[str, Facts], name: str) -> None:
    """`conclude` asks a class about any ray that the classes of lower rank leave."""
    kind = VERDICTS.get(name)
    assert kind.tone in get_args(Tone)
    for facts in all_facts.values():
        reasons = kind.reasons(facts)
        assert isinstance(reasons, tuple)
        assert all(isinstance(line, str) and line.strip() and "\n" not in line for line in reasons)


def test_ranks_of_verdicts_differ_and_every_class_can_be_reached(all_facts: dict[str, Facts]) -> None:
    """Of two classes of one rank, the names would decide. After a class that always holds, no class is asked."""
    kinds = sorted((VERDICTS.get(name) for name in VERDICTS.names()), key=lambda kind: kind.rank)
    assert len({kind.rank for kind in kinds}) == len(kinds)
    held = [[bool(kind.reasons(facts)) for facts in all_facts.values()] for kind in kinds]
    assert not any(all(answers) for answers in held[:-1])
    assert all(any(answers) for answers in zip(*held, strict=True))  # some class holds for every ray
