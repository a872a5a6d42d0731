"""Nothing is printed that has no entry in docs/claims.md."""

import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pwatrack import ensemble, load_spec, simulate
from pwatrack.commands.verify import verify
from pwatrack.control.applicability import applicability
from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.report import summary, terminal
from pwatrack.report.check import can_be_designed, plant_rows
from pwatrack.report.files import write_result
from pwatrack.report.parameters import run_rows
from pwatrack.report.plant import print_plant
from pwatrack.report.screen import Findings, first_rows
from pwatrack.workflow.cautions import plant_questions
from pwatrack.workflow.pipeline import design
from pwatrack.workflow.simplified import checked as known
from pwatrack.workflow.sizing import spec_sizes
from tests import test_sampled_box, test_sampled_region
from tests.test_cli import call
from tests.test_demand import TOLD
from tests.test_outcome import ROD, RUNAWAY, cart
from tests.test_screen import stage

ROWS = re.compile(r"^\| ([^|]*) \| `(.+?)` \|", re.MULTILINE)
Row = tuple[bool, str, str]  # whether verify says it, label, sentence

EXTRA = {
    "state": "design: {tracking: state}\nreference: {state: ['0.1*sin(t)', '0.1*cos(t)']}\n"
    "require: {ensemble: {final_error: 9}}",
    "setpoint": "design: {tracking: state}\nreference: {setpoint: {y: 0.05}}",
    "input": "design: {tracking: state}\nreference: {input: ['0.1*sin(t)'], start: periodic}",
    "response": "design: {tracking: state}\nreference: {input: ['0.1*sin(t)'], start: [0, 0]}",
    "late": "reference: {output: 0.1*sin(t)}",
    "cost": "design: {controller: {cost: {Q: [[1, 0], [0, 1]], R: [[1]]}}}\nreference: {output: 0.1*sin(t)}",
    "required": "reference: {output: {constant: 0.01}}\nrequire: {rate: 99, norm_K: 1e-9, norm_L: 1e9, overshoot: 99}",
    "kept": "reference: {output: 0.1*sin(t)}\nrequire: {limits: {y: [-1, 0.9], v: [-9, .inf]}}",
    "disturbed": "reference: {output: 0.1*sin(t)}\nrequire: {limits: {z: [-0.9, 0.9], v: [-0.11, 0.11]}}",
    "whole": "reference: {output: 0.1*sin(t)}\nrequire: {limits: {y: [-0.1, 9]}}",
    "loads": "design: {estimate: {push: {into: {v: 1}}, hum: {into: {v: 1}, frequency: 3}}}\nreference: {output: 0.1}",
    "uncertain": "parameters: {m: 1}\ndesign: {uncertain: {m: 5%}}\nreference: {output: 0.1*sin(t)}\n",
    "polynomials": "design: {controller: {K: [[0, 0]]}, observer: {L: [[0], [0]]}}\nreference: {output: 0.1*sin(t)}",
    "rounded": "tolerance: {continuity: 1e-3}\nreference: {output: 0.1*sin(t)}",
}

WHOLE = {  # plants of one cell: what acts is over before the first input, members start with other η̂, limits used up
    "waiting": """
system: {states: [x], inputs: [u], outputs: [y], A: [[-1]], B: [[1]], C: [[1]]}
reference: {output: {constant: 0}}
simulation:
  {duration: 4, sample_time: 0.01, controller: {sample_time: 0.1, delay: 2},
   disturbance: {x: {constant: 5, step: {size: -5, at: 0.15}}}}
""",
    "beside": """
system: {states: [x, z], inputs: [u], outputs: [y], A: [[-1, 1], [1, -3]], B: [[1], [0]], C: [[1, 0]]}
reference: {output: {sine: {amplitude: 0.1, frequency: 1}}}
simulation:
  {duration: 4, sample_time: 0.01, controller: {sample_time: 0.1, delay: 1}, initial: {generator: [0]},
   ensemble: {initial: {generator: [[-0.1, 0.1]]}}}
""",
    "single": """
system: {states: [z, v], inputs: [u], outputs: [y], A: [[0, 1], [-1, -1]], B: [[0], [1]], C: [[1, 0]]}
design: {tracking: state, observer: {cost: {Q: [[1, 0], [0, 1]], R: [[1]]}}}
reference: {setpoint: {y: 0.05}}
simulation: {duration: 10, sample_time: 0.1, actuator: {limits: {u: [-9, 0.05]}}, controller: {sample_time: 0.01}}
""",
    "pair": """
system:
  states: [a, v, b, w]
  inputs: [f, g]
  outputs: [y, z]
  A: [[0, 1, 0, 0], [-1, -1, 0, 0], [0, 0, 0, 1], [0, 0, -1, -1]]
  B: [[0, 0], [1, 0], [0, 0], [0, 1]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
reference: {output: {y: 0.1, z: 0.2}}
simulation: {duration: 10, sample_time: 0.1, actuator: {limits: {f: [-9, 0.1], g: [-9, 0.2]}}}
""",
    "resting": """
system: {states: [x], inputs: [u], outputs: [y], A: [[-1]], B: [[1]], C: [[1]]}
reference: {output: {constant: 1}}
simulation: {duration: 10, sample_time: 0.1, initial: {plant: steady}}
""",
    "far": """
system: {states: [x], inputs: [u], outputs: [y], A: [[-1]], B: [[1]], C: [[1]]}
design: {controller: {K: [[-0.01]]}}
reference: {output: {constant: 1}}
simulation:
  {duration: 2, sample_time: 0.1, initial: {plant: [1], observer: steady}, ensemble: {initial: {plant: {x: [2, 5]}}}}
""",
}


