"""The hot loops of the fast methods behind two interfaces, implemented in torch, numba and Triton."""
