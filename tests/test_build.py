"""The wheel: which packages and files it has, under which names."""

from __future__ import annotations

import importlib.metadata
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import nerf_core

ROOT = Path(__file__).parents[1]
SCRIPTS = {"nerf-viewer": "nerf_viewer.cli:command", "nerf-core": "nerf_core.cli:main"}


def test_the_viewer_is_installed_under_a_name_of_its_own() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        config = tomllib.load(file)
    assert config["project"]["scripts"] == SCRIPTS
    folders = config["tool"]["setuptools"]["package-dir"]
    assert folders == {"nerf_viewer": "viewer", "nerf_core.assets": "assets"}
    assert all((ROOT / folder).is_dir() for folder in folders.values())
    assert config["tool"]["setuptools"]["dynamic"]["version"]["attr"] == "nerf_core.__version__"


def test_the_citation_has_the_version() -> None:
    assert f"\nversion: {nerf_core.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.thorough(3)
def test_the_wheel_has_both_packages_and_the_assets(tmp_path: Path) -> None:
    try:
        version = int(importlib.metadata.version("setuptools").partition(".")[0])
        importlib.metadata.version("pip")
    except importlib.metadata.PackageNotFoundError as error:
        pytest.skip(f"no wheel can be built here without the network: {error}")
    if version < 77:
        pytest.skip(f"no wheel can be built here without the network: setuptools {version} is older than 77")
    source = tmp_path / "source"
    for folder in ("nerf_core", "viewer", "assets"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    stale = source / "build" / "lib" / "nerf_core" / "methods" / "deleted.py"
    stale.parent.mkdir(parents=True)
    stale.write_text("of an earlier build")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-index", "--no-build-isolation"]
    done = subprocess.run([*command, "-w", tmp_path, source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.startswith(f"nerf_viewer-{nerf_core.__version__}-")
    names = set(zipfile.ZipFile(wheel).namelist())
    metadata = f"nerf_viewer-{nerf_core.__version__}.dist-info"
    assert {name.partition("/")[0] for name in names} == {"nerf_core", "nerf_viewer", metadata}
    for folder, package in (("nerf_core", "nerf_core"), ("viewer", "nerf_viewer")):
        modules = {f"{package}/{file.relative_to(ROOT / folder)}" for file in (ROOT / folder).rglob("*.py")}
        assert modules == {n for n in names if n.startswith(f"{package}/") and n.endswith(".py")}
    files = [f for f in (ROOT / "assets").rglob("*") if f.is_file() and f.suffix not in (".py", ".pyc")]
    data = {f"nerf_core/assets/{file.relative_to(ROOT / 'assets')}" for file in files}
    assert data == {n for n in names if n.startswith("nerf_core/assets/")}
    assert sum(n.startswith(f"{metadata}/licenses/") for n in names) == 4
