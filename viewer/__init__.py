"""The window: an OpenGL viewer over nerf_core."""
