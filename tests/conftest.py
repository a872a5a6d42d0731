import hashlib
import os
import pickle
import random
import re
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from hypothesis import settings

from pwatrack import Result, Spec, design, load_spec, simulate
from pwatrack.report.files import write_design

settings.register_profile("here", deadline=None)  # how long an example takes is the machine's affair
settings.register_profile("ci", deadline=None, derandomize=True)  # the same examples every time; fresh ones elsewhere
settings.load_profile("ci" if os.environ.get("CI") else "here")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background: tests interrupt themselves
    signal.signal(signal.SIGINT, signal.default_int_handler)

MADE = "PWATRACK_MADE"  # the folder of what tests share
Made = TypeVar("Made")
SPECS = Path(__file__).parent.parent / "specs"


NUMERICAL = re.compile(  # what rounding might decide: `make test-kernels` runs these with other kernels than ours
    "test_(between|events|exact|generator|goals|lmi|paper_example|peak|polynomial|preview|simulation|state_tracking|"
    "taylor|tracked)[.]py"
)
LONGEST = re.compile(  # begun last, one of these would keep one worker busy when the others are done
    "test_(sampled_|export_|demand|gallery|claims|crossings|rounding|within_limits|cli|enclosed_runs|ranges|drawing|"
    "docs|dist|cluster)"
)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):  # what is made once is made for all workers, which inherit this
        os.environ[MADE] = tempfile.mkdtemp(prefix="pwatrack-")


def pytest_unconfigure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop(MADE), ignore_errors=True)


def once(make: Callable[[], Made], *key: object) -> Made:
    """Return what is made, or what another worker made of the same key."""
    kept = Path(os.environ[MADE]) / hashlib.sha256(repr(key).encode()).hexdigest()
    if not kept.exists():
        new = kept.with_suffix(f".{os.getpid()}")
        new.write_bytes(pickle.dumps(make()))
        new.replace(kept)
    made: Made = pickle.loads(kept.read_bytes())
    return made


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="files in random order, and the tests of each")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    files = dict[Path, list[pytest.Item]]()
    for item in items:
        files.setdefault(item.path, []).append(item)
    long = {path: sum(item.get_closest_marker("slow") is not None for item in each) for path, each in files.items()}
    # a file goes to one worker, in this order: those that take a minute or more first, whose tests may be few
    items.sort(key=lambda item: (LONGEST.search(item.path.name) is None, -long[item.path], -len(files[item.path])))
    seed = config.getoption("--shuffle", default=None)
    if seed is not None:
        order = random.Random(seed)
        items[:] = [
            item for file in order.sample(list(files.values()), len(files)) for item in order.sample(file, len(file))
        ]


def designed(folder: Path, text: str) -> Path:
    """Return the run folder of a design, with its spec beside it."""
    spec_file = folder / "plant.yaml"
    spec_file.write_text(text, encoding="utf-8")
    spec = load_spec(spec_file)
    return write_design(spec, design(spec), folder / "run")


@pytest.fixture(scope="session")
def specs() -> Path:
    return SPECS


@pytest.fixture(scope="session")
def paper_spec() -> Spec:
    return load_spec(SPECS / "two_mass_paper_gains.yaml")


@pytest.fixture(scope="session")
def paper(paper_spec: Spec) -> Result:
    """The example of Section V with the gains of the paper; printed, both have the opposite sign."""
    return simulate(paper_spec)
