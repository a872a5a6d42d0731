from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

from pwatrack import Result, load_spec, simulate
from pwatrack.batch.pool import Lost, Pool
from pwatrack.report.drawing import begin, prepare
from pwatrack.report.files import write_result


@pytest.fixture(scope="module")
def result(specs: Path) -> Result:
    return simulate(load_spec(specs / "gallery" / "kinked_tanks.yaml"))


@pytest.fixture(scope="module")
def alone(result: Result) -> dict[str, bytes]:
    """All pictures, drawn here."""
    return begin(result, None, None)()


def test_other_processes_draw_the_same_pictures_to_the_last_bit(result: Result, alone: dict[str, bytes]) -> None:
    with Pool(2) as pool:
        prepare(pool)
        shared = begin(result, None, pool)()
    assert shared == alone
    assert all(content.startswith(b"\x89PNG") for content in alone.values())


def test_what_others_do_not_draw_is_drawn_here(result: Result, alone: dict[str, bytes], tmp_path: Path) -> None:
    class Losing(Executor):
        def submit(self, *_: Any, **__: Any) -> "Future[Any]":
            future = Future[Any]()
            future.set_exception(Lost("killed by signal 9"))
            return future

    folder = write_result(result, tmp_path, executor=Losing())
    assert {file.name: file.read_bytes() for file in folder.glob("*.png")} == alone
