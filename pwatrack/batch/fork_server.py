"""What a fork server imports first, so that it imports the rest faster and its processes share it."""

import gc
import os
import warnings

gc.disable()  # nothing that is imported goes again; each process begins to look, see `worker.serve`
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy: threads only cost time, and change the last bit
warnings.filterwarnings("ignore", category=RuntimeWarning)  # what overflows fails the check of the result
