"""README and docs: the README is short, links work, pictures are small, imports in code blocks work."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path

import pages
import pytest

ROOT = Path(__file__).parent.parent
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
PICTURES = sorted(p for p in (ROOT / "docs").iterdir() if p.suffix in (".webp", ".svg", ".png"))
README_LINES = 200  # at most: a newcomer reads them in five minutes
LARGEST_PICTURE = 300_000  # bytes
LINK = re.compile(r"\]\(([^)\s]+)\)")
OURS = re.compile(r"`((?:[\w.]+/)*[\w.]+\.py|(?:nerf_core|viewer|tests|assets|examples)(?:/[\w.]+)+/?)`")
LINKED = re.compile(r"\[[^\]]*\]\([^)]*\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _links(page: Path) -> list[str]:
    return LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8")))


def test_a_newcomer_reads_the_readme_in_five_minutes() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for link in _links(page):
        if re.match(r"https?://", link):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        if not target.exists() or (anchor and anchor not in _anchors(target)):
            broken.append(link)
    assert not broken, f"{_name(page)} has broken links: {', '.join(broken)}"


def test_every_page_is_in_the_index() -> None:
    linked = {link.partition("#")[0] for link in _links(ROOT / "docs" / "README.md")}
    assert {page.name for page in (ROOT / "docs").glob("*.md") if page.name != "README.md"} <= linked


@pytest.mark.parametrize("picture", PICTURES, ids=_name)
def test_pictures_are_small_and_shown(picture: Path) -> None:
    assert picture.stat().st_size <= LARGEST_PICTURE
    assert any(picture.name in Path(link).name for page in PAGES for link in _links(page))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_files_that_pages_name_exist(page: Path) -> None:
    """Check the file and folder names in backticks, relative to the root of the repository or of a package."""
    text = LINKED.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    named = [name for name in OURS.findall(text) if "NAME" not in name and name not in pages.files()]
    bases = (ROOT, ROOT / "nerf_core", ROOT / "viewer")
    missing = [name for name in named if not any((base / name).exists() for base in bases)]
    assert not missing, f"{_name(page)} names files that do not exist: {', '.join(missing)}"


@pytest.mark.parametrize("page", [p for p in PAGES if PYTHON.search(p.read_text(encoding="utf-8"))], ids=_name)
def test_imports_on_pages_work(page: Path) -> None:
    """Run the imports of nerf_core in Python blocks. Other tests run the whole examples."""
    for block in PYTHON.findall(page.read_text(encoding="utf-8")):
        imports = [
            node for node in ast.parse(block).body
            if isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").startswith("nerf_core")
        ]  # fmt: skip
        exec(compile(ast.Module(list(imports), []), _name(page), "exec"), {})


def test_the_diagram_shows_the_packages_in_their_order() -> None:
    diagrams = runpy.run_path(str(ROOT / "docs" / "diagrams.py"))
    order = runpy.run_path(str(ROOT / "tests" / "nerf_core" / "test_imports.py"))["ORDER"]
    for name, rows in (("nerf_core", diagrams["CORE"]), ("viewer", diagrams["VIEWER"])):
        shown = [f"{name}.{package}" for package, _ in reversed(rows)]
        assert shown == [package for package in order if package.startswith(f"{name}.")]
    assert (ROOT / "docs" / "packages.svg").read_text(encoding="utf-8") == diagrams["packages"]()
    assert (ROOT / "docs" / "threads.svg").read_text(encoding="utf-8") == diagrams["threads"]()
