"""Which package may import which: one ordered list. Some libraries are only for the edges of the program."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import nerf_core
import nerf_core.probe
import viewer
from nerf_core.common.registry import Registry
from nerf_core.volume.compositing import absorb

CORE, VIEWER = Path(nerf_core.__file__).parent, Path(viewer.__file__).parent
# Bottom to top. A package imports only from itself and from packages before it.
ORDER = (
    "nerf_core.common", "nerf_core.geometry", "nerf_core.volume", "nerf_core.datasets", "nerf_core.captures",
    "nerf_core.kernels", "nerf_core.methods", "nerf_core.rendering", "nerf_core.training", "nerf_core.probe",
    "nerf_core.lab", "nerf_core.live", "nerf_core.commands", "nerf_core.cli",
    "viewer.window", "viewer.model", "viewer.ui", "viewer.draw", "viewer.commands", "viewer.panels", "viewer.tour",
    "viewer.app", "viewer.session", "viewer.cli",
)  # fmt: skip
# The edges of the program are windows, dataset formats, videos and the command line. Only they need these libraries.
EDGES = {
    "moderngl", "glfw", "imgui_bundle", "viewer", "pycolmap", "tyro", "rich", "imageio_ffmpeg", "numba", "platformdirs",
    "matplotlib", "triton",
}  # fmt: skip


def modules() -> list[tuple[str, Path]]:
    """Every module of both packages by its absolute name."""
    found = []
    for root in (CORE, VIEWER):
        for file in sorted(root.rglob("*.py")):
            parts = file.relative_to(root.parent).with_suffix("").parts
            found.append((".".join(parts[:-1] if parts[-1] == "__init__" else parts), file))
    return found


def imported(file: Path) -> set[str]:
    """Absolute names of all modules that a file imports, at its top or inside a function."""
    package = file.relative_to(CORE.parent).parent.parts
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) + "." if node.level else ""
            whole = (base + (node.module or "")).rstrip(".")
            names |= {whole} | {f"{whole}.{alias.name}" for alias in node.names}
    return names


def place(name: str) -> int | None:
    """The position of a module's package in ORDER; None for other libraries and for a whole top-level package."""
    parts = name.split(".")
    package = ".".join(parts[:2])
    return ORDER.index(package) if parts[0] in ("nerf_core", "viewer") and len(parts) > 1 else None


@pytest.mark.parametrize(("name", "file"), modules(), ids=lambda v: v if isinstance(v, str) else "")
def test_imports_go_to_packages_below(name: str, file: Path) -> None:
    own = place(name)
    if own is None:
        return
    # an attribute of a top-level package (nerf_core.__version__) has no place
    known = {n for n in imported(file) if ".".join(n.split(".")[:2]) in ORDER}
    above = {n for n in known if (place(n) or 0) > own}
    assert not above, f"{name} imports from above: {sorted(above)}"


def test_every_package_is_in_the_list() -> None:
    found = {".".join(name.split(".")[:2]) for name, _ in modules() if "." in name}
    assert found == set(ORDER)


