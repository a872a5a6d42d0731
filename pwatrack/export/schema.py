"""What controller.json holds, as pydantic models; `docs/controller.schema.json` is made from them."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pwatrack.control.sampled_gains import MOST_SUBSTEPS
from pwatrack.model.conditions import Method, Sampling

FORMAT = "pwatrack controller 8"


def _visible(text: str) -> str:
    """Return a text that stands in what is written from the file: there it may begin no line of its own."""
    if not text.isprintable():
        raise ValueError(f"{ascii(text)[:80]} is not one line of visible text")
    return text


Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = list[Finite]
Matrix = list[Vector]
Stack = list[Matrix]
Ends = Annotated[list[Finite], Field(min_length=2, max_length=2)]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Name = Annotated[str, Field(pattern="^[A-Za-z_][A-Za-z0-9_]*$")]
Names = list[Name]
Text = Annotated[str, AfterValidator(_visible)]
Texts = list[Text]
Count = Annotated[int, Field(ge=0)]


class StoredPart(BaseModel):
    """A part of the file: nothing is turned into another type, and no key is unknown."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class StoredLoads(StoredPart):
    """Unknown loads E s with s' = S s; the load k is entry where[k] of s. Estimates add to x_d, u_ff and eta_hat'."""

    names: Names
    where: list[Count]
    E: Matrix
    S: Matrix
    x_d: Matrix
    u_ff: Stack
    rate: list[Matrix]


class StoredPlant(StoredPart):
    """x' = A_i x + b_i + B u where signs_ij (H_j x + h_j) >= 0 for all j; y = C x is measured. Cells come first.

    It is what the observer runs: its cells may be more than those of the trajectory, where cells are merged.
    """

    states: Names
    inputs: Names
    outputs: Names
    tracked: Names
    units: dict[Name, Text]
    cells: Texts
    H: Matrix
    h: Vector
    signs: list[list[Annotated[int, Field(ge=-1, le=1)]]]
    A: Stack
    b: Matrix
    B: Matrix
    C: Matrix
    tracked_rows: Matrix
    loads: StoredLoads | None


class StoredJump(StoredPart):
    """At t (s) the entries of w from `start` on are these."""

    t: Finite
    start: Count
    w: Vector


class Reference(StoredPart):
    """w' = S w; signals are Q w; defined up to `end` (s), where there is one."""

    S: Matrix
    Q: Matrix
    w0: Vector
    pieces: list[StoredJump]
    period: Finite | None
    end: Finite | None


class StoredTrajectory(StoredPart):
    """In the cell i of x_d, s = (eta_hat, w, 1): eta_hat' = rate_i s, x_d = x_d_i s, u_ff = u_ff_i s.

    It is the cell i where signs_ij guards_j s >= 0 for all j.
    """

    eta: Texts
    rate: list[Matrix]
    x_d: Stack
    u_ff: Stack
    guards: Matrix
    signs: list[list[Annotated[int, Field(ge=-1, le=1)]]]
    reference: Reference


class Start(StoredPart):
    """What the controller starts with: x_hat, then estimates of loads; eta_hat."""

    x_hat: Vector
    eta_hat: Vector


class Followed(StoredPart):
    """A desired trajectory in samples: rows on (s_hat, eta_hat, w, 1)."""

    generator: list[Matrix]
    x_d: Stack
    u_ff: Stack
    guards: Matrix
    sides: list[list[Annotated[int, Field(ge=-1, le=1)]]]


class StoredPiece(StoredPart):
    """At a tick the entries of w from `start` on are these."""

    tick: Count
    start: Count
    w: Vector


class Inside(Followed):
    """One whose reference is made inside: w one sample later, 2^10 and 2^20 samples later.

    `early` is w at the ticks before the first one that an input is for, where inputs are late.
    """

    turn: Stack
    w0: Vector
    pieces: list[StoredPiece]
    end: Count | None
    early: Matrix


class Outside(Followed):
    """One whose reference is given at each tick: the names of its entries.

    With a `pace`, set-points are given of the first ones, and it makes the others: where each starts, and the limits
    of its speed, acceleration and jerk. `range` is what each may be, null for any; `takes` between what any that keep
    these limits take each input, as far as that is proved.
    """

    reference: Texts
    pace: Matrix
    range: list[Ends | None]
    takes: list[Ends]

    @property
    def given(self) -> Texts:
        """The names of what is given."""
        return self.reference[: len(self.pace) or None]


class Sampled(StoredPart):
    """The program of docs/arithmetic.md: its gains, x_hat one sample or substep later; limits, null for none.

    M has no rows where nothing is corrected; K is that of the design there. `proved` says what is proved of its loop.
    """

    sample_time: Annotated[Finite, Field(gt=0)]
    method: Method
    proved: Text
    delay: Annotated[int, Field(ge=0, le=10)]
    jitter: Annotated[Finite, Field(ge=0)]
    substeps: Annotated[int, Field(ge=1, le=MOST_SUBSTEPS)]
    K: Matrix
    M: Matrix
    E: Matrix
    observer: Stack
    low: list[Finite | None]
    high: list[Finite | None]
    change: list[Finite | None]
    quantum: Vector
    inside: Inside
    outside: Outside

    @property
    def sampling(self) -> Sampling:
        """How it runs."""
        return Sampling(sample_time=self.sample_time, method=self.method, delay=self.delay, jitter=self.jitter)


class FinalBound(StoredPart):
    """Below what the tracking error of a signal ends, from every start."""

    signal: Name
    below: Annotated[Finite, Field(ge=0)]
    unit: Text


class ControllerFile(StoredPart):
    """All of a controller.

    `claims` say what is proved of the tracking error; `practical` is below what it is proved to end where cells are
    merged, else null.
    `sha256` is that of the rest: JSON with sorted keys, no white space, and the shortest decimals of each double.
    `proof` is the digest of certificate.json; `open` says what its theorems do not speak of.
    `failed` says what its run did not achieve, in an export too; [] where it did all, or there was no run.
    """

    format: Literal["pwatrack controller 8"]
    sha256: Digest
    name: Text
    spec_sha256: Digest
    set: dict[Name, str]
    tracking: Literal["output", "state"]
    proof: Digest
    claims: Texts
    practical: list[FinalBound] | None
    open: Texts
    failed: Texts
    plant: StoredPlant
    K: Matrix
    L: Matrix
    generator: dict[str, Any] | None
    trajectory: StoredTrajectory
    start: Start | None
    program: Sampled | None

    @property
    def started(self) -> tuple[Vector, Vector]:
        """What it starts with, x̂ with ŝ and η̂: 0 where nothing is known."""
        if self.start is None:
            return [0.0] * len(self.L), [0.0] * len(self.trajectory.eta)
        return self.start.x_hat, self.start.eta_hat


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the file."""
    found = ControllerFile.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": FORMAT, **found, "$id": FORMAT}
