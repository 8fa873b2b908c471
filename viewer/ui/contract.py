"""The interface of panels. A panel reads the state, draws itself with imgui, and returns the actions it asks for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, Protocol

import numpy as np
from imgui_bundle import ImVec4, imgui

from nerf_core.common.registry import Registry

from ..model.state import Action, AppState


class Theme(Protocol):
    """Colours as ImVec4; see theme.py."""

    text: ImVec4
    muted: ImVec4
    accent: ImVec4
    good: ImVec4
    warning: ImVec4
    error: ImVec4
    hairline: ImVec4
    surface: ImVec4
    coarse: ImVec4
    fine: ImVec4
    density: ImVec4
    transmittance: ImVec4
    ray: ImVec4
    pins: tuple[ImVec4, ...]
    alpha: ImVec4
    point: ImVec4


class Ui(Protocol):
    """The services that the app gives a panel while it draws."""

    @property
    def em(self) -> float:
        """The text font's size in pixels; every length is a multiple of it."""
        ...

    @property
    def mono(self) -> imgui.ImFont:
        """The font for columns of figures: imgui.push_font(ui.mono, ui.em)."""
        ...

    @property
    def theme(self) -> Theme: ...

    def texture(self, key: str, rgba: np.ndarray, smooth: bool = True) -> imgui.ImTextureRef:
        """Upload uint8 (h, w, 4) under `key`; it is uploaded again only if it is another array object."""
        ...

    def mark(self, name: str) -> None:
        """Remember the last item's rectangle under `name`, so that tests and scripts can click it."""
        ...


class Panel(Protocol):
    """A panel. `title` is its unique name, `dock` its first place, and a smaller `order` comes first.

    An "overlay" gets no window from the app. It is drawn last, in every frame, and opens its own windows.
    """

    @property
    def title(self) -> str: ...

    @property
    def dock(self) -> Literal["right", "bottom", "bottom_right", "overlay"]: ...

    @property
    def order(self) -> int: ...

    def draw(self, ui: Ui, state: AppState) -> Iterable[Action]: ...


PANELS: Registry[type[Panel]] = Registry("panel", f"{__name__.rsplit('.', 2)[0]}.panels")
