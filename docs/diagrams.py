"""Draws the diagrams of architecture.md: python docs/diagrams.py writes packages.svg and threads.svg beside itself."""

from __future__ import annotations

from html import escape
from pathlib import Path

# Top to bottom, as tests/nerf_core/test_imports.py lists them the other way round: a name and what it does.
VIEWER = (
    ("cli", "the nerf-viewer command"),
    ("session", "one sitting: window, worker, wishes of the command line"),
    ("app", "the loop: events, frame, menu, viewport, panels"),
    ("tour", "steps of Markdown: what they do, show and wait for"),
    ("panels", "one file a panel"),
    ("commands", "what keys, menus and the pointer ask for"),
    ("draw", "OpenGL and plots: viewport, overlays, textures"),
    ("ui", "what a panel gets: contract, theme, widgets, layout"),
    ("model", "the window's state: camera, actions, link to the worker"),
    ("window", "GLFW on a screen, EGL without one"),
)
CORE = (
    ("cli", "the nerf-core command"),
    ("commands", "its subcommands, one file each"),
    ("live", "the worker thread behind a window"),
    ("lab", "studies: rows trained, measured and compared"),
    ("probe", "one pixel opened: ray, verdict, radiance, evidence"),
    ("training", "trainer, runs, checkpoints, evaluation"),
    ("rendering", "pictures, videos, render modes, exports"),
    ("methods", "one folder a method"),
    ("kernels", "the hot loops: torch, numba, Triton"),
    ("captures", "the check of a capture before training"),
    ("datasets", "captures on disk to Scene; one file a format"),
    ("volume", "sampling, compositing, encodings, grids"),
    ("geometry", "cameras, rays, space, camera paths"),
    ("common", "errors, registries, files, devices, compiling"),
)
INK, GREY, LINE = "#1f2933", "#5b6770", "#9aa5b1"
BLUE, GREEN, SAND = "#e3eefb", "#e4f4ea", "#faf1de"
ARROW = (
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    f'<path d="M0 0 L8 4 L0 8 Z" fill="{INK}"/></marker></defs>'
)


def text(x: float, y: float, words: str, *, size: int = 14, color: str = INK, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="{color}"{weight}>{escape(words)}</text>'


def box(x: float, y: float, width: float, height: float, fill: str) -> str:
    return f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6" fill="{fill}" stroke="{LINE}"/>'


def arrow(x: float, y: float, to_x: float, to_y: float) -> str:
    ends = f'x1="{x:g}" y1="{y:g}" x2="{to_x:g}" y2="{to_y:g}"'
    return f'<line {ends} stroke="{INK}" stroke-width="1.6" marker-end="url(#tip)"/>'


def page(width: float, height: float, parts: list[str]) -> str:
    """A whole SVG file on a white ground, so that it can be read on a dark page."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}" font-family="Roboto, Helvetica, Arial, sans-serif">'
    )
    ground = f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>'
    return "\n".join([head, ARROW, ground, *parts, "</svg>", ""])


def packages() -> str:
    row, width, left, right, top = 34, 440, 20, 520, 60
    parts = []
    for x, name, rows, fill in ((left, "viewer", VIEWER, BLUE), (right, "nerf_core", CORE, GREEN)):
        parts.append(text(x, top - 20, f"{name}/", size=18, bold=True))
        for k, (package, does) in enumerate(rows):
            y = top + k * row
            parts += [box(x, y, width, row - 6, fill), text(x + 12, y + 19, package, bold=True)]
            parts.append(text(x + 100, y + 19, does, size=12, color=GREY))
    middle = top + len(VIEWER) * row / 2
    parts.append(arrow(left + width + 4, middle, right - 6, middle))
    bottom = top + len(VIEWER) * row + 34
    parts.append(text(left, bottom, "A package imports only from packages below it.", color=GREY))
    parts.append(text(left, bottom + 20, "viewer imports nerf_core, never the other way.", color=GREY))
    return page(right + width + 20, top + len(CORE) * row + 14, parts)


def block(x: float, y: float, width: float, title: str, lines: tuple[str, ...], fill: str) -> str:
    height = 30 + 19 * len(lines)
    rows = [text(x + 12, y + 40 + 19 * k, line, size=12, color=GREY) for k, line in enumerate(lines)]
    return "\n".join([box(x, y, width, height, fill), text(x + 12, y + 21, title, bold=True), *rows])


def threads() -> str:
    gui, mail, worker, wide = 20, 330, 640, 270
    parts = [
        text(gui, 36, "GUI thread", size=18, bold=True),
        text(gui, 56, "owns OpenGL and imgui; no torch", size=12, color=GREY),
        block(gui, 76, wide, "viewer.app", (
            "handles events, draws a frame,", "sends actions to the worker"), BLUE),
        block(gui, 156, wide, "viewer.commands", (
            "keys, menus and the pointer", "become actions and worker commands"), BLUE),
        block(gui, 236, wide, "viewer.panels, viewer.draw", (
            "read the newest snapshot;", "the viewport warps the last picture", "until new pixels arrive"), BLUE),
        text(worker, 36, "Worker thread", size=18, bold=True),
        text(worker, 56, "owns models and the device", size=12, color=GREY),
        block(worker, 76, wide, "live.worker, live.scheduler", (
            "obey commands; then one training step", "or one piece of a picture, by one budget"), GREEN),
        block(worker, 156, wide, "live.run (one for each open model)", (
            "scene, trainer, preview (artist),", "opened ray, pins, export"), GREEN),
        block(worker, 236, wide, "training, methods, kernels", (
            "one optimiser step; the yield callback", "between gradient chunks serves commands,",
            "views and rays that somebody waits for"), GREEN),
        text(mail + 60, 36, "live.mailbox", size=18, bold=True),
        text(mail + 60, 56, "never waits", size=12, color=GREY),
    ]  # fmt: skip
    passing = (
        (110, "commands, in order", True), (160, "newest view of each run", True),
        (225, "newest snapshot of each run", False), (275, "notices, in order", False),
    )  # fmt: skip
    for y, words, inwards in passing:
        start, end = (gui + wide + 8, worker - 8) if inwards else (worker - 8, gui + wide + 8)
        parts += [arrow(start, y, end, y), text(mail + 60, y - 7, words, size=13)]
    parts += [
        text(gui, 380, "Helpers", size=18, bold=True),
        block(gui, 394, 280, "threads of datasets.loading", ("decode photos while a capture opens",), SAND),
        block(gui + 310, 394, 280, "threads of common.jit.shards", ("run the numba loops, a fixed shard each",), SAND),
        block(gui + 620, 394, 270, "child processes", ("COLMAP, ffmpeg, numba's compiler",), SAND),
    ]  # fmt: skip
    return page(930, 465, parts)


def main() -> None:
    folder = Path(__file__).parent
    for name, drawn in (("packages", packages()), ("threads", threads())):
        (folder / f"{name}.svg").write_text(drawn, encoding="utf-8")


if __name__ == "__main__":
    main()
