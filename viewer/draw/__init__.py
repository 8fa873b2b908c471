"""OpenGL textures, the viewport, overlays and plots."""
