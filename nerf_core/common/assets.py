"""Find the demo scene, fonts and icon: they lie inside the installed package, or beside it in a checkout."""

from pathlib import Path


def assets_dir() -> Path:
    """Return the folder of shipped assets. Raises FileNotFoundError if the installation is incomplete."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the assets of nerf-viewer are missing from {package}: install it again")
