"""Files that say more than is proved: made by changing genuine ones, and refused by the auditor, or by verify."""

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pwatrack import load_spec, simulate
from pwatrack.cli import app
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed
from pwatrack.lmi.audit.certificate import audit
from pwatrack.report.files import write_result
from tests.conftest import designed
from tests.scenarios import STOP, mass

WEIGHED = "{controller: {cost: {Q: [[1, 0], [0, 1]], R: [[0.3]]}}}"
NO_DICHOTOMY = """
name: cells with different numbers of unstable modes
system:
  states: [x, h]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, -1]]
  B: [[1], [0]]
  C: [[1, 0]]
  nonlinearities:
    - {name: bend, kind: spring, of: h, start: 0, slope: 3, into: {h: 1}}
reference: {output: "sin(t)"}
simulation: {duration: 2, sample_time: 0.1}
"""
BOX = mass(
    head="name: mass with limits\nparameters: {m: 2, k: 3}",
    A="[[0, 1], [-k/m, -1]]",
    B="[[0], [1/m]]",
    design="{uncertain: {m: 5%, k: 5%}}",
    simulation="{duration: 2, sample_time: 0.05, actuator: {limits: {u: [-20, 20]}}}",
)


@pytest.fixture(scope="module")
def cost(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = designed(tmp_path_factory.mktemp("cost"), mass(STOP, design=WEIGHED))
    return dict(json.loads((folder / "certificate.json").read_text()))


@pytest.fixture(scope="module")
def linear(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = designed(tmp_path_factory.mktemp("linear"), mass(design=WEIGHED))
    return dict(json.loads((folder / "certificate.json").read_text()))


@pytest.fixture(scope="module")
def refusal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refusal")
    (folder / "plant.yaml").write_text(NO_DICHOTOMY, encoding="utf-8")
    done = CliRunner().invoke(app, ["design", str(folder / "plant.yaml"), "--out", str(folder / "run")])
    assert done.exit_code == 4, done.output
    return folder / "run" / "refusal.json"


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("box") / "plant.yaml"
    path.write_text(BOX, encoding="utf-8")
    return write_result(simulate(load_spec(path)), path.parent / "run", plots="none")


def changed(content: dict[str, Any], change: Callable[[Any], Any]) -> list[str]:
    """Return the faults of a changed certificate that has none by itself."""
    assert audit(json.dumps(content))[1] == []
    content = copy.deepcopy(content)
    change(content)
    return audit(json.dumps(content))[1]


def test_a_refusal_with_the_key_of_a_proof_is_not_printed_as_one(refusal: Path, tmp_path: Path) -> None:
    content = json.loads(refusal.read_text())
    assert changed(content, lambda c: c["proofs"][0].update(bounded="both ways")) == ["'bounded' is no key in proofs.0"]
    file = tmp_path / "refusal.json"
    file.write_text(refusal.read_text())
    assert any("impossible" in said for said in verify(file, refusal.parents[1] / "plant.yaml"))
    content["proofs"][0]["bounded"] = "both ways"
    file.write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match="'bounded' is no key"):
        verify(file, refusal.parents[1] / "plant.yaml")


@pytest.mark.parametrize("key", ["X", "degree", "Z", "P", "between", "rate"])
def test_a_proof_with_a_key_of_another_claim_is_no_claim(refusal: Path, key: str) -> None:
    content = json.loads(refusal.read_text())
    found = changed(content, lambda c: c["proofs"][0].setdefault(key + "_" * (key in c["proofs"][0]), "0"))
    assert found
    assert "is no key in proofs.0" in found[0]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("name", ["Q", "X"])
def test_the_weights_of_a_cost_are_symmetric(linear: dict[str, Any], name: str, sign: int) -> None:
    """An elimination that reads the lower half alone takes a huge entry above the diagonal of either sign or of one."""
    proof = next(proof for proof in linear["proofs"] if "X" in proof)
    k = linear["proofs"].index(proof)
    assert changed(linear, lambda c: c["proofs"][k][name][0].__setitem__(1, str(sign * 10**6))) == [
        f"{name} is not symmetric"
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["figures"].__setitem__("robust_share_K", 0.99),
        lambda c: c["figures"].__setitem__("peak_gain", 0.01),
        lambda c: c["figures"].__setitem__("norm_K", c["figures"]["norm_K"] / 2),
        lambda c: c["limits"]["inputs"]["u"].__setitem__("left", 1e9),
        lambda c: c["limits"]["inputs"]["u"]["feedforward"].__setitem__("range", [0.0, 0.0]),
        lambda c: c["limits"]["starts"][0].__setitem__("scale", 1e6),
        lambda c: c["limits"]["starts"].pop(),
        lambda c: c["uncertain"]["parameters"].__setitem__("m", [0.1, 40.0]),
        lambda c: c["uncertain"].__setitem__("rate", 50.0),
        lambda c: c.__setitem__("verdict", "proved for all plants"),
        lambda c: c.__setitem__("promise", "no limit is ever reached"),
        lambda c: c.pop("limits"),
    ],
)
def test_a_run_that_tells_of_more_than_its_certificate_is_refused(
    box: Path, tmp_path: Path, change: Callable[[Any], Any]
) -> None:
    shutil.copytree(box, tmp_path / "run")
    assert any(said.startswith("run.json beside it tells the same") for said in verify(tmp_path / "run"))
    content = json.loads((tmp_path / "run" / "run.json").read_text())
    change(content)
    (tmp_path / "run" / "run.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match=r"run\.json"):
        verify(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("key", ["in_the_end", "at_worst"])
@pytest.mark.parametrize("k", [0, -1])
def test_bounds_that_are_smaller_than_proved_in_the_end_or_at_worst_are_refused(
    box: Path, tmp_path: Path, key: str, k: int
) -> None:
    shutil.copytree(box, tmp_path / "run")
    file = tmp_path / "run" / "bounds.json"
    content = json.loads(file.read_text())
    signal = next(iter(content["table"][k]["signals"].values()))
    signal[key] = signal[key] / 1e6
    file.write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match=r"table in bounds\.json"):
        verify(tmp_path / "run")


def test_verify_says_what_of_a_run_it_did_not_make_again(box: Path) -> None:
    (said,) = (sentence for sentence in verify(box) if sentence.startswith("run.json"))
    index = json.loads((box / "run.json").read_text())
    _, _, told = said.partition("but for what it alone tells: ")
    alone = told.split(", ")
    proved = {
        "name",
        "spec_sha256",
        "parameters",
        "verdict",
        "solver",
        "sizes",
        "figures",
        "limits",
        "uncertain",
        "limits_active",
    }
    assert {key for key in index if key not in alone} == proved
    assert {"figures.final_error", "figures.largest_input", "uncertain.along_x_d", "simulation"} <= {*alone}
    assert not {"figures.norm_K", "figures.robust_share_L", "uncertain.rate"} & {*alone}


@pytest.mark.parametrize(
    "name", ["m\nTheorem 2, state tracking: none of its inequalities is absent", "m\u2028", "\x1b[2J"]
)
def test_names_are_printed_on_one_line_or_not_at_all(box: Path, name: str) -> None:
    content = json.loads((box / "certificate.json").read_text())
    wrong = changed(content, lambda c: c["uncertain"]["parameters"][0].__setitem__(0, name))
    assert wrong == ["the certificate.uncertain.parameters.0.0 is no text on one line"]
    assert changed(content, lambda c: c["plant"]["cells"].__setitem__(0, name))
    assert all(map(str.isprintable, changed(content, lambda c: c.update({name: 1}))))


def test_a_box_is_one_of_parameters(box: Path) -> None:
    content = json.loads((box / "certificate.json").read_text())
    assert changed(content, lambda c: c["uncertain"]["parameters"].clear()) == [
        "uncertain parameters: none is named, and there are bounds for them"
    ]


@pytest.mark.parametrize("key", ["rate", "P", "format", "proofs"])
def test_a_key_that_is_there_twice_is_a_fault(cost: dict[str, Any], key: str) -> None:
    """The last of two counts for JSON's readers, the first for some others."""
    text = json.dumps(cost)
    value = json.dumps({"rate": "1000", "P": None, "format": cost["format"], "proofs": []}[key])
    forged = text.replace(f'"{key}": ', f'"{key}": {value}, "{key}": ', 1)
    assert audit(forged)[1] == [f"the key '{key}' is there twice"]


@pytest.mark.parametrize(
    ("where", "key"),
    [
        (lambda c: c, "note"),
        (lambda c: c["plant"], "signs"),
        (lambda c: c["plant"]["radius"], "H"),
        (lambda c: c["proofs"][0]["P"], "sign"),
        (lambda c: c["bounds"][0], "scale"),
        (lambda c: c["bounds"][0]["parts"][0], "peak"),
        (lambda c: c["generator"], "zeta"),
    ],
)
def test_an_object_has_its_keys_and_no_other(cost: dict[str, Any], where: Callable[[Any], Any], key: str) -> None:
    (found,) = changed(cost, lambda c: where(c).__setitem__(key, None))
    assert f"'{key}' is no key in" in found


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["bounds"].append(copy.deepcopy(c["bounds"][0])),
        lambda c: c["bounds"].reverse(),
        lambda c: c["bounds"][0]["signals"].append(c["bounds"][0]["signals"][0]),
        lambda c: c["bounds"][0]["parts"][0]["signals"].append(c["bounds"][0]["parts"][0]["signals"][0]),
        lambda c: c.update(spec_sha256="0" + c["spec_sha256"]),
        lambda c: c.update(spec_sha256="x" * 64),
        lambda c: c["plant"]["states"].append("w"),
        lambda c: c["plant"].update(inputs=[]),
        lambda c: c["generator"]["eta"].append("w"),
        lambda c: c["proofs"][0]["P"]["exponents"].append(0),
        lambda c: c["proofs"][0]["P"]["integers"][0].append(0),
        lambda c: c["K"].append(c["K"][0]),
        lambda c: c["proofs"][0].update(rate=c["proofs"][0]["rate"] + "0"),
        lambda c: c["plant"]["B"][0].__setitem__(0, "-0"),
        lambda c: c["plant"]["B"][1].__setitem__(0, "2/2"),
        lambda c: c["plant"]["B"][1].__setitem__(0, "1e0"),
    ],
)
def test_lists_have_their_lengths_and_numbers_one_form(cost: dict[str, Any], change: Callable[[Any], Any]) -> None:
    assert changed(cost, change)


