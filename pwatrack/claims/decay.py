"""(8), (9) and (17): how fast errors go to 0, by how much the gains may change, and what follows by Theorem 2 or 3."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array, up
from pwatrack.claims.cost import Costs
from pwatrack.claims.exact_text import proof_content, read_proof
from pwatrack.claims.limits import NoSaturation, ideal
from pwatrack.claims.practical import Practical
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.goal import AtLeast, Fastest, Given, Goal, LeastCost, Smallest
from pwatrack.control.guarantees import Contraction
from pwatrack.control.words import Words, all_cells, down, load_kind, matrix_text
from pwatrack.lmi.audit.shape import kind
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.lmi.polynomial import AnyProof

_LINE = 68  # letters of gains on the first screen: what takes more is left to its file
_NO_GAIN = {"K": "no gain: the input does nothing", "L": "no gain: the output shows nothing"}


@dataclass(frozen=True, kw_only=True)
class Decay(Claim):
    """The proofs of (8), (9) and (17) or (17±) for the printed gains, with what they promise."""

    statement: ClassVar[str] = (
        "Exactly, for the numbers as they are written here (decimals, fractions): the cells cover the state space, the "
        "field is continuous and, for output tracking, the plant has the form (11). For them and, where a radius is "
        "given, for every value within it of the entry: controller: M_i = A_i + B K; observer: M_i = (A_i + L C)^T, "
        "where loads are estimated with [A_i, E; 0, S] and [C, 0] in place of A_i and C; "
        "generator: M_i = A_eta_i^T, the tracking dynamics of this plant; P > 0 and -(M_i P + P M_i^T) - 2 rate P - "
        "margin I > 0 for every cell i, P_jk = integers_jk 2^(exponents_j + exponents_k). A plant with elements is A x "
        "+ b + B u and the sum of direction function(row x + constant); its cells are all combinations of segments, "
        "the last element's first. Bounded both ways: the same without a rate and without P > 0, so that the generator "
        "has one bounded solution, which is played back; with estimates s_hat of loads eta + H s_hat, H = "
        "eta_with_loads, so that no load acts on eta in any cell. With a degree 2 d: the monomials m of degree d of z "
        "= T e have m' = F_i m for e' = M_i e (controller) or M_i^T e; P > 0 and -(P F_i + F_i^T P) - 2 d rate P - N_i "
        "> 0 for every different M_i, and m^T N_i m = 0 for all z."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"proofs": []}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["Decay"]:
        yield cls()

    def data(self, controller: ProvedController) -> dict[str, Any]:
        found, generator = list[AnyProof | Dichotomy](controller.proofs), controller.generator
        if generator is not None and isinstance(generator.certificate, Dichotomy):
            found.append(generator.certificate)
        return {"proofs": [proof_content(proof) for proof in found]}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        return {"figures": gain_figures(controller)}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        yield from _gain_rows(words, controller)
        plant, practical = controller.plant, controller.claims_of(Practical)
        if plant.loads is not None:
            named = ", ".join(f"{load.name} ({load_kind(load)})" for load in plant.loads.each)
            end = "end below the bounds said here" if practical else "go to 0 as said here"
            yield "loads", f"{named}: estimated and compensated; errors {end} whatever their size"
        if controller.generator is not None:
            yield from _generator_rows(words, controller, controller.generator)
        else:
            until = controller.trajectory.until
            end = "" if until is None else f" up to t = {until:.6g} s, the end of the run"
            yield "Assumption 1", f"x_d and u_ff satisfy (3){end}"
        if not practical:
            theorem = "Theorem 2" if controller.generator is None else "Theorem 3"
            yield from ((theorem, sentence) for sentence in sentences(words, controller))
        yield from _guarantee_rows(controller, practical=bool(practical))

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        if not controller.claims_of(Practical):
            played = [up(played.error) for played in controller.claims_of(StableInversion)]
            ends = f"below {played[0]} {words.unit_of_tracked()}".rstrip() if played else "to 0"
            bounded = "" if controller.trajectory.bounded else ", while x_d stays bounded"
            theorem = "Theorem 2" if controller.generator is None else "Theorem 3"
            constant = up(1 / controller.guarantees.rate)
            said = f"proved: error {ends} from every start, time constant {constant} s"
            yield "ideal loop", f"{said}; {ideal(controller, words)}{bounded}, {theorem}"
        yield "K, L", in_a_line(words, controller.design.K, "L", controller.design.L, "K and L are in gains.json")


def in_a_line(words: Words, K: Array, name: str, other: Array, where: str) -> str:
    """Return the law of the input with K and another gain where there is room for five digits, else where they are."""
    loads = () if words.plant.loads is None else words.plant.loads.names
    rows = f"x = ({', '.join(words.plant.states)}){', then ' * bool(loads)}{', '.join(loads)}"
    gains, law = f"K = {matrix_text(K)}, {name}ᵀ = {matrix_text(other.T)}", "u = u_ff + K (x̂ − x_d)"
    return f"{gains}; {law}, {rows}" if len(gains) <= _LINE else f"{where}; {law}"


def read_proofs(content: Mapping[str, Any]) -> list[AnyProof | Dichotomy]:
    """Return the proofs of (8), (9) and (17) that a certificate holds."""
    return [read_proof(proof) for proof in content["proofs"] if kind(proof) != "cost"]


def ends_below(words: Words, controller: ProvedController) -> list[dict[str, Any]]:
    """Return below what each tracked signal ends, where that is all that is proved of it; else nothing."""
    return [
        {"signal": name, "below": practical.final[controller.tracking, k], "unit": str(words.units.get(name, ""))}
        for practical in controller.claims_of(Practical)
        for k, name in enumerate(controller.error_names)
    ]


def sentences(words: Words, controller: ProvedController) -> list[str]:
    """Return what is proved of the tracking error: a summary and all that leaves the tool say these."""
    if below := ends_below(words, controller):
        return [
            f"the error of {one['signal']} ends below {up(one['below'])} {one['unit']}".rstrip()
            + "; it need not go to 0"
            for one in below
        ]
    trajectory, names = controller.trajectory, controller.plant.tracked_names
    desired = "x_d" if controller.generator is None else ", ".join(f"{name}_d" for name in names)
    condition = "" if trajectory.bounded else ", as long as x_d stays bounded, which is not proved"
    for played in controller.claims_of(StableInversion):
        left = f"{up(played.error)} {words.unit_of_tracked()}".rstrip()
        condition = f", but for what is played back, which leaves at most {left} of it"
    return [f"all solutions track {desired} with error going to 0{condition}"]


def gain_figures(controller: ProvedController) -> dict[str, float]:
    """Return the figures of a design: sizes of the gains, and what is proved of them."""
    promised = controller.guarantees
    robust_rate, of_K, of_L = promised.robust
    norm_K, norm_L = controller.sizes.norms(controller.design.K, controller.design.L)
    loops = {"controller": promised.controller, "observer": promised.observer, "generator": promised.generator}
    return {
        "norm_K": norm_K,
        "norm_L": norm_L,
        **{f"{name}_rate": max(p.rate for p in proved) for name, proved in loops.items() if proved},
        "rate": promised.rate,
        "robust_rate": robust_rate,
        "robust_share_K": of_K,
        "robust_share_L": of_L,
    }


def _gain_rows(words: Words, controller: ProvedController) -> Iterator[Row]:
    design, plant, promised = controller.design, controller.plant, controller.guarantees
    norm_K, norm_L = controller.sizes.norms(design.K, design.L)
    for role, proved, run, through, gain, norm in (
        (CONTROLLER, promised.controller, plant, plant.B, design.K, f"{norm_K:.4g}"),
        (OBSERVER, promised.observer, plant.model, plant.C, design.L.T, f"{norm_L:.4g} 1/s"),
    ):
        goal = words.goals[role]
        yield f"{role.claim} {role.name}", f"proved for {all_cells(len(run.cell_names))}{_rate(proved)}"
        origin = _origin(goal) if through.any() or isinstance(goal, Given) else _NO_GAIN[role.letter]
        within = role is CONTROLLER and bool(plant.B.any()) and _within_limits(goal, controller)
        size = f"‖{role.letter}‖ = {norm} in sizes, {origin}{' within the limits' * within}"
        yield "", f"{role.letter}{'ᵀ' * role.transposed} = {matrix_text(gain)}, {size}"
        for costs in () if controller.claims_of(Practical) else controller.claims_of(Costs):
            yield from (("", text) for text in costs.texts(role, words, controller))


def _generator_rows(words: Words, controller: ProvedController, generator: TrajectoryGenerator) -> Iterator[Row]:
    proved, played = controller.guarantees.generator, controller.claims_of(StableInversion)
    if played:
        for k, text in enumerate(played[0].texts(words)):
            yield "" if k else "(17±) preview", text
    elif not proved:
        yield "(17) generator", "none needed: relative degree = number of states"
    else:
        yield "(17) generator", f"proved{_rate(proved)}; η = {', '.join(generator.form.eta_names)}"
        if generator.shift is not None:
            yield "Assumption 2", f"holds with η = η̄ + M ξ_d, M = {matrix_text(generator.shift)}"
        else:
            reason = "(17) suffices, as the tracking dynamics are continuous in (ξ_d, η)"
            yield "Assumption 2", f"holds for no shift; {reason}"


def _guarantee_rows(controller: ProvedController, *, practical: bool) -> Iterator[Row]:
    """Yield how fast errors go to 0, and by how much the gains may change."""
    promised = controller.guarantees
    if practical:
        ends = "from every start errors go to these bounds at least as fast as"
        yield "guarantee", f"{ends} e^(−{down(promised.rate)} t), for any switching"
        return
    errors = ", ".join(f"{name} − {name}_d" for name in controller.plant.tracked_names)
    error = f"{errors} and x − x_d go" if controller.tracking == "output" else "x − x_d goes"
    ends = "what is played back leaves of it" if controller.claims_of(StableInversion) else "0"
    text = f"from every start {error} to {ends} at least as fast as e^(−{down(promised.rate)} t), for any switching"
    if promised.generator:
        own = down(max(p.rate for p in promised.generator))
        text += f"; x_d is the generator's, whose initial transient decays as e^(−{own} t)"
    rate, of_K, of_L = promised.robust
    yield "guarantee", text
    if any(part.degree > 2 for part in (*promised.controller, *promised.observer)):
        yield "", "by how much K and L may change is not proved: a polynomial stands for a common P"
        return
    yield (
        "",
        f"at least as fast as e^(−{down(rate)} t) with K and L changed in every entry by less than "
        f"{down(100 * of_K)} % and {down(100 * of_L)} % of it, the plant as designed",
    )


def _within_limits(goal: Goal, controller: ProvedController) -> bool:
    """Say whether a gain was to keep limits, and is proved to from all starts that it was designed for."""
    for limited in controller.claims_of(NoSaturation):
        left = limited.room.left
        if left is not None and isinstance(goal, AtLeast | Fastest) and goal.within == "limits":
            wanted = "members" if any(one.kind == "members" for one in limited.room.starts) else "exact"
            return any(p.starts.kind == wanted and p.scale(left) >= 1 for p in limited.promises)
    return False


def _origin(goal: Goal) -> str:
    match goal:
        case Given():
            return "given"
        case LeastCost():
            return "designed for the cost asked"
        case Smallest(rate=rate):
            asked = [f"rate {rate}", "gain smallest"]
        case Fastest(bound=bound):
            asked = ["rate largest"] + [f"gain {bound}"] * bool(np.isfinite(bound))
        case AtLeast(rate=rate, bound=bound):
            asked = [f"rate {rate}"] * bool(rate) + [f"gain {bound}"] * bool(np.isfinite(bound))
    return f"designed for {', '.join(asked)}" if asked else "designed"


def _rate(proved: Sequence[Contraction]) -> str:
    """Say the best rate that one inequality is proved for, and by which polynomial if it is by one."""
    best = max(proved, key=lambda p: p.rate)
    by = f" by a polynomial of degree {best.degree}" if best.degree > 2 else ""
    return f"{by}, rate {down(best.rate)} 1/s"
