"""The slice panel: the radiance along one diameter of its disc as lines, and the photos' colours as dots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.common.language import figure, marked, tr

from ..model.state import Action, AppState
from ..ui.axes import Limits, axis_name
from ..ui.contract import PANELS, Ui
from ..ui.widgets import color_of, field_width, hint, nothing_yet

NEAR_DEGREES = 12.0  # photos farther from the slice's plane are left out
CHANNELS = (ImVec4(0.92, 0.36, 0.32, 1), ImVec4(0.36, 0.78, 0.42, 1), ImVec4(0.40, 0.58, 0.95, 1))
PLOT = implot.Flags_.no_title | implot.Flags_.no_legend | implot.Flags_.no_menus | implot.Flags_.no_mouse_text


@PANELS.register("slice")
class SlicePanel:
    title = marked("Slice")
    dock: Literal["bottom_right"] = "bottom_right"
    order = 2

    def __init__(self) -> None:
        self.degrees = 0.0
        self._angle, self._color = Limits(-90.0, 90.0), Limits(0.0, 1.05)

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        yield from ()
        probe, evidence = state.snapshot.radiance, state.snapshot.evidence
        if probe is None:
            text = tr("Click a pixel: here you will see how its colour changes along a line of directions.")
            nothing_yet(ui, state.snapshot.method, text, ("trace", "radiance"))
            return
        field_width(ui, tr("azimuth"))
        _, self.degrees = imgui.slider_float(f"{tr('azimuth')}###azimuth", self.degrees, 0.0, 180.0, "%.0f°")
        ui.mark("slice.azimuth")
        hint(ui, tr("lines: model; dots: photos within {angle}° of the slice").format(angle=figure(NEAR_DEGREES, "g")))
        azimuth = float(np.radians(self.degrees))
        angles, rgb = probe.slice(azimuth, state.radiance_of)
        if not implot.begin_plot("##slice", ImVec2(-1, max(imgui.get_content_region_avail().y, 6 * ui.em)), PLOT):
            return
        self._angle.link(implot.ImAxis_.x1)
        self._color.link(implot.ImAxis_.y1)
        for c, color in enumerate(CHANNELS):
            line = implot.Spec(line_color=color, line_weight=0.12 * ui.em)
            implot.plot_line(f"channel {c}", np.degrees(angles), rgb[:, c].astype(np.float64), line)
        if evidence is not None:
            angle, across = (np.degrees(each) for each in probe.slice_position(evidence.directions, azimuth))
            for k in np.flatnonzero(evidence.seen & (abs(across) <= NEAR_DEGREES) & (abs(angle) <= 90)).tolist():
                fill = color_of(evidence.observed[k])
                for c, color in enumerate(CHANNELS):
                    dot = implot.Spec(
                        marker=implot.Marker_.circle, marker_size=0.32 * ui.em, marker_line_color=color,
                        marker_fill_color=fill,
                    )  # fmt: skip
                    place = angle[k : k + 1], evidence.observed[k, c : c + 1].astype(np.float64)
                    implot.plot_scatter(f"photo {k} {c}", *place, dot)
        axis_name(ui, tr("colour"))
        around_normal = probe.normal is not None and probe.around == "normal"
        middle = tr("degrees from the normal") if around_normal else tr("degrees from the viewer")
        axis_name(ui, middle, right=True, height=1.0)
        implot.end_plot()
        ui.mark("slice.plot")
