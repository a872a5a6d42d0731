"""The pictures of a run, as files and for its page: drawn here, or by other processes while this one goes on."""

from collections.abc import Callable
from concurrent.futures import Executor
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from pwatrack.interruption import as_ended

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pwatrack.workflow.outcome import SimulatedLoop

PROCESSES = 2  # that share the pictures
_SHARES = tuple(slice(k, None, PROCESSES) for k in range(PROCESSES))  # the largest pictures are the first


class Picture(NamedTuple):
    """A picture as a PNG file, and as an SVG file, which is sharp at any size."""

    png: bytes
    svg: str


def prepare(executor: Executor) -> None:
    """Let the processes that will draw begin, and import what that takes."""
    for _ in _SHARES:
        executor.submit(import_module, "pwatrack.report.plots.pictures")


def begin(result: "SimulatedLoop", executor: Executor | None) -> Callable[[], dict[str, Picture]]:
    """Begin to draw in other processes; return what waits for it, and draws here what they could not."""
    if executor is None or result.spool is not None:
        return lambda: drawn(slice(None), result)
    begun = {executor.submit(drawn, share, result): share for share in _SHARES}

    def wait() -> dict[str, Picture]:
        found = dict[str, Picture]()
        for future in as_ended(begun):
            found |= future.result() if future.exception() is None else drawn(begun[future], result)
        return found

    return wait


def drawn(share: slice, result: "SimulatedLoop") -> dict[str, Picture]:
    """Draw some of the pictures of a run."""
    from pwatrack.report.plots.pictures import pictures

    return {name: picture(draw()) for name, draw in list(pictures(result).items())[share]}


def picture(figure: "Figure") -> Picture:
    """Draw a figure."""
    from pwatrack.report.plots.canvas import png, svg

    return Picture(png(figure), svg(figure))