@pytest.fixture(scope="module")
def entries(specs: Path) -> list[tuple[bool, str, re.Pattern[str]]]:
    """Return the rows of the tables; those of verify are wide, and speak for what verify says only."""
    text = (specs.parent / "docs" / "claims.md").read_text(encoding="utf-8").replace("\\|", "¦")
    sections = [(part.startswith("verify\n"), part) for part in re.split(r"(?m)^## ", text)]
    found = [(own, label, sentence) for own, part in sections for label, sentence in ROWS.findall(part)]
    return [
        (own, code.strip(), re.compile(re.escape(each.replace("¦", "|")).replace("…", ".*")))
        for own, label, sentences in found
        if label.strip() != "code"
        for code in (label.split(",") if label[:1].isdigit() else [label])
        for each in re.split("`, `", sentences)
    ]


def printed(specs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Row]:
    """Yield every row of every table that is printed for some plants, and every sentence of verify."""
    rows: list[Row] = []

    class Recorded(terminal.Table):  # type: ignore[misc, name-defined]
        def add_row(self, *texts: Any, **options: Any) -> None:
            if len(texts) == 2:  # not the figures of an ensemble
                rows.append((False, str(texts[0]), str(texts[1])))
            super().add_row(*texts, **options)

    monkeypatch.setattr(terminal, "Table", Recorded)
    console = Console(file=io.StringIO(), width=200)
    for values in ({"sign": "1"}, {"d": "0"}):
        odd = load_spec(stage(tmp_path), values).problem.plant
        rows += [(False, "question", text) for text in plant_questions(odd)]
    for path in plants(specs, tmp_path):
        spec = load_spec(path)
        sizes, tracking = spec_sizes(spec), spec.problem.tracking
        report = applicability(spec.problem.plant, tracking=tracking, sizes=sizes)
        try:
            reference, _ = known(spec, report)
        except PwatrackError as error:
            reference = str(error)
        print_plant(console, spec.name, report, reference, sizes)
        rows += [(False, label, text) for label, text in plant_rows(report, spec.name)]
        rows += [(False, "check", can_be_designed(report, "", refused=refused)) for refused in (False, True)]
        controller = design(spec, growing=True)
        result = simulate(spec, controller)
        summary.print_all(console, Findings(spec=spec, controller=controller))
        found = Findings(spec=spec, controller=controller, result=result)
        summary.print_all(console, found)
        rows += [(False, label, text) for label, text in first_rows(found)]
        rows += [(False, "uncertain", said) for said in run_rows(replace(result, w=None))]  # as if that took too long
        if path.stem in ("state", "cart", "far"):
            many = ensemble(result, 3)
            summary.print_ensemble(console, many)
            rows += [(False, label, text) for label, text in first_rows(replace(found, many=many))]
        for sentence in verify(write_result(result, tmp_path / "run", plots="none"), path):
            label, _, rest = sentence.partition(": ")
            own = label.startswith(("(", "plant", "Theorem"))
            rows.append((True, label, rest) if own else (True, "verify", sentence))
    yield from dict.fromkeys(rows)


