"""Where the demo scene, fonts and icon lie: inside the installed package, else beside it in a checkout."""

from pathlib import Path


def assets_dir() -> Path:
    """The folder of shipped assets. Raises FileNotFoundError when the installation is incomplete."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the assets of nerf-viewer are missing from {package}: install it again")
