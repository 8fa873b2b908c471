"""Load captures from disk into a `Scene`. Each format is one file; loading photos and normalising poses are shared.

Formats import what they need from `nerf_core.datasets.capture`. Their ranks for `auto`: demo −1 (never matches),
blender 0, transforms 1, colmap 2, llff 3.
"""

from nerf_core.datasets.capture import DATASETS, Capture, Dataset, LoadOptions, Photo
from nerf_core.datasets.loading import check_options, load_scene

__all__ = ["DATASETS", "Capture", "Dataset", "LoadOptions", "Photo", "check_options", "load_scene"]
