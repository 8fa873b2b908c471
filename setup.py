"""The packages to install; everything else about the build stands in pyproject.toml.

The folder `viewer` is installed as the package `nerf_viewer`, as its own name would collide with others'. Packages are
found, not listed, so that a new one needs no change here.
"""

import shutil

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

ASSETS = "nerf_core.assets"
VIEWER = ["nerf_viewer", *(f"nerf_viewer.{name}" for name in find_packages("viewer"))]


class Build(build_py):
    """Packages as they are now."""

    def run(self) -> None:
        if not self.editable_mode:  # modules that have been deleted would come from an earlier build's folder
            shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Of the assets only data is installed, not the scripts that make it."""
        return [] if package == ASSETS else super().find_package_modules(package, package_dir)


setup(packages=[*find_packages(include=["nerf_core", "nerf_core.*"]), ASSETS, *VIEWER], cmdclass={"build_py": Build})
