"""The implementations of the hot loops, one file each. None imports numba or Triton before it is chosen."""
