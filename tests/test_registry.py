"""Every claim is stored, read again and said by itself; what adds to bounds adds to all of them, or there is none."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pwatrack import design, load_spec, simulate
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.registry import CLAIMS, STATEMENT, data, rows
from pwatrack.commands.verify import told_design
from pwatrack.control.bounds import Form
from pwatrack.control.controller import Asked, Claim, ProvedController, Told
from pwatrack.lmi.audit.certificate import DESIGN
from pwatrack.lmi.audit.shape import REFUSAL
from pwatrack.lmi.solve import answers
from pwatrack.report.certificate import design_certificate

PLANTS = {
    "two_mass_backlash": {"Decay", "SignalBounds"},
    "two_mass_goals": {"Decay", "Costs", "SignalBounds"},
    "two_mass_machine": {
        "Decay",
        "SampledLoop",
        "SampledBounds",
        "ProgramRanges",
        "NoSaturation",
        "LimitedRegion",
        "SampledRegion",
        "SignalBounds",
    },
    "gallery/robust_positioning": {"Decay", "SignalBounds", "Robust"},
    "gallery/gear_with_backlash": {"Practical", "Decay", "Costs", "SignalBounds"},
    "gallery/cart_and_pole_swaying": {"Decay", "SignalBounds", "StableInversion"},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTS)
def test_a_controller_has_the_claims_that_its_spec_leads_to_and_reads_them_again(name: str, specs: Path) -> None:
    spec = load_spec(specs / f"{name}.yaml")
    made = design(spec)
    assert {type(claim).__name__ for claim in made.claims} == PLANTS[name]
    content = design_certificate(spec, made)
    told = told_design(spec, content)
    assert [type(claim) for claim in told.claims] == [type(claim) for claim in made.claims]
    assert data(told) == data(made)
    if not made.claims_of(CLAIMS[0]):  # why exact tracking is refused is in another file
        assert list(rows(spec.words, told)) == list(rows(spec.words, made))


@pytest.mark.slow
def test_what_was_proved_is_not_proved_again(specs: Path) -> None:
    """Neither when it is read once more, nor of a controller that has another trajectory."""
    spec = load_spec(specs / "two_mass_machine.yaml")
    with answers() as asked:
        made = design(spec)
        first = list(rows(spec.words, made)), data(made)
        count = sum(asked.values())
        again = list(rows(spec.words, made)), data(made)
        changed = replace(made, trajectory=replace(made.trajectory, bounded=False))
        assert changed.claim(SignalBounds).acting is made.claim(SignalBounds).acting
        assert again == first
        assert sum(asked.values()) == count > 0


def test_together_the_claims_fill_a_certificate_and_its_text() -> None:
    keys = {key for claim in CLAIMS for key in claim.nothing}
    assert keys == {*DESIGN} - {*REFUSAL} - {"eta_with_loads?", "K_of_least_cost?"} | {"proofs"}
    for claim in CLAIMS:
        assert claim.statement in STATEMENT
        assert claim.statement or not claim.nothing


@dataclass(frozen=True)
class Unknown(Claim):
    """Something that acts on all signals but the inputs, nobody knows how much."""

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator[Claim]:
        yield cls()

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {}

    def leaves(self, form: Form) -> float | None:
        return 0.5 if form[0] == "input" else None


def test_where_a_claim_cannot_tell_what_it_adds_there_is_no_bound(specs: Path) -> None:
    result = simulate(load_spec(specs / "two_mass_backlash.yaml"))
    known = result.bands
    assert {kind for kind, _ in known} == {"output", "input", "estimate"}
    controller = replace(result.controller, claims=(*result.controller.claims, Unknown()))
    bands = replace(result, controller=controller, loop=replace(result.loop, controller=controller)).bands
    assert {kind for kind, _ in bands} == {"input"}
    assert np.allclose(bands["input", 0], known["input", 0] + 0.5, rtol=1e-12)
    within = controller.claim(SignalBounds).from_sizes(controller)
    assert {kind for kind, _ in within} == {"input"}
