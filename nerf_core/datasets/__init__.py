"""Load captures from disk into a `Scene`. Each format is one file; loading photos and normalising poses are shared.

Formats import what they need from `nerf_core.datasets.capture`. Of the formats that match, `auto` takes the one with
the lowest `rank`.
"""

from nerf_core.datasets.capture import DATASETS, Capture, Dataset, LoadOptions, Photo
from nerf_core.datasets.loading import check_options, load_scene

__all__ = ["DATASETS", "Capture", "Dataset", "LoadOptions", "Photo", "check_options", "load_scene"]
