"""What was tried to break it, from the command line: it ends in an answer, a refusal with its limit, or a fault."""

import json
import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pwatrack import load_spec
from pwatrack.cli import app
from pwatrack.lmi import audit as auditor
from pwatrack.lmi.audit.certificate import audit

STATES = "  states: [z, v]\n  inputs: [u]\n  outputs: [y]\n  B: [[0], [1]]\n  C: [[1, 0]]\n"
LINEAR = "  A: [[0, 1], [-1, -1]]\n"
REST = 'reference: {output: "0.1*sin(t)"}\nsimulation: {duration: 3, sample_time: 0.1, initial: {plant: [0.2, 0]}}\n'
SCALAR = """\
name: scalar
system: {states: [x], inputs: [u], outputs: %s, A: %s, B: %s, C: %s}
design: {tracking: state}
reference: %s
simulation: {duration: 3, sample_time: 0.05, initial: {plant: [-0.8]}}
"""


def call(*arguments: object) -> tuple[int, str]:
    """Return the exit code and all that was said; nothing may look like a bug."""
    run = CliRunner().invoke(app, [str(a) for a in arguments])
    assert "Traceback" not in run.output
    assert "Warning" not in run.stderr
    return run.exit_code, " ".join((run.stdout + run.stderr).split())


def written(folder: Path, system: str, rest: str = REST, head: str = "name: mass\n") -> Path:
    path = folder / "mass.yaml"
    path.write_text(f"{head}system:\n{system}{rest}", encoding="utf-8")
    return path


def element(name: str, text: str) -> str:
    return f"    - {{name: {name}, {text}, into: {{v: -1}}}}\n"


def many_springs(k: int) -> str:
    """k states in a row, each held by a spring that is met at a distance."""
    A = [[int(j == i + 1) - int(j == i) for j in range(k)] for i in range(k)]
    states = ", ".join(f"z{i}" for i in range(k))
    springs = "".join(
        f"    - {{name: s{i}, kind: spring, of: z{i}, start: 0.{i + 1}, slope: 0.1, into: {{z{i}: -1}}}}\n"
        for i in range(k)
    )
    ends = [int(j == k - 1) for j in range(k)]
    return (
        f"  states: [{states}]\n  inputs: [u]\n  outputs: [y]\n"
        f"  A: {A}\n  B: {[[v] for v in ends]}\n  C: {[ends]}\n  nonlinearities:\n{springs}"
    )


def chain(cells: int) -> str:
    """Strips of width 1, each with one of two springs."""
    text, b = STATES + "  cells:\n", Fraction(0)
    for k in range(cells):
        slopes = [Fraction(-10 - (j % 2), 10) for j in (k - 1, k)]
        b += (slopes[0] - slopes[1]) * k * (k > 0)
        where = [f'"z >= {k}"'] * (k > 0) + [f'"z <= {k + 1}"'] * (k < cells - 1)
        text += f"    - {{name: c{k}, where: [{', '.join(where)}], A: [[0, 1], [{slopes[1]}, -1]], b: [0, {b}]}}\n"
    return text


