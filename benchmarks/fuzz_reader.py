"""Fuzz the reader of specs and the formulas in them, guided by coverage: no crash, no hang, no flood.

    make fuzz-reader [SECONDS=600]

It starts from the shipped specs and from formulas. Whatever a file says, the answer is a spec or a `PwatrackError`;
anything else, more than 10 s, or more than 2 GiB ends the run with the input that did it.
"""

import contextlib
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["pwatrack.spec", "pwatrack.model", "yaml"]):
    from pwatrack.errors import PwatrackError
    from pwatrack.spec.expression import ExpressionError, formula, inequalities, linear_form, real
    from pwatrack.spec.load import load_spec

FORMULAS = ("0.1*sin(2*pi*t) + exp(-t)*cos(3*t)", "((t+1)**20)**20", "2*z1 - z2/3 <= 0.1", "sqrt(2)/3e-5", "-k1/m1")
PARAMETERS = {"k1": 1.0, "m1": 2.0}
PLACE = Path(tempfile.mkdtemp()) / "spec.yaml"


def one(data: bytes) -> None:
    """Read one input: the first byte says as what."""
    text = data[1:]
    if not data or data[0] % 4:
        PLACE.write_bytes(text)
        try:
            load_spec(PLACE)
        except PwatrackError as refusal:
            if not all(problem.message for problem in refusal.problems):
                raise AssertionError("a refusal without words") from refusal
        return
    words = text.decode("utf-8", "replace")
    for read in (
        lambda: real(words, PARAMETERS),
        lambda: formula(words, PARAMETERS),
        lambda: linear_form(words, ["x1", "x2"], PARAMETERS),
        lambda: inequalities(words, ["x1", "x2"], PARAMETERS),
    ):
        with contextlib.suppress(ExpressionError):
            read()


def main() -> None:
    """Write the first inputs and run until the time is over."""
    seconds = sys.argv[1] if len(sys.argv) > 1 else "600"
    seeds = Path(tempfile.mkdtemp())
    for k, path in enumerate(sorted(Path("specs").rglob("*.yaml"))):
        (seeds / f"spec_{k}").write_bytes(b"\1" + path.read_bytes())
    for k, text in enumerate(FORMULAS):
        (seeds / f"formula_{k}").write_bytes(b"\0" + text.encode())
    options = [
        f"-max_total_time={seconds}",
        "-timeout=10",
        "-rss_limit_mb=2048",
        "-max_len=6000",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *options, str(seeds)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    warnings.simplefilter("error")
    main()
