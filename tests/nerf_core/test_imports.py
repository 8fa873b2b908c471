"""Who may import whom."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import nerf_core
import viewer
from nerf_core.volume import absorb

CORE, VIEWER = Path(nerf_core.__file__).parent, Path(viewer.__file__).parent
# What only a window, a format, a video or a command line needs.
EDGES = {
    "moderngl", "glfw", "imgui_bundle", "viewer", "pycolmap", "tyro", "rich", "imageio_ffmpeg", "numba", "platformdirs",
    "matplotlib",
}  # fmt: skip


def imported(file: Path) -> set[str]:
    """Absolute names of all modules that a file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_the_core_loads_nothing_that_only_an_edge_needs() -> None:
    modules = ("trainer", "worker", "probe", "render", "checkpoint", "metrics", "paths", "datasets")
    code = "import sys; " + "; ".join(f"import nerf_core.{name}" for name in modules)
    code += "; from nerf_core.methods import METHODS; METHODS.names(); print(*{n.split('.')[0] for n in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=CORE.parent)
    assert "torch" in done.stdout
    assert set(done.stdout.split()) & EDGES == set()


def test_the_core_knows_no_window() -> None:
    for file in CORE.rglob("*.py"):
        tops = {name.split(".")[0] for name in imported(file)}
        assert not tops & {"viewer", "moderngl", "glfw", "imgui_bundle"}, file


def registers(file: Path) -> bool:
    """Whether a class of the file is decorated with a registry's `register`."""
    classes = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.ClassDef)]
    calls = [d.func for c in classes for d in c.decorator_list if isinstance(d, ast.Call)]
    return any(isinstance(call, ast.Attribute) and call.attr == "register" for call in calls)


def plugins(folder: Path) -> list[Path]:
    """The files of a folder that register something; in folders without a registry, all."""
    files = [f for f in sorted(folder.glob("*.py")) if f.name != "__init__.py"]
    return [f for f in files if registers(f)] or files


@pytest.mark.parametrize("folder", [CORE / "datasets", CORE / "fields", CORE / "methods", VIEWER / "panels"])
def test_plugins_of_a_folder_do_not_know_each_other(folder: Path) -> None:
    package = ".".join(folder.relative_to(CORE.parent).parts)
    files = plugins(folder)
    assert files
    names = {f"{package}.{f.stem}" for f in files}
    for file in files:
        assert not imported(file) & (names - {f"{package}.{file.stem}"}), file


def test_shapes_are_checked_while_testing() -> None:
    """The import hook of tests/conftest.py is at work: a call with tensors of unequal shapes does not pass."""
    sigma, delta = torch.zeros(2, 3), torch.zeros(2, 4)
    with pytest.raises(TypeError, match="absorb"):
        absorb(sigma, delta)
