"""Whoever waits for futures can be interrupted at any moment, and those that work for them can still end them."""

import gc
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from pwatrack.interruption import as_ended, in_order, uninterrupted


def wait_for_ever(futures: list[Future[None]], delay: float) -> None:
    """Wait again and again, one of the futures being done, and be interrupted.

    Once more after a second, if need be: an interruption in the moment in which a generator is thrown away is lost.
    """
    ended = threading.Event()

    def interrupt() -> None:
        time.sleep(delay)
        os.kill(os.getpid(), signal.SIGINT)
        while not ended.wait(1.0):
            os.kill(os.getpid(), signal.SIGINT)

    try:
        threading.Thread(target=interrupt).start()
        while True:
            assert next(as_ended(futures)) is futures[0]
    finally:
        ended.set()


@pytest.fixture
def without_collection() -> Iterator[None]:
    """Others' callbacks of the garbage collector, as Hypothesis has one, lose an interruption that comes in them."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.slow
@pytest.mark.usefixtures("without_collection")
def test_no_future_stays_locked_wherever_the_wait_is_interrupted() -> None:
    draw = np.random.default_rng(1)
    for _ in range(300):
        futures = [Future[None]() for _ in range(4)]
        futures[0].set_result(None)
        with pytest.raises(KeyboardInterrupt):
            wait_for_ever(futures, draw.exponential(1e-3))

        def end(futures: list[Future[None]] = futures) -> None:
            for future in futures[1:]:
                future.set_result(None)

        worker = threading.Thread(target=end, daemon=True)
        worker.start()
        worker.join(20)
        assert not worker.is_alive()


def test_futures_come_as_they_end_or_in_order() -> None:
    futures = [Future[int]() for _ in range(3)]
    came = as_ended(futures)
    for k in (2, 0, 1):
        futures[k].set_result(k)
        assert next(came) is futures[k]
    assert list(came) == []
    assert list(in_order(futures)) == futures


def test_an_interruption_is_put_off_to_the_end_of_the_block_and_told_at_once() -> None:
    done = list[str]()

    def interrupted() -> None:
        with uninterrupted(lambda: done.append("told")):
            signal.raise_signal(signal.SIGINT)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert done == ["told", "whole"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


ENDED = """
import os, signal, time
from pwatrack.interruption import listen
from pwatrack.report.terminal import refusals
listen()
with refusals():
    try:
        os.kill(os.getpid(), signal.NUMBER)
        time.sleep(10)
    finally:
        raise ValueError("made of it")
"""


@pytest.mark.parametrize(("number", "code"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_whatever_is_made_of_an_interruption_is_no_bug(number: str, code: int) -> None:
    """What runs when a signal comes, such as the compiler of the simulation, may raise an error of its own."""
    command = [sys.executable, "-c", ENDED.replace("NUMBER", number)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (code, "", "")


@pytest.mark.slow
def test_on_a_terminal_a_step_that_takes_long_says_how_long(specs: Path, tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "pwatrack", "design", str(specs / "two_mass_machine.yaml"), "--out", str(tmp_path)]
    said, environment = b"", {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs, env=environment) as running:
        os.close(theirs)
        with suppress(OSError):  # as it ends
            while not re.search(rb"Finding gains, proofs and bounds: [1-9]\d* programs, \d+ s", said):
                said += os.read(ours, 1000)
            running.send_signal(signal.SIGTERM)
    os.close(ours)
    assert re.search(rb"bounds: [1-9]\d* programs, \d+ s", said), said[-500:]
