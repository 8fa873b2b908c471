"""The window's colours, fonts and lengths. Lengths are in em, so that all DPI scales look alike."""

from __future__ import annotations

from imgui_bundle import ImVec2, ImVec4, imgui, implot

from nerf_core.common.assets import assets_dir

TEXT_PIXELS = 15.0  # height of the text font on a screen of scale 1


def _rgb(code: str, alpha: float = 1.0) -> ImVec4:
    red, green, blue = bytes.fromhex(code)
    return ImVec4(red / 255, green / 255, blue / 255, alpha)


def _mix(a: ImVec4, b: ImVec4, share: float) -> ImVec4:
    return ImVec4(*(p + (q - p) * share for p, q in zip(a, b, strict=True)))


CLEAR = ImVec4(0, 0, 0, 0)

# Okabe and Ito's palette, which people with any colour vision can distinguish (https://jfly.uni-koeln.de/color/).
ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    _rgb(code) for code in ("e69f00", "56b4e9", "009e73", "f0e442", "0072b2", "d55e00", "cc79a7")
)


class DarkTheme:
    """Three neutral surfaces, text at two strengths, hairlines, one accent; see `Theme` in contract.py."""

    palette = (ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE)

    ground = _rgb("101113")  # behind everything
    surface = _rgb("191a1d")  # panels
    raised = _rgb("26282c")  # buttons and fields
    hairline = _rgb("303338")
    text = _rgb("e6e8eb")
    muted = _rgb("969ba4")
    accent = SKY
    good = _rgb("3fbf8f")
    warning = ORANGE
    error = _rgb("f0705a")
    coarse = ORANGE
    fine = SKY
    density = _rgb("2fb890")  # Okabe and Ito's green, lightened to read on a dark surface
    transmittance = PURPLE
    ray = YELLOW
    # Their blue, lightened to read on a dark surface and under dark text; grey instead of their black.
    pins = (ORANGE, SKY, GREEN, YELLOW, _rgb("5f7dff"), VERMILION, PURPLE, _rgb("b0b4ba"))
    alpha = VERMILION
    point = _rgb("ffffff")

    def __init__(self) -> None:
        self.em = TEXT_PIXELS
        self.roboto: imgui.ImFont | None = None
        self._mono: imgui.ImFont | None = None

    @property
    def mono(self) -> imgui.ImFont:
        assert self._mono is not None, "load_fonts first"
        return self._mono

    def load_fonts(self) -> None:
        """Load Roboto for text and Inconsolata for figures, both with Font Awesome's icons; once per imgui context."""
        atlas, folder = imgui.get_io().fonts, assets_dir() / "fonts"
        roboto, icons = str(folder / "Roboto-Regular.ttf"), str(folder / "Font_Awesome_6_Free-Solid-900.otf")

        def merged(scale: float) -> imgui.ImFontConfig:
            config = imgui.ImFontConfig()
            config.merge_mode = True
            config.extra_size_scale = scale
            return config

        self.roboto = atlas.add_font_from_file_ttf(roboto, TEXT_PIXELS)
        atlas.add_font_from_file_ttf(
            icons, TEXT_PIXELS, merged(0.82)
        )  # smaller, because icons fill their em and letters do not
        self._mono = atlas.add_font_from_file_ttf(str(folder / "Inconsolata-Regular.ttf"), TEXT_PIXELS)
        atlas.add_font_from_file_ttf(roboto, TEXT_PIXELS, merged(1.0))  # σ, −, … that Inconsolata lacks
        atlas.add_font_from_file_ttf(icons, TEXT_PIXELS, merged(0.82))
        imgui.get_io().font_default = self.roboto

    def apply(self, scale: float, strong: bool = False) -> None:
        """Set imgui's and implot's style for a screen of this scale; call again when the scale changes.

        strong: strong contrast, for a projector in a bright room.
        """
        kind = type(self)
        self.ground, self.surface = (_rgb("000000"), _rgb("050506")) if strong else (kind.ground, kind.surface)
        self.raised, self.hairline = (_rgb("2c2f36"), _rgb("5a6069")) if strong else (kind.raised, kind.hairline)
        self.text, self.muted = (_rgb("ffffff"), _rgb("c9ced6")) if strong else (kind.text, kind.muted)
        self.em = round(TEXT_PIXELS * scale)
        style = imgui.get_style()
        # Panels push fonts by `em` in pixels, which contains the scale; so imgui's own factor stays 1.
        style.font_size_base, style.font_scale_dpi = self.em, 1.0
        self._lengths(style, self.em)
        self._colors(style)
        self.apply_to_plots()

    @staticmethod
    def _lengths(style: imgui.Style, em: float) -> None:
        def px(*share: float) -> tuple[float, ...]:
            """Round to whole pixels, because a fraction would blur into the neighbour's first row."""
            return tuple(float(max(1, round(v * em))) for v in share)

        (hair,) = px(1 / 16)
        style.window_padding = ImVec2(*px(0.75, 0.6))
        style.frame_padding = ImVec2(*px(0.55, 0.25))
        style.item_spacing = ImVec2(*px(0.5, 0.4))
        style.item_inner_spacing = ImVec2(*px(0.4, 0.3))
        style.cell_padding = ImVec2(*px(0.3, 0.12))
        style.window_min_size = ImVec2(*px(4, 3))
        style.separator_text_padding = ImVec2(0, *px(0.3))
        style.indent_spacing, style.scrollbar_size, style.grab_min_size = px(1.1, 0.7, 0.7)
        style.window_rounding = style.child_rounding = style.tab_rounding = 0
        style.popup_rounding = style.frame_rounding = style.grab_rounding = style.scrollbar_rounding = 0.2 * em
        style.window_border_size = style.popup_border_size = hair
        style.child_border_size = style.frame_border_size = style.tab_border_size = 0
        style.tab_bar_border_size = style.separator_size = style.separator_text_border_size = hair
        style.tab_bar_overline_size = style.docking_separator_size = 2 * hair
        style.window_menu_button_position = imgui.Dir.none
        style.disabled_alpha = 0.45

    def _colors(self, style: imgui.Style) -> None:
        col = imgui.Col_
        pressed, hovered = _mix(self.raised, self.accent, 0.45), _mix(self.raised, self.text, 0.12)
        table = {
            col.text: self.text, col.text_disabled: self.muted, col.text_link: self.accent,
            col.window_bg: self.surface, col.child_bg: CLEAR, col.popup_bg: _mix(self.surface, self.raised, 0.5),
            col.menu_bar_bg: self.surface, col.border: self.hairline, col.border_shadow: CLEAR,
            col.docking_empty_bg: self.ground, col.docking_preview: _rgb("56b4e9", 0.35),
            col.frame_bg: self.raised, col.frame_bg_hovered: hovered, col.frame_bg_active: pressed,
            col.button: self.raised, col.button_hovered: hovered, col.button_active: pressed,
            col.header: self.raised, col.header_hovered: hovered, col.header_active: pressed,
            col.title_bg: self.ground, col.title_bg_active: self.ground, col.title_bg_collapsed: self.ground,
            col.tab: self.ground, col.tab_hovered: self.raised, col.tab_selected: self.surface,
            col.tab_selected_overline: self.accent, col.tab_dimmed: self.ground,
            col.tab_dimmed_selected: self.surface, col.tab_dimmed_selected_overline: CLEAR,
            col.separator: self.hairline, col.separator_hovered: self.accent, col.separator_active: self.accent,
            col.resize_grip: CLEAR, col.resize_grip_hovered: hovered, col.resize_grip_active: pressed,
            col.scrollbar_bg: CLEAR, col.scrollbar_grab: self.hairline,
            col.scrollbar_grab_hovered: hovered, col.scrollbar_grab_active: pressed,
            col.check_mark: self.accent, col.slider_grab: self.muted, col.slider_grab_active: self.accent,
            col.input_text_cursor: self.accent, col.text_selected_bg: _rgb("56b4e9", 0.35),
            col.plot_lines: self.fine, col.plot_histogram: self.accent,
            col.table_header_bg: CLEAR, col.table_border_strong: self.hairline,
            col.table_border_light: self.hairline, col.table_row_bg: CLEAR, col.table_row_bg_alt: CLEAR,
            col.nav_cursor: self.accent, col.drag_drop_target: self.accent,
        }  # fmt: skip
        for index, color in table.items():
            style.set_color_(index, color)

    def apply_to_plots(self) -> None:
        """Set the style of the current implot context."""
        style, em = implot.get_style(), self.em
        style.plot_padding = ImVec2(0.3 * em, 0.4 * em)
        style.label_padding = ImVec2(0.3 * em, 0.25 * em)
        style.legend_padding = ImVec2(0.4 * em, 0.4 * em)
        style.mouse_pos_padding = ImVec2(0.4 * em, 0.3 * em)
        style.annotation_padding = ImVec2(0.2 * em, 0.1 * em)
        style.plot_min_size = ImVec2(6 * em, 3 * em)
        style.major_tick_len = style.minor_tick_len = ImVec2(0.25 * em, 0.25 * em)
        style.plot_border_size = 0
        col = implot.Col_
        for index, color in {
            col.frame_bg: CLEAR, col.plot_bg: _mix(self.ground, self.surface, 0.4), col.plot_border: self.hairline,
            col.legend_bg: self.surface, col.legend_border: CLEAR, col.legend_text: self.muted,
            col.title_text: self.muted, col.inlay_text: self.muted, col.axis_text: self.muted,
            col.axis_grid: self.hairline, col.axis_bg_hovered: self.raised, col.axis_bg_active: self.raised,
            col.selection: self.accent, col.crosshairs: self.muted,
        }.items():  # fmt: skip
            style.set_color_(index, color)