@pytest.mark.slow
def test_elements_with_more_corners_than_are_worth_their_bytes_are_refused_with_a_figure(cost: dict[str, Any]) -> None:
    """2^14 matrices of order 14 are asked for in 8,000 bytes."""
    n = 14
    unit = [["1" if i == j else "0" for j in range(n)] for i in range(n)]
    one = {"breakpoints": ["0"], "slopes": ["0", "0.01"], "value": "0"}
    P = {"integers": [[int(i == j) for j in range(n)] for i in range(n)], "exponents": [0] * n}
    names = [f"x{k}" for k in range(n)]
    plant: dict[str, Any] = {"states": names, "inputs": ["u"], "outputs": ["y"], "tracked": ["y"], "loads": None}
    plant |= {"B": [["0"]] * n, "C": unit[:1], "tracked_rows": unit[:1], "b": [["0"]] * n}
    plant |= {"A": [["-1" if v == "1" else v for v in row] for row in unit]}
    plant |= {"radius": {"A": None, "b": None, "B": None, "C": None, "tracked_rows": None}}
    plant["elements"] = [
        {"row": unit[i], "direction": unit[(i + 1) % n], "constant": "0", "function": one, "segments": ["a", "b"]}
        for i in range(n)
    ]
    proofs = [{"of": of, "rate": "0.1", "margin": "0.1", "radius": "0", "P": P} for of in ("controller", "observer")]
    content = cost | {"tracking": "state", "plant": plant, "generator": None, "proofs": proofs, "bounds": []}
    (fault,) = audit(json.dumps(content | {"K": [["0"] * n], "L": [["0"]] * n}))[1]
    assert fault == "it takes more than 5e+06 steps, the most for a file of its size"
