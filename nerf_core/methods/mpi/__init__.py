"""Optimised multiplane images with LLFF-style blending, for forward-facing captures."""
