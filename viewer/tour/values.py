"""Live values in the equations of a tour, from the worker's newest snapshot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerf_core.common.language import figure, localized, tr
from nerf_core.common.text import NOTHING, number, size, triple
from nerf_core.probe import PassProbe, RayProbe

from ..model.state import AppState

GRID_SIDE = 256  # of the naive grid whose memory {N3} is
GRID_BYTES = 16  # of a cell: four float32
ENDLESS = 1e9  # a longer stretch has no end


def _ray(state: AppState) -> RayProbe | None:
    ray = state.snapshot.ray
    return ray if ray is not None and len(ray.last.t) else None


def chosen_sample(state: AppState) -> tuple[PassProbe, int] | None:
    """Return the pass and the index of the sample under the mouse, else of the heaviest one of the opened ray."""
    ray = _ray(state)
    if ray is None:
        return None
    pointed = state.sample
    if pointed is not None and pointed.one < len(ray.passes) and pointed.at < len(ray.passes[pointed.one].t):
        return ray.passes[pointed.one], pointed.at
    return ray.last, int(np.argmax(ray.last.weights))


def _of_sample(read: Callable[[PassProbe, int], float], spec: str) -> Callable[[AppState], str]:
    def value(state: AppState) -> str:
        chosen = chosen_sample(state)
        return figure(float(read(*chosen)), spec) if chosen is not None else NOTHING

    return value


def _delta(state: AppState) -> str:
    """The sample's length. That of a NeRF's last sample is 1e10, which stands for no end."""
    chosen = chosen_sample(state)
    if chosen is None:
        return NOTHING
    value = float(chosen[0].delta[chosen[1]])
    return "∞" if value >= ENDLESS else figure(value, ".3f")


def _of_ray(read: Callable[[RayProbe], str]) -> Callable[[AppState], str]:
    def value(state: AppState) -> str:
        ray = _ray(state)
        return read(ray) if ray is not None else NOTHING

    return value


def _of_scene(read: Callable[[AppState], str]) -> Callable[[AppState], str]:
    return lambda state: read(state) if state.snapshot.scene is not None and state.snapshot.scene.views else NOTHING


def _photo_size(state: AppState) -> tuple[int, int]:
    assert state.snapshot.scene is not None
    camera = state.snapshot.scene.views[0].camera
    return camera.width, camera.height


def _photos(state: AppState) -> int:
    assert state.snapshot.scene is not None
    return len(state.snapshot.scene.split("train"))


def _rays(state: AppState) -> str:
    width, height = _photo_size(state)
    return figure(_photos(state) * width * height, ",d")


def _newest(read: Callable[[AppState], np.ndarray], spec: str) -> Callable[[AppState], str]:
    def value(state: AppState) -> str:
        values = read(state)
        return figure(float(values[-20:].mean()), spec) if len(values) else NOTHING

    return value


def _samples_of(pass_: int) -> Callable[[RayProbe], str]:
    return lambda ray: figure(len(ray.passes[pass_].t), ",d")


# By name; docs/tours.md lists them.
VALUES: dict[str, Callable[[AppState], str]] = {
    "step": lambda state: figure(state.snapshot.step, ",d"),
    "psnr": _newest(lambda state: state.snapshot.history.psnr, ".1f"),
    "loss": _newest(lambda state: state.snapshot.history.loss, ".2g"),
    "photos": _of_scene(lambda state: figure(_photos(state), ",d")),
    "width": _of_scene(lambda state: figure(_photo_size(state)[0], ",d")),
    "height": _of_scene(lambda state: figure(_photo_size(state)[1], ",d")),
    "rays": _of_scene(_rays),
    "t": _of_sample(lambda p, k: p.t[k], ".3f"),
    "delta": _delta,
    "sigma": _of_sample(lambda p, k: p.sigma[k], ".4g"),
    "alpha": _of_sample(lambda p, k: p.alpha[k], ".3f"),
    "T": _of_sample(lambda p, k: p.transmittance[k], ".3f"),
    "w": _of_sample(lambda p, k: p.weights[k], ".3f"),
    "r": _of_sample(lambda p, k: p.rgb[k, 0], ".2f"),
    "g": _of_sample(lambda p, k: p.rgb[k, 1], ".2f"),
    "b": _of_sample(lambda p, k: p.rgb[k, 2], ".2f"),
    "heaviest": lambda state: figure(found[1] + 1, ",d") if (found := chosen_sample(state)) is not None else NOTHING,
    "pixel": _of_ray(lambda ray: localized(triple(ray.color))),
    "weights": _of_ray(lambda ray: figure(ray.opacity, ".3f")),
    "depth": _of_ray(lambda ray: tr(number(ray.depth_expected))),
    "samples": _of_ray(_samples_of(-1)),
    "coarse": _of_ray(_samples_of(0)),
    "fine": _of_ray(_samples_of(-1)),
    "N3": lambda _: tr(size(GRID_SIDE**3 * GRID_BYTES)),
}
