"""The hot loops behind one interface: torch (the reference), numba (CPU), triton (CUDA)."""