def refusals(specs: Path, tmp_path: Path) -> Iterator[Row]:
    """Yield every line that says of a plant that it is refused, and how far it is from one that is not."""
    for path in sorted((specs / "refused").glob("*.yaml")):
        run = call("design", path, "--out", tmp_path / "run")
        if run.exit_code != ExitCode.INVALID:
            for line in run.stderr.splitlines():
                if found := re.match(r"error: (?:\S+\.yaml(?::\d+)*: )?(.*) \[P\d+\]$|  (how far: .*)", line):
                    yield False, str(run.exit_code), found[1] or found[2]


def plants(specs: Path, tmp_path: Path) -> Iterator[Path]:
    for name in (
        "two_mass_goals",
        "gallery/two_mass_stiff_springs",
        "gallery/robust_positioning",
        "gallery/three_tanks_pumps",
        "gallery/kinked_tanks",
        "gallery/cart_and_pole_on_the_move",
        "gallery/gear_with_backlash",
        "gallery/carriage_on_slack_rope",
    ):
        yield specs / f"{name}.yaml"
    text = (specs / "gallery" / "gear_with_backlash.yaml").read_text(encoding="utf-8")
    (tmp_path / "gear.yaml").write_text(text.replace("simulation: {", "simulation: {controller: {sample_time: 3e-3}, "))
    yield tmp_path / "gear.yaml"
    (tmp_path / "rod.yaml").write_text(ROD)
    yield tmp_path / "rod.yaml"
    yield cart(tmp_path, RUNAWAY["other parameters"], reference="0.08*cos(t)")
    for name, text in WHOLE.items():
        path = tmp_path / f"{name}.yaml"
        path.write_text(f"name: {name}\n{text}")
        yield path
    for name in ("pole", "leaning", "idle"):
        (tmp_path / name).mkdir()
    noise = "noise: {std: {y: 1e-3}, sample_time: 0.02, seed: 1}"
    yield test_sampled_region.written(tmp_path / "pole", also=noise)
    yield test_sampled_region.leaning(tmp_path / "leaning")
    yield test_sampled_region.leaning(tmp_path / "idle", test_sampled_region.KEPT)
    (tmp_path / "table").mkdir()
    yield test_sampled_box.written(tmp_path / "table", more="plant: {parameters: {m: 2.1}}")
    for name, told in TOLD.items():
        (tmp_path / f"{name}.yaml").write_text(json.dumps(told()))
        yield tmp_path / f"{name}.yaml"
    for name, wishes in EXTRA.items():
        slope = "1.001" if name == "rounded" else "1"
        push = "1/m" if name == "uncertain" else "1"
        damping = "0.3" if name == "polynomials" else "1"
        limits = "actuator: {limits: {u: [-9, 9]}}" if name == "uncertain" else "portraits: []"
        limits = "controller: {sample_time: {nominal: 0.01, jitter: 1e-4}, delay: 1}" if name == "late" else limits
        limits = "disturbance: {v: 0.001*sin(3*t)}" if name == "disturbed" else limits
        limits = "controller: {sample_time: 0.01}, quantum: {y: 0.001}" if name == "setpoint" else limits
        path = tmp_path / f"{name}.yaml"
        path.write_text(
            f"""name: {name}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [{push}]]
  C: [[1, 0]]
  cells:
    - {{name: free, where: ["z <= 0.05"], A: [[0, 1], [-1, -{damping}]]}}
    - {{name: touching, where: ["z >= 0.05"], A: [[0, 1], [-2, -{damping}]], b: [0, {slope}*0.05]}}
{wishes}
simulation: {{duration: 10, sample_time: 0.1, initial: {{plant: [0.2, 0]}}, {limits}}}
"""
        )
        yield path


@pytest.mark.slow
def test_every_printed_sentence_has_its_entry_with_statement_and_place(
    specs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entries: list[tuple[bool, str, re.Pattern[str]]]
) -> None:
    missing, used = [], set()
    for *of, sentence in chain(refusals(specs, tmp_path), printed(specs, tmp_path, monkeypatch)):
        here = [k for k, (*known, pattern) in enumerate(entries) if known == of and pattern.fullmatch(sentence)]
        used.update(here)
        if not here:
            missing.append((*of, sentence))
    assert not missing
    specific = {k for k, (*_, pattern) in enumerate(entries) if pattern.pattern not in (".*", "proved.*")}
    assert len(specific & used) >= 0.75 * len(specific)  # the rest is what refusals and rarer plants say
