"""Train, render and open up neural radiance fields: no window, no GL."""

import os

# OpenMP's threads spin while they wait for one another. When anything else wants a core (a window does), each waits
# a whole time slice for a neighbour that does not run: two threads on two cores, one of them busy, then train at less
# than a tenth of their speed. Sleeping costs a few per cent on a quiet machine. Read once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
