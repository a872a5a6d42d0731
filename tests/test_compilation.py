"""Whoever waits for the compiler is told so, once, and only where something is compiled."""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pwatrack.compilation import while_compiling
from pwatrack.workflow import pipeline
from tests.test_cli import call
from tests.test_kept_spec import SINE, cart

MODULE = """
from numba import njit

@njit
def inner(x):
    return x + 1

@njit(cache=CACHE)
def outer(x):
    return inner(x) * 2
"""


class AtOnce:
    """A timer that does not wait."""

    def __init__(self, _: float, function: Callable[..., object], arguments: tuple[object, ...]) -> None:
        self.function, self.arguments = function, arguments

    def start(self) -> None:
        self.function(*self.arguments)

    def cancel(self) -> None:
        pass


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    importlib.import_module("pwatrack.simulation.kernel")  # it listens from then on
    monkeypatch.setattr("threading.Timer", AtOnce)


def fresh(folder: Path, *, cache: bool = False) -> Any:
    """Return a function that is not compiled yet, or is found on disk."""
    (folder / "made.py").write_text(MODULE.replace("CACHE", str(cache)), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("made", folder / "made.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.outer


def test_it_is_told_once_and_not_where_nothing_is_compiled(tmp_path: Path) -> None:
    said: list[bool] = []
    outer = fresh(tmp_path)
    with while_compiling(said.append):
        assert outer(1) == 4
        assert outer(1.5) == 5  # compiled for another type
    assert said == [False]
    with while_compiling(said.append):
        assert outer(2) == 6
    assert said == [False]
    assert fresh(tmp_path)(1) == 4
    assert said == [False], "nobody waits"


def test_what_is_kept_on_disk_is_compiled_once(tmp_path: Path) -> None:
    said: list[bool] = []
    for _ in range(2):
        with while_compiling(said.append):
            assert fresh(tmp_path, cache=True)(1) == 4
    assert said == [True]


def test_a_compiler_that_is_quick_needs_no_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AtOnce, "start", lambda _: None)
    said: list[bool] = []
    with while_compiling(said.append):
        fresh(tmp_path)(1)
    assert said == []


def test_a_signal_that_the_compiler_lost_ends_the_program_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a handler raises in the middle of a callback is lost; what came is remembered."""
    monkeypatch.setattr("pwatrack.compilation.ended_by", lambda: 143)
    with pytest.raises(SystemExit) as ended:
        fresh(tmp_path)(1)
    assert ended.value.code == 143


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--verbose",), ("--quiet",), ("--json",), ("--format", "json")])
def test_the_command_line_says_it_on_stderr_to_people_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...]
) -> None:
    def slow(*arguments: Any, **named: Any) -> Any:
        fresh(tmp_path)(1)
        return simulated(*arguments, **named)

    simulated = pipeline.simulate
    monkeypatch.setattr(pipeline, "simulate", slow)
    (tmp_path / "cart.yaml").write_text(cart(SINE), encoding="utf-8")
    before, after = (options, ()) if "--format" in options else ((), options)
    done = call(*before, "simulate", tmp_path / "cart.yaml", "--out", tmp_path / "run", "--plots", "none", *after)
    assert done.exit_code == 0, done.output
    assert done.stderr.count("Compiling the simulation, ") == (not options or options == ("--verbose",))
    assert "Compiling" not in done.stdout


LEFT = """
from typing import NamedTuple

import numpy as np
from pwatrack.simulation.kernel import jitted

class NAME(NamedTuple):
    a: np.ndarray

def outer(x):
    return x.a[0] * FACTOR

outer, made = jitted(outer), NAME(np.ones(1))
"""


def test_what_an_earlier_version_left_on_disk_is_compiled_again(tmp_path: Path) -> None:
    """It names a type that is not there any more, for a function of the same name in the same line."""
    found = []
    for name, factor in (("Former", "2.0"), ("Latter", "33.0")):
        (tmp_path / "left.py").write_text(LEFT.replace("NAME", name).replace("FACTOR", factor), encoding="utf-8")
        spec = importlib.util.spec_from_file_location("left", tmp_path / "left.py")
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules["left"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found.append(module.outer(module.made))
    del sys.modules["left"]
    assert found == [2.0, 33.0]
