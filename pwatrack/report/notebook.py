"""How a design, a run or an ensemble shows itself in a notebook: first screen, pictures, signals as a table."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pwatrack.errors import InvalidSpec
from pwatrack.report.page import escaped, image
from pwatrack.report.required import required
from pwatrack.report.screen import Findings, first_rows, joined
from pwatrack.workflow.variation import EnsembleResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEFT = "text-align:left;vertical-align:top"


class Pictures(dict[str, "Figure"]):
    """Figures by name; a notebook shows all of them, and each by itself."""

    @classmethod
    def of(cls, draw: Mapping[str, Callable[[], "Figure"]]) -> "Pictures":
        """Draw each picture."""
        from pwatrack.report.plots.canvas import png

        def shown(figure: "Figure") -> "Figure":
            vars(figure)["_repr_png_"] = lambda: png(figure)  # what IPython asks for where pyplot is not in use
            return figure

        return cls({name: shown(one()) for name, one in draw.items()})

    def _repr_html_(self) -> str:
        return "".join(_picture(name, figure) for name, figure in self.items())


def _picture(name: str, figure: "Figure") -> str:
    from pwatrack.report.plots.canvas import png

    return image(png(figure), name, ' style="max-width:48em;width:100%"')


def html(found: Findings) -> str:
    """Return the first screen of a design, a run or an ensemble as a table, and how its error goes as a picture.

    Example:
        >>> from pwatrack import design, load_spec
        >>> made = design(load_spec("specs/two_mass_paper_gains.yaml"))
        >>> "error to 0 from every start" in html(Findings(spec=made.spec, controller=made))
        True
    """
    lines = (
        f'<tr><th style="{_LEFT}">{escaped(label)}</th><td style="{_LEFT}">{escaped(text)}</td></tr>'
        for label, text in joined(first_rows(found))
    )
    table = f'<table style="max-width:60em"><caption>{escaped(found.spec.name)}</caption>{"".join(lines)}</table>'
    if found.result is None:
        return table
    from pwatrack.report.plots.signals import tracking_error

    return table + _picture(
        "tracking error", tracking_error(found.result) if found.many is None else spread(found.many)
    )


def spread(many: EnsembleResult) -> "Figure":
    """Return the picture of an ensemble, with what is required of its members."""
    from pwatrack.report.plots.spread import fan

    return fan(many, required(many.nominal.spec, many.nominal.controller, many=many))


def frame(columns: Mapping[str, Any], index: str | None = None) -> Any:
    """Return columns as a table of pandas, by time or by member; raises InvalidSpec if that is not installed."""
    try:
        pandas = import_module("pandas")
    except ImportError:
        message, hint = "to_dataframe: the package pandas is not installed", "pip install 'pwatrack[table]'"
        raise InvalidSpec(message, subject=None, hint=hint) from None
    table = pandas.DataFrame(dict(columns))
    return table if index is None else table.set_index(index)
