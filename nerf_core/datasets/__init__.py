"""Captures on disk → `Scene`: one file a format, shared loading of photos and normalisation of poses.

Formats import what they need from `nerf_core.datasets.capture`; ranks for `auto`: demo −1 (never matches),
blender 0, transforms 1, colmap 2, llff 3.
"""

from nerf_core.datasets.capture import DATASETS, Capture, Dataset, LoadOptions, Photo
from nerf_core.datasets.loading import check_options, load_scene

__all__ = ["DATASETS", "Capture", "Dataset", "LoadOptions", "Photo", "check_options", "load_scene"]
