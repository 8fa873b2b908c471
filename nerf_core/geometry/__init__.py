"""Cameras, rays and the space that they cross."""
