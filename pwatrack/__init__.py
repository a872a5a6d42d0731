"""Output tracking control of continuous piecewise affine systems, with proofs.

    from pwatrack import plant, problem, load_spec, design, simulate, ensemble

The names below are loaded on first use, so that `import pwatrack` is instant.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pwatrack.version import __version__ as __version__

if TYPE_CHECKING:
    from pwatrack.api import Design as Design
    from pwatrack.api import Result as Result
    from pwatrack.api import design as design
    from pwatrack.api import ensemble as ensemble
    from pwatrack.api import simulate as simulate
    from pwatrack.errors import CheckFailed as CheckFailed
    from pwatrack.errors import Infeasible as Infeasible
    from pwatrack.errors import InvalidSpec as InvalidSpec
    from pwatrack.errors import OutsideTheory as OutsideTheory
    from pwatrack.errors import PwatrackError as PwatrackError
    from pwatrack.errors import Undecided as Undecided
    from pwatrack.export.controller import Controller as Controller
    from pwatrack.spec.arguments import plant as plant
    from pwatrack.spec.arguments import problem as problem
    from pwatrack.spec.load import load_spec as load_spec
    from pwatrack.spec.spec import Spec as Spec

_NAMES = {
    "pwatrack.spec.arguments": ("plant", "problem"),
    "pwatrack.spec.load": ("load_spec",),
    "pwatrack.spec.spec": ("Spec",),
    "pwatrack.api": ("design", "Design", "simulate", "Result", "ensemble"),
    "pwatrack.export.controller": ("Controller",),
    "pwatrack.errors": ("PwatrackError", "InvalidSpec", "OutsideTheory", "Infeasible", "Undecided", "CheckFailed"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'pwatrack' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
