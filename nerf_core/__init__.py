"""Train, render and open up neural radiance fields: no window, no GL."""

import os

__version__ = "0.1.0"  # the only place: pyproject.toml reads it

# OpenMP's threads spin while they wait for one another. By default so long that when anything else wants a core (a
# window does), each waits whole time slices for a neighbour that does not run; training then falls to a tenth.
# Sleeping at once is no better where waking is slow, as on virtual machines. They look a thousand times (microseconds:
# the next layer has mostly begun by then), then sleep: tests/benchmarks/waiting.py. Read once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # counts for GNU's OpenMP, which torch's Linux wheels carry
