"""A dataset format and a method that nerf-viewer finds through entry points."""