def test_every_package_has_a_docstring() -> None:
    for name, file in modules():
        if file.name == "__init__.py":
            text = (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").partition("\n")[0]
            assert len(text) > 20, name
            assert text.endswith("."), name


def test_the_viewer_imports_itself_relatively() -> None:
    """The viewer's folder is installed under another name (see pyproject.toml)."""
    for file in VIEWER.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                assert (node.module or "").split(".")[0] != "viewer", file
            elif isinstance(node, ast.Import):
                assert all(alias.name.split(".")[0] != "viewer" for alias in node.names), file


def test_the_core_loads_no_library_that_only_an_edge_needs() -> None:
    names = (
        "training.trainer",
        "live.worker",
        "probe.opened",
        "rendering.images",
        "training.metrics",
        "geometry.paths",
    )
    code = "import sys; " + "; ".join(f"import nerf_core.{name}" for name in names)
    code += "; from nerf_core.methods import METHODS; METHODS.names()"
    code += "; from nerf_core.kernels.choice import PACKED_KERNELS, VOXEL_KERNELS"
    code += "; PACKED_KERNELS.names(), VOXEL_KERNELS.names()"
    code += "; from nerf_core.rendering.modes import MODES; MODES.names()"
    code += "; from nerf_core.rendering.export.models import EXPORTS; EXPORTS.names()"
    code += "; from nerf_core.probe.verdicts import VERDICTS; VERDICTS.names()"
    code += "; from nerf_core.live.shares import SHARES; SHARES.names()"
    code += "; from nerf_core.datasets import DATASETS; DATASETS.names()"
    code += "; from nerf_core.datasets.loading import load_scene"
    code += ";  print(*{n.split('.')[0] for n in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=CORE.parent)
    assert "torch" in done.stdout
    assert set(done.stdout.split()) & EDGES == set()


def test_messages_and_their_contents_load_neither_torch_nor_numba() -> None:
    """A process without torch can hold the window. The command has to mind Ctrl-C before it loads torch."""
    names = "live.messages", "geometry.scene", "probe.records", "methods", "datasets", "training.settings", "cli"
    for name in names:
        code = f"import sys, nerf_core.{name}; print(*{{'torch', 'numba', 'llvmlite'}} & set(sys.modules))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=CORE.parent)
        assert done.stdout.split() == [], name


def test_the_window_is_there_before_torch() -> None:
    """torch takes a second to load. The command opens a window and draws a frame without it."""
    code = """
import sys
from nerf_core.common.command_line import parse
from nerf_core.common.signals import Signals
from nerf_core.live.worker import Worker
from viewer.cli import ViewerOptions
from viewer.window import open_offscreen
from viewer.session.session import Session
settings = parse(ViewerOptions, "nerf-viewer", []).train.settings()
window = open_offscreen((640, 400))
with Signals() as signals:
    Worker._live = lambda worker: worker._done.set()  # the thread that may load torch
    session = Session(window, settings, signals, print)
    session.app.settle()
    text = session.worker.snapshot().loading
    print(*{"torch", "numba", "llvmlite", "matplotlib", "pycolmap"} & set(sys.modules), text, sep="|")
    session.close()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=CORE.parent)
    assert done.stdout.splitlines()[-1] == "PyTorch is loading"


def test_every_name_of_the_probe_is_found() -> None:
    for name in nerf_core.probe.__all__:
        assert getattr(nerf_core.probe, name).__class__.__name__ != "module", name
    with pytest.raises(AttributeError, match="no attribute 'nobody'"):
        nerf_core.probe.nobody  # noqa: B018


def test_the_core_imports_no_window() -> None:
    for file in CORE.rglob("*.py"):
        tops = {name.split(".")[0] for name in imported(file)}
        assert not tops & {"viewer", "moderngl", "glfw", "imgui_bundle"}, file


def registers(file: Path) -> bool:
    """Whether the file calls a registry's `register`, or `command`, which calls it."""
    calls = [node.func for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    names = {call.attr if isinstance(call, ast.Attribute) else getattr(call, "id", "") for call in calls}
    return bool(names & {"register", "command"})


def plugins(folder: Path) -> list[Path]:
    """The files of a folder, and of folders in it, that register something."""
    return [f for f in sorted(folder.rglob("*.py")) if registers(f)]


def registries() -> list[Registry[Any]]:
    """Every registry of both packages, wherever it is defined."""
    files = [(name, file) for name, file in modules() if re.search(r"= Registry\(", file.read_text(encoding="utf-8"))]
    values = [value for name, _ in files for value in vars(importlib.import_module(name)).values()]
    return [value for value in values if isinstance(value, Registry)]


def folder_of(registry: Registry[Any]) -> str:
    """The folder of a registry's plug-ins, such as "nerf_core/methods"."""
    return registry._package.replace(".", "/")


@pytest.mark.parametrize("registry", registries(), ids=folder_of)
def test_plugins_of_a_folder_do_not_import_each_other(registry: Registry[Any]) -> None:
    """docs/extending.md claims this. They may import a file of their folder that registers nothing."""
    folder = CORE.parent / folder_of(registry)
    files = plugins(folder)
    assert files or not registry.names()
    names = {f: ".".join(f.relative_to(CORE.parent).with_suffix("").parts) for f in files}
    for file in folder.rglob("*.py"):
        assert not imported(file) & (set(names.values()) - {names.get(file)}), file


def test_every_folder_of_plugins_is_on_the_page_about_them() -> None:
    page = (CORE.parent / "docs" / "extending.md").read_text(encoding="utf-8")
    found = [folder_of(registry) for registry in registries()]
    assert len(found) >= 12
    assert [folder for folder in found if f"`{folder}/NAME.py`" not in page] == []


def test_shapes_are_checked_while_testing() -> None:
    """The import hook of tests/conftest.py works: a call with tensors of unequal shapes raises TypeError."""
    sigma, delta = torch.zeros(2, 3), torch.zeros(2, 4)
    with pytest.raises(TypeError, match="absorb"):
        absorb(sigma, delta)
