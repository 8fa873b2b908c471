"""Which implementations of the hot loops there are: one file each. None imports numba or Triton before it is chosen."""
