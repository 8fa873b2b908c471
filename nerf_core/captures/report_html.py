"""Write a capture report as one HTML page that needs nothing else, and as JSON."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.captures.report_odd import OFF_STOPS, SOFT
from nerf_core.captures.report_records import CaptureReport, PhotoFacts
from nerf_core.captures.report_svg import disc, elevation, plan, row
from nerf_core.common.errors import UserError
from nerf_core.common.files import write_atomically
from nerf_core.common.text import NOTHING, counted

MARK = "nerf-viewer capture report"  # both files have it near their beginning: other files are not replaced
HEAD_BYTES = 400
STYLE = """
:root { color-scheme: light dark; --bg: #fbfbfa; --text: #1d1f21; --muted: #62666b; --line: #d9dadb; --cam: #2a6fb0;
  --odd: #d55e00; --held: #7a7f85; --gap: #d55e0040; --pt: #b4b7ba; --card: #ffffff; }
@media (prefers-color-scheme: dark) { :root { --bg: #16181a; --text: #e6e7e8; --muted: #9aa0a6; --line: #33373b;
  --cam: #6db3f2; --odd: #ff9147; --held: #8a9097; --gap: #ff914740; --pt: #555a60; --card: #1d2023; } }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 62rem; background: var(--bg); color: var(--text);
  font: 15px/1.5 Roboto, "Segoe UI", system-ui, sans-serif; }
h1 { font-size: 1.7rem; font-weight: 500; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; font-weight: 600; margin: 2.2rem 0 .6rem; padding-bottom: .3rem;
  border-bottom: 1px solid var(--line); }
.lead { margin: .4rem 0 0; color: var(--muted); }
.overall { margin: 1.2rem 0 .8rem; font-size: 1.15rem; line-height: 1.45; }
ol, ul { padding-left: 1.4rem; margin: 0; } li { margin: .35rem 0; } .do { color: var(--muted); }
.maps { display: grid; grid-template-columns: repeat(auto-fit, minmax(17rem, 1fr)); gap: 1rem; }
figure { margin: 0; } figcaption { color: var(--muted); font-size: .85rem; margin-top: .2rem; }
svg { display: block; width: 100%; background: var(--card); border: 1px solid var(--line); border-radius: 4px; }
svg text { font: 11px Roboto, system-ui, sans-serif; fill: var(--muted); }
svg .m { text-anchor: middle; } svg .r { text-anchor: end; }
.pt { fill: var(--pt); } .ax { stroke: var(--muted); fill: none; } .grid { stroke: var(--line); fill: none; }
.rim { fill: none; stroke: var(--muted); } .gap { fill: var(--gap); }
.cam circle { fill: var(--cam); } .cam path { stroke: var(--cam); fill: none; opacity: .7; }
.odd circle { fill: var(--odd); } .odd path { stroke: var(--odd); fill: none; }
.held circle { fill: var(--card); stroke: var(--held); stroke-width: 1.5; } .held path { stroke: var(--held);
  fill: none; opacity: .6; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: .88rem; }
th { text-align: left; font-weight: 500; color: var(--muted); vertical-align: bottom; }
th, td { padding: .3rem .7rem .3rem 0; border-bottom: 1px solid var(--line); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; } td.n { white-space: nowrap; }
td:last-child { min-width: 8rem; }
td img { display: block; width: 5.5rem; height: 4rem; object-fit: contain; object-position: left; }
td.name { overflow-wrap: anywhere; min-width: 8rem; } .why { color: var(--odd); }
.key span { margin-right: 1.2rem; white-space: nowrap; } .key i { display: inline-block; width: .6rem; height: .6rem;
  border-radius: 50%; margin-right: .35rem; box-sizing: border-box; }
"""
METHOD = (
    "Sharpness is the ratio of fine to coarse detail, s = √(Var ∇²Y / Var ∇²Y₄): Y is the luminance, Y₄ its mean over "
    "4 × 4 pixels, and ∇² the Laplacian. The variance of the Laplacian is the usual measure of focus (Pech-Pacheco et "
    "al. 2000, Pertuz et al. 2013); the ratio does not depend on how much texture a photo shows (Field 1987). It is "
    "measured at up to 2,048 pixels a side, and compared with the median of the six most similar views.",
    "Exposure is the mean of log₂ of the luminance, so that a difference of 1 is one stop. It, too, is compared with "
    "similar views. Clipped: a channel at 254 of 255 or more.",
    "The separation of two views is the larger of the angle between their optical axes and the angle between their "
    "places as seen from the content. Within 30°, features can be matched (Mikolajczyk and Schmid 2005).",
    "A photo stands out if its robust z-score, 0.6745 (x − median) / MAD, is beyond 3.5 (Iglewicz and Hoaglin 1993) "
    "and the difference is one that can be seen.",
)


def to_html(report: CaptureReport) -> str:
    """Return the page. It has its pictures in itself and no script, and is well-formed XML after its first line."""
    title = f"Capture report: {report.name}"
    parts = [
        f"<h1>{escape(report.name)}</h1>",
        f'<p class="lead">Capture report · {escape(report.format)} · {counted(len(report.photos), "photo")}</p>',
        f'<p class="overall">{escape(report.overall)}</p>',
        f"<p>{escape(report.summary)}</p>",
        "<h2>What limits the quality</h2>",
        _limits(report),
        "<h2>What to photograph next</h2>",
        _list(report.next, "Nothing is missing."),
        "<h2>Where the photos were taken</h2>",
        _key(),
        f'<div class="maps">{plan(report)}{elevation(report)}{_disc(report)}</div>',
        "<h2>Sharpness and exposure</h2>",
        _rows(report),
        "<h2>Calibration</h2>",
        _list(report.calibration, ""),
    ]
    if report.notes:
        parts += ["<h2>Notes from loading</h2>", _list(report.notes, "")]
    parts += ["<h2>Photos</h2>", _table(report), "<h2>How it is measured</h2>"]
    parts += [f"<p>{escape(text)}</p>" for text in METHOD]
    head = f'<meta charset="utf-8"/><meta name="generator" content="{MARK}"/><title>{escape(title)}</title>'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def to_json(report: CaptureReport) -> str:
    """Return the numbers of the page. Angles are in degrees, lengths in scene units; what is not known is null."""
    known: dict[str, Any] = {"generator": MARK, "version": 1}
    for field in dataclasses.fields(report):
        if field.name not in ("points", "photos"):
            known[field.name] = _plain(getattr(report, field.name))
    known["photos"] = [
        {f.name: _plain(getattr(p, f.name)) for f in dataclasses.fields(p) if f.name != "thumbnail"}
        for p in report.photos
    ]
    return json.dumps(known, indent=1, allow_nan=False) + "\n"


def json_beside(file: Path) -> Path:
    """Return where the numbers of a page go."""
    return file.with_suffix(".json")


def check_files(file: Path) -> None:
    """Raise UserError unless a page and its numbers may be written: nothing but an earlier report is replaced."""
    if file.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{file}: a report is a page: name a .html file")
    for one in (file, json_beside(file)):
        try:
            if one.is_dir():
                raise UserError(f"{one} is a folder: name a .html file")
            if one.exists() and not _is_report(one):
                raise UserError(f"{one} is there and is no capture report: choose another name")
        except OSError as error:
            raise UserError(f"{one}: {error.strerror or error}: choose another name") from None


def _is_report(file: Path) -> bool:
    with file.open("rb") as opened:
        return MARK.encode() in opened.read(HEAD_BYTES)


def write_report(report: CaptureReport, file: Path) -> tuple[Path, Path]:
    """Write the page and its numbers, and return their paths. Raises UserError."""
    check_files(file)
    write_atomically(json_beside(file), to_json(report))
    write_atomically(file, to_html(report))
    return file, json_beside(file)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return str(value) if isinstance(value, str) else value


def _limits(report: CaptureReport) -> str:
    if not report.limits:
        return "<p>No limit was found in places, sharpness, exposure and calibration.</p>"
    lines = [
        f'<li>{escape(_sentence(one.text))} <span class="do">→ {escape(one.advice)}</span></li>'
        for one in report.limits
    ]
    return f"<ol>{''.join(lines)}</ol>"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _list(texts: Sequence[str], nothing: str) -> str:
    if not texts:
        return f"<p>{escape(nothing)}</p>"
    return f"<ul>{''.join(f'<li>{escape(_sentence(text))}</li>' for text in texts)}</ul>"


def _key() -> str:
    return (
        '<p class="key lead"><span><i style="background:var(--cam)"></i>training</span>'
        '<span><i style="border:1.5px solid var(--held)"></i>held out</span>'
        '<span><i style="background:var(--odd)"></i>stands out</span>'
        '<span><i style="background:var(--pt)"></i>sparse points</span></p>'
    )


def _disc(report: CaptureReport) -> str:
    return disc(report) if report.kind in ("around", "one-sided") else ""


def _rows(report: CaptureReport) -> str:
    sharp, light = [p.relative_sharpness for p in report.photos], [p.relative_exposure for p in report.photos]
    marks: tuple[tuple[float, str], ...] = ((1.0, "1"), (SOFT, f"{SOFT}"))
    first = row(report, sharp, f"Relative sharpness: below {SOFT} a photo is soft", marks)
    marks = ((0.0, "0"), (OFF_STOPS, f"+{OFF_STOPS}"), (-OFF_STOPS, f"−{OFF_STOPS}"))
    return first + row(report, light, "Relative exposure, in stops", marks)


def _table(report: CaptureReport) -> str:
    heads = (
        "", "photo", "split", "sharpness", "relative sharpness", "exposure, stops", "relative exposure, stops",
        "clipped", "most similar view",
    )  # fmt: skip
    cells = "".join(f'<th class="{"n" if 3 <= k <= 7 else ""}">{head}</th>' for k, head in enumerate(heads))
    rows = "".join(_photo(report, p) for p in report.photos)
    note = "Relative: compared with the median of similar views. Most similar view: among the training photos."
    table = f"<table><thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table>"
    return f'<p class="lead">{note}</p><div class="scroll">{table}</div>'


def _photo(report: CaptureReport, p: PhotoFacts) -> str:
    picture = ""
    if p.thumbnail:
        picture = f'<img alt="" src="data:image/webp;base64,{base64.b64encode(p.thumbnail).decode()}"/>'
    why = "".join(f'<div class="why">{escape(_sentence(text))}</div>' for text in p.odd)
    near = f"{p.separation:.1f}° {escape(report.photos[p.nearest].name)}" if p.nearest >= 0 else NOTHING
    numbers = (
        _number(p.sharpness, ".2f"),
        _number(p.relative_sharpness, ".2f"),
        _number(p.exposure, ".1f"),
        _number(p.relative_exposure, "+.2f"),
        f"{100 * p.highlights:.0f} %",
    )
    cells = "".join(f'<td class="n">{text}</td>' for text in numbers)
    name = f'<td class="name">{escape(p.name)}{why}</td><td>{escape(p.split)}</td>'
    return f"<tr><td>{picture}</td>{name}{cells}<td>{near}</td></tr>"


def _number(value: float, spec: str) -> str:
    return format(float(format(value, spec)) or 0.0, spec).replace("-", "−") if math.isfinite(value) else NOTHING