MARKS = [k / 10 for k in range(200)]
MANY = {
    "strips": (chain(150), 150, 149),
    "springs": (many_springs(10), 2**10, 10 * 2**9),
    "breakpoints": (
        STATES
        + LINEAR
        + "  nonlinearities:\n"
        + element("e", f"kind: piecewise_linear, of: z, breakpoints: {MARKS}, slopes: {[k % 3 for k in range(201)]}"),
        201,
        200,
    ),
    "dead zones": (
        STATES
        + LINEAR
        + "  nonlinearities:\n"
        + "".join(
            element(f"d{k}", f"kind: dead_zone, of: z, lower: -{k + 1}/9, upper: {k + 1}/8, slope: 0.01")
            for k in range(25)
        ),
        51,
        50,
    ),
    "lines": (
        STATES
        + LINEAR
        + "  nonlinearities:\n"
        + "".join(
            element(f"s{k}", f"kind: spring, of: {k + 1}*z + v, start: {k * k}/40, slope: 0.001") for k in range(40)
        ),
        None,
        None,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", MANY)
def test_what_is_only_many_is_checked(tmp_path: Path, what: str) -> None:
    system, cells, facets = MANY[what]
    rest = REST.replace(", initial: {plant: [0.2, 0]}", "")
    run = CliRunner().invoke(app, ["check", str(written(tmp_path, system, rest)), "--json"])
    assert run.exit_code == 0, run.output
    found = json.loads(run.stdout)
    if cells is None:  # any two of the lines cross; where more meet, a cell less for each more
        crossings = {
            (Fraction(-(j * j - i * i), 40 * (i - j)), (Fraction(j * j, 40) * (i + 1) - Fraction(i * i, 40) * (j + 1)))
            for i in range(40)
            for j in range(i)
        }
        assert 1 + 40 + len(crossings) <= len(found["cells"]) <= 1 + 40 + 40 * 39 // 2
    else:
        assert (len(found["cells"]), len(found["facets"])) == (cells, facets)


@pytest.mark.slow
def test_ten_thousand_parameters_and_thirty_thousand_unknown_keys_are_read(tmp_path: Path) -> None:
    parameters = "".join(f"  p{k}: {k}*0.5\n" for k in range(10_000))
    head = f"name: mass\nparameters:\n{parameters}"
    assert call("check", written(tmp_path, STATES + LINEAR, head=head))[0] == 0
    code, said = call("check", written(tmp_path, STATES + LINEAR, REST + "".join(f"k{j}: 1\n" for j in range(30_000))))
    assert (code, "… and 29,980 more" in said) == (2, True)


@pytest.mark.parametrize(
    ("system", "rest", "words"),
    [
        (STATES.replace("[z, v]", f"[{', '.join(['z'] * 20_000)}]") + LINEAR, REST, "20,000 entries, at most 200"),
        (STATES.replace("[z, v]", f"[{', '.join(f'z{k}' for k in range(300))}]") + LINEAR, REST, "300 entries, at m"),
        (
            STATES + "  hyperplanes: [{H: [1e-300, 0], h: 0}]\n"
            "  cells: [{name: a, signs: [-1], A: [[0, 1], [-1, -1]]}, {name: b, signs: [1], A: [[0, 1], [-1, -1]]}]\n",
            REST,
            "1e-300 is smaller than 1e-60 but not 0",
        ),
        (STATES + LINEAR, REST + "tolerance: {continuity: 10}\n", "at most 0.01 is accepted"),
        (STATES + LINEAR, REST + "tolerance: {continuity: 1e60}\n", "at most 0.01 is accepted"),
        (
            STATES + LINEAR,
            REST.replace("duration: 3, sample_time: 0.1", "duration: 1e18, sample_time: 1e17"),
            "too fast for 1e+18 s",
        ),
    ],
    ids=["states twice", "states", "normal", "tolerance", "any tolerance", "duration"],
)
def test_what_is_too_large_or_too_fine_is_refused_with_the_limit(
    tmp_path: Path, system: str, rest: str, words: str
) -> None:
    code, said = call("simulate", written(tmp_path, system, rest), "--out", tmp_path / "out")
    assert (code, words in said) == (2, True), said
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outputs", "A", "B", "C", "reference", "code"),
    [
        ("[y]", "[[-1]]", "[[0]]", "[[1]]", "{input: ['0.3*sin(t)'], start: periodic}", 0),
        ("[y]", "[[-1]]", "[[1]]", "[[0]]", "{input: ['0.3*sin(t)'], start: periodic}", 0),
        ("[y]", "[[-1]]", "[[0]]", "[[0]]", "{input: ['0.3*sin(t)'], start: [0.1]}", 0),
        ("[y]", "[[1]]", "[[0]]", "[[1]]", "{setpoint: {y: 0}}", 4),
        ("[y]", "[[1]]", "[[1]]", "[[0]]", "{setpoint: {y: 0}}", 4),
        ("[y, w]", "[[0]]", "[[1]]", "[[0], [1]]", "{setpoint: {y: 1, w: 1}}", 3),
        ("[y, w]", "[[0]]", "[[2.18]]", "[[0], [-0.0023]]", "{setpoint: {y: -0.7, w: 0.72}}", 3),
        ("[y, w]", "[[0]]", "[[2.18]]", "[[0], [-0.0023]]", "{setpoint: {y: 0, w: 0.72}}", 0),
        ("[y]", "[[-1]]", "[[1e-308]]", "[[1]]", "{setpoint: {y: 0}}", 2),
        ("[y]", "[[-1]]", "[[1]]", "[[5e-324]]", "{setpoint: {y: 0}}", 2),
        ("[y]", "[[-1e-308]]", "[[1]]", "[[1]]", "{setpoint: {y: 0}}", 2),
        ("[y]", "[[-1e-50]]", "[[1e-50]]", "[[1e-50]]", "{setpoint: {y: 0}}", 0),
        ("[y]", "[[-1e50]]", "[[1e50]]", "[[1e50]]", "{setpoint: {y: 0}}", 2),
    ],
)
def test_inputs_and_outputs_that_do_nothing_or_almost_nothing_end_in_a_verdict_that_is_verified(
    tmp_path: Path, outputs: str, A: str, B: str, C: str, reference: str, code: int
) -> None:
    path = tmp_path / "scalar.yaml"
    path.write_text(SCALAR % (outputs, A, B, C, reference))
    found, said = call("simulate", path, "--out", tmp_path / "out")
    assert found == code, said
    if code in (0, 4):
        assert call("verify", tmp_path / "out")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("slope", ["1e6", "1e9"])
def test_a_stop_as_stiff_as_it_may_be_is_simulated(tmp_path: Path, slope: str) -> None:
    stop = "  nonlinearities:\n" + element("s", f"kind: spring, of: z, start: 0.05, slope: {slope}")
    code, said = call("simulate", written(tmp_path, STATES + LINEAR + stop), "--out", tmp_path / "out")
    assert (code, ": tracks, largest error" in said) == (0, True), said


SPRING = "  nonlinearities:\n    - {name: s, kind: spring, of: z, start: 0.05, slope: k, into: {v: -1}}\n"


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a spec and its run, `set` with k = 0.3."""
    folder = tmp_path_factory.mktemp("proved")
    written(folder, STATES + LINEAR + SPRING, head="name: mass\nparameters: {k: 0.1}\n")
    assert call("design", folder / "mass.yaml", "--out", folder / "run")[0] == 0
    assert call("design", folder / "mass.yaml", "--set", "k=0.3", "--out", folder / "set")[0] == 0
    return folder


def test_verify_says_which_parameters_were_set_and_a_certificate_without_them_is_not_the_spec(
    proved: Path, tmp_path: Path
) -> None:
    code, said = call("verify", proved / "set")
    assert (code, "spec.txt with k = 0.3: same plant, gains and goals" in said) == (0, True)
    content = json.loads((proved / "set" / "certificate.json").read_text())
    (tmp_path / "certificate.json").write_text(json.dumps(content | {"set": {}}))
    code, said = call("verify", tmp_path / "certificate.json", "--spec", proved / "mass.yaml")
    assert (code, "plant is not that of" in said) == (6, True)


def test_verify_in_another_place_says_that_it_was_not_compared_with_a_spec(
    proved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(proved)
    assert call("design", "mass.yaml", "--out", "near")[0] == 0
    code, said = call("verify", "near")
    assert (code, "it belongs to near/spec.txt: same plant, gains and goals" in said) == (0, True)
    monkeypatch.chdir(tmp_path)
    near = (proved / "near").rename(tmp_path / "near")
    code, said = call("verify", near)  # the folder keeps its spec
    assert (code, "same plant, gains and goals" in said) == (0, True)
    (near / "spec.txt").unlink()
    code, said = call("verify", near)
    assert (code, "not compared with a spec: none is at hand; name it with --spec" in said) == (0, True)
    code, said = call("verify", near, "--spec", proved / "mass.yaml")
    assert (code, "same plant, gains and goals" in said) == (0, True)
    written(tmp_path, STATES + LINEAR)  # another one of the name
    code, said = call("verify", near)
    assert (code, "has other bytes than the spec it was made for" in said) == (6, True)


def test_a_refusal_of_other_gains_is_not_one_of_the_spec_whose_digest_it_has(proved: Path, tmp_path: Path) -> None:
    given = "design: {controller: {K: [[9, 9]]}, observer: {L: [[-3], [-1]]}}\n"
    path = written(tmp_path, STATES + LINEAR + SPRING, REST + given, head="name: mass\nparameters: {k: 0.1}\n")
    assert call("design", path, "--out", tmp_path / "out")[0] == 4
    assert call("verify", tmp_path / "out")[0] == 0
    digest = json.loads((proved / "run" / "certificate.json").read_text())["spec_sha256"]
    refusal = json.loads((tmp_path / "out" / "refusal.json").read_text())
    (tmp_path / "refusal.json").write_text(json.dumps(refusal | {"spec_sha256": digest}))
    code, said = call("verify", tmp_path / "refusal.json", "--spec", proved / "mass.yaml")
    assert (code, "K is not the one that" in said) == (6, True), said


def test_a_fifo_is_no_certificate_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "certificate.json")
    code, said = call("verify", tmp_path / "certificate.json")
    assert (code, "is no regular file" in said) == (2, True)


@pytest.mark.parametrize(
    "change",
    [
        *({"": key} for key in ("plant", "generator", "K", "L", "proofs", "bounds", "tracking", "set", "spec_sha256")),
        *({"plant": key} for key in ("elements", "A", "b", "radius")),
        *({"proofs": key} for key in ("of", "rate", "P", "margin")),
        {"rate": "as text"},
        {"A_eta": [[]]},
    ],
    ids=str,
)
def test_a_certificate_that_lacks_a_part_is_refused_in_words_by_both(
    proved: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    content = json.loads((proved / "run" / "certificate.json").read_text())
    ((where, key),) = change.items()
    if where == "rate":
        content["proofs"][0]["rate"] = key
    elif where == "A_eta":
        empty = {"of": "generator", "rate": "1", "margin": "1", "radius": "0", "P": {"integers": [], "exponents": []}}
        content |= {"generator": {"T": [], "internal": [], "A_eta": key}, "proofs": [empty]}
    else:
        home = {"": content, "plant": content["plant"], "proofs": content["proofs"][0]}[where]
        del home[key]
    file = tmp_path / "certificate.json"
    file.write_text(json.dumps(content))
    code, said = call("verify", file)
    assert code == 6, said
    assert f"error: {file}: " in said
    if key not in ("set", "spec_sha256", "bounds"):  # which only say whose it is, and what else is claimed
        assert audit(file.read_text())[1] != []


def test_the_auditor_alone_says_what_is_proved_and_what_a_refusal_refuses(proved: Path, tmp_path: Path) -> None:
    def audited(path: Path) -> tuple[int, str]:
        call_ = [sys.executable, "-I", "-S", auditor.__path__[0], str(path)]
        done = subprocess.run(call_, capture_output=True, text=True, check=False, cwd=tmp_path)
        assert not done.stderr
        return done.returncode, done.stdout

    code, said = audited(proved / "run" / "certificate.json")
    assert code == 0
    wanted = ("2 cells cover", "(8) controller: proved, rate", "(9) observer: proved, rate", "Theorem 3, output")
    assert all(words in said for words in wanted), said
    given = "design: {controller: {K: [[9, 9]]}}\n"
    path = written(tmp_path, STATES + LINEAR + SPRING, REST + given, head="name: mass\nparameters: {k: 0.1}\n")
    assert call("design", path, "--out", tmp_path / "out")[0] == 4
    code, said = audited(tmp_path / "out" / "refusal.json")
    assert (code, "(8) controller: " in said, "impossible" in said, "observer" in said) == (0, True, True, False)
    (tmp_path / "short.json").write_text(
        json.dumps({"format": "pwatrack certificate 8", "claim": "", "proofs": [], "K": [["0"]], "L": [["0"]]})
    )
    code, said = audited(tmp_path / "short.json")
    assert (code, said.startswith("wrong: "), "proved" in said) == (6, True, False)


def test_a_plant_changed_by_less_than_the_gains_may_change_is_off_and_the_promise_is_about_the_other(
    tmp_path: Path,
) -> None:
    """The observer does not know of the change: what is proved is about gains, and the summary says so."""
    path = tmp_path / "one.yaml"
    path.write_text(
        """\
name: one state
parameters: {a: -1}
system:
  states: [x]
  inputs: [u]
  outputs: [y]
  B: [[1]]
  C: [[1]]
  cells:
    - {name: low, where: ["x <= 0"], A: [[a]]}
    - {name: high, where: ["x >= 0"], A: [[2*a]]}
design: {tracking: state}
reference: {state: ["sin(t)"]}
simulation: {duration: 30, sample_time: 0.05, plant: {parameters: {a: -1.06}}}
""",
        encoding="utf-8",
    )
    code, said = call("simulate", path, "--verbose", "--out", tmp_path / "out")
    assert code == 0
    first, _, rest = said.partition("(8) controller")
    assert "off: |x − x_d| up to" in first
    assert "are about the loop without: other a = -1.06" in first
    assert "with K and L changed in every entry by less than" in rest
    assert "the plant as designed" in rest


def test_the_certificate_has_the_numbers_of_the_spec(tmp_path: Path) -> None:
    """0.1 + 0.2 is 3/10 there, and the double that is simulated the one next to 0.3."""
    head = "name: mass\nparameters: {d1: 0.1, d2: 0.2}\n"
    path = written(tmp_path, STATES + "  A: [[0, 1], [-1/3, -(d1 + d2)]]\n", head=head)
    assert call("design", path, "--out", tmp_path / "out")[0] == 0
    plant = json.loads((tmp_path / "out" / "certificate.json").read_text())["plant"]
    assert [Fraction(v) for v in plant["A"][0][1]] == [Fraction(-1, 3), Fraction(-3, 10)]
    assert load_spec(path).problem.plant.A[0, 1].tolist() == [-1 / 3, -0.3]  # and -(0.1 + 0.2) is another double
