"""Output tracking control of continuous piecewise affine systems, with proofs.

    from pwatrack import load_spec, design, simulate

The names below are loaded on first use, so that `import pwatrack` is instant.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pwatrack.version import __version__ as __version__

if TYPE_CHECKING:
    from pwatrack.errors import CheckFailed as CheckFailed
    from pwatrack.errors import Infeasible as Infeasible
    from pwatrack.errors import InvalidSpec as InvalidSpec
    from pwatrack.errors import OutsideTheory as OutsideTheory
    from pwatrack.errors import PwatrackError as PwatrackError
    from pwatrack.errors import Undecided as Undecided
    from pwatrack.export.controller import Controller as Controller
    from pwatrack.model.cells import Partition as Partition
    from pwatrack.model.pwa import PWASystem as PWASystem
    from pwatrack.pipeline import design as design
    from pwatrack.pipeline import simulate as simulate
    from pwatrack.report.files import write_design as write_design
    from pwatrack.report.files import write_result as write_result
    from pwatrack.result import Result as Result
    from pwatrack.spec.arguments import plant as plant
    from pwatrack.spec.arguments import problem as problem
    from pwatrack.spec.load import load_spec as load_spec
    from pwatrack.spec.spec import Spec as Spec
    from pwatrack.variation import ensemble as ensemble

_HOME = {
    "Controller": "pwatrack.export.controller",
    "Partition": "pwatrack.model.cells",
    "PWASystem": "pwatrack.model.pwa",
    "CheckFailed": "pwatrack.errors",
    "Infeasible": "pwatrack.errors",
    "InvalidSpec": "pwatrack.errors",
    "OutsideTheory": "pwatrack.errors",
    "PwatrackError": "pwatrack.errors",
    "Result": "pwatrack.result",
    "Undecided": "pwatrack.errors",
    "Spec": "pwatrack.spec.spec",
    "design": "pwatrack.pipeline",
    "ensemble": "pwatrack.variation",
    "load_spec": "pwatrack.spec.load",
    "plant": "pwatrack.spec.arguments",
    "problem": "pwatrack.spec.arguments",
    "simulate": "pwatrack.pipeline",
    "write_design": "pwatrack.report.files",
    "write_result": "pwatrack.report.files",
}
__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'pwatrack' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
