"""What a fork server imports first, so that it imports the rest faster and its processes share it."""

import gc
import warnings

from pwatrack.cores import one_thread

gc.disable()  # nothing that is imported goes again; each process begins to look, see `pool.serve`
one_thread()
warnings.filterwarnings("ignore", category=RuntimeWarning)  # what overflows fails the check of the result
