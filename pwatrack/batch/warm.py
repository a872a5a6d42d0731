"""What every spec needs, imported once: a fork server imports this module, and its processes have it all."""

import gc
import os
import warnings


def _warm() -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # before numpy: threads only cost time, and change the last bit

    import pwatrack.batch.work
    import pwatrack.report.plots
    import pwatrack.simulation.kernel  # noqa: F401

    warnings.filterwarnings("ignore", category=RuntimeWarning)  # what overflows fails the check of the result
    gc.collect()
    gc.freeze()  # the collector leaves these pages shared


_warm()
