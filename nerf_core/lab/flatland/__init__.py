"""Flatland: a world of two dimensions, its one-dimensional photos, and a radiance field that learns it from them."""
