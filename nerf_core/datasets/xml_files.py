"""Read calibration files in XML that a stranger may have made: without entities, of bounded depth and size."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from nerf_core.common.errors import UserError, shorten
from nerf_core.datasets.posed_files import AGAIN, read_small

DEEPEST = 64  # a calibration has some eight levels
MAX_ELEMENTS = 1_000_000  # ten thousand photos take 100,000; an element takes some 200 bytes


def read_xml(file: Path) -> Element:
    """Read an XML file.

    A document type is refused, because entities can be declared there: they stand for other files, or for texts that
    grow without bound.

    Raises:
        UserError: for everything else than XML of these limits.
    """
    data, builder = read_small(file), TreeBuilder()
    parser = expat.ParserCreate()
    depth = elements = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements
        depth, elements = depth + 1, elements + 1
        if depth > DEEPEST or elements > MAX_ELEMENTS:
            raise UserError(f"{file} is nested too deeply, or has too many parts, for a calibration: {AGAIN}")
        builder.start(name, attributes)

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name)

    def doctype(*_: Any) -> None:
        raise UserError(f"{file} declares a document type, which is not read: remove the line <!DOCTYPE …>")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, doctype
    parser.buffer_text = True
    try:
        parser.Parse(data, True)
        return builder.close()
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code) or "it is no XML"
        raise UserError(f"{file} breaks off or is no XML at line {error.lineno} ({reason}): {AGAIN}") from error
    except (ValueError, LookupError, AssertionError) as error:
        raise UserError(f"{file} is no XML ({shorten(str(error))}): {AGAIN}") from error
