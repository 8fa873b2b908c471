"""The window's state: its camera, forms and choices."""
