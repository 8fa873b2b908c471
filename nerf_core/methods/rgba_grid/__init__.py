"""A dense grid of colour and opacity, composited front to back and optimised directly."""
