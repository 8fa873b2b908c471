"""Compiled loops: numba's cache, vector instructions, and the threads that share the work."""
