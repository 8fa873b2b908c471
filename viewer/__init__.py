"""The window: a microscope for neural radiance fields that train while you look."""
