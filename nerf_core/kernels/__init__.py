"""The hot loops behind one interface, in torch, numba and Triton."""
