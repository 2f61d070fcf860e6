"""PaD-GS: panoramic Gaussian splatting with a distortion map, and the means to compare it fairly.

Nothing is imported here: `padgs.results` must load without torch, and `padgs --help` must answer at once.
"""

import os

# Threads that wait for the next parallel piece of work must sleep, not spin: on a machine with other work on it,
# spinning made training 20 times slower. Has to be said before torch loads its OpenMP runtime.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
