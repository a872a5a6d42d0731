"""The source of a controller in C99: constants, and one step as `docs/arithmetic.md` says."""

import numpy as np

from pwatrack.export.c_source import CSource

_BEGIN = """#include "{name}.h"

#include <float.h>
#include <stddef.h>
{math}
#ifdef __FAST_MATH__
#error "this controller needs IEEE arithmetic: no -ffast-math"
#endif
#if (FLT_EVAL_METHOD != 0){also}
#error "this controller needs arithmetic in the width of its numbers: -msse2 -mfpmath=sse"
#endif

#define LARGEST {largest}
#define READY 0x70776131u
"""

_HELPERS = """
/* A row applied to count numbers and a constant: products and sums from left to right, each rounded by itself. */
static {real} row(const {real} a[], const {real} v[], int count)
{{
    {real} total = a[0];
    int k;

    if (count > 0) {{
        total = a[0] * v[0];
        for (k = 1; k < count; k++) {{
            const {real} product = a[k] * v[k];
            total = total + product;
        }}
        total = total + a[count];
    }}
    return total;
}}

static int finite(const {real} v[], int count)
{{
    int all = 1;
    int k;

    for (k = 0; k < count; k++) {{
        if (!((v[k] >= -LARGEST) && (v[k] <= LARGEST))) {{
            all = 0;
        }}
    }}
    return all;
}}
"""

_CELL = """
/* The first cell whose signs the guards contradict least. */
static uint32_t {kind}_cell(const {real} g[])
{{
    {real} least = {zero};
    uint32_t cell = 0u;
    int found = 0;
    int i;
    int k;

    for (i = 0; (i < {cells}) && (found == 0); i++) {{
        {real} worst = {zero};
        for (k = 0; k < {count}; k++) {{
            if ((table_{kind}[i][k] > 0) && (-g[k] > worst)) {{
                worst = -g[k];
            }}
            if ((table_{kind}[i][k] < 0) && (g[k] > worst)) {{
                worst = g[k];
            }}
        }}
        if ((i == 0) || (worst < least)) {{
            cell = (uint32_t)i;
            least = worst;
        }}
        if (!(least > {zero})) {{
            found = 1;
        }}
    }}
    return cell;
}}
"""

_OBSERVER_CELL = """    for (a = 0; a < {planes}; a++) {{
        {real} total = table_H[a][0] * next.v[{X}];
        for (b = 1; b < {n}; b++) {{
            const {real} product = table_H[a][b] * next.v[{X} + b];
            total = total + product;
        }}
        g[a] = total + table_h[a];
    }}
    next.cell = signs_cell(g);
"""

_DESIRED_CELL = """    for (a = 0; a < {guards}; a++) {{
        g_d[a] = row(table_guards[a], &next.v[{S}], {known});
    }}
    next.cell_d = sides_cell(g_d);
"""

_INIT = """
int {name}_init({name}_state *state)
{{
    int status = {upper}_REFUSED;
    int k;

    if (state != NULL) {{
{zeros}
        status = {upper}_OK;
    }}
    return status;
}}

int {name}_reset({name}_state *state)
{{
    return {name}_init(state);
}}
"""

_STEP = """
/* Write the input that is held, 0 where that is no number. */
static void hold(const {name}_state *state, {real} u[])
{{
    int b;

    for (b = 0; b < {m}; b++) {{
        u[b] = (finite(&state->v[{U} + b], 1) != 0) ? state->v[{U} + b] : {zero};
    }}
}}

/* One tick of a state that is ready. */
static int tick({name}_state *state, const {real} y[]{ref}, {real} u[])
{{
    {name}_state next;
    {real} law[{m}];
{values}    int fine = 1;
    int status = {upper}_OK;
    int a;
    int b;

    next = *state;
    if (state->started != 0u) {{
        for (a = 0; a < {N}; a++) {{
            next.v[{X} + a] = row(table_observer[state->cell][a], state->v, {E});
        }}
{generator}{reference}    }}
    for (a = 0; a < {q}; a++) {{
        next.v[a] = y[a];
    }}
{given}{cells_found}    for (a = 0; a < {n}; a++) {{
        next.x_d[a] = row(table_x_d[next.cell_d][a], &next.v[{S}], {known});
    }}
    for (b = 0; b < {m}; b++) {{
        {real} total = row(table_u_ff[next.cell_d][b], &next.v[{S}], {known});
        for (a = 0; a < {n}; a++) {{
            const {real} difference = next.v[{X} + a] - next.x_d[a];
            const {real} product = table_K[b][a] * difference;
            total = total + product;
        }}
        law[b] = total;
        total = total - next.before[b];
        if (finite(&total, 1) == 0) {{
            fine = 0;
        }}
    }}
{limits}    if ({refused}) {{
        hold(state, u);
        status = {upper}_REFUSED;
    }}
    else {{
        next.started = 1u;
        *state = next;
        for (b = 0; b < {m}; b++) {{
            u[b] = state->v[{U} + b];
        }}
    }}
    return status;
}}

int {name}_step({name}_state *state, const {real} y[],
    const {real} ref[], {real} u[])
{{
    int status = {upper}_REFUSED;
    int b;

{unused}    if ((state != NULL) && (u != NULL)) {{
        if ({damaged}) {{
            for (b = 0; b < {m}; b++) {{
                u[b] = {zero};
            }}
            status = {upper}_NOT_READY;
        }}
        else if ({missing}) {{
            hold(state, u);
        }}
        else {{
            status = tick(state, y{pass_ref}, u);
        }}
        state->status = status;
    }}
    return status;
}}
"""


def source(c: CSource) -> str:
    """Return the source."""
    of, name, program = c.program.sizes, c.name, c.program
    real, zero = f"{name}_real", "0.0f" if c.single else "0.0"
    text = {"name": name, "upper": name.upper(), "real": real, "zero": zero, **of}
    text |= {"planes": len(program.h), "guards": len(program.guards)}
    text |= {"U": of["q"], "X": of["q"] + of["m"], "S": of["q"] + of["m"] + of["n"]}
    text |= {"E": of["q"] + of["m"] + of["N"], "known": of["N"] - of["n"] + of["p"] + of["s"]}
    if not text["known"]:
        text["S"] = 0  # of which nothing is read; it is a place all the same
    math = "#include <math.h>\n" if (program.quantum > 0).any() else ""
    largest = "FLT_MAX" if c.single else "DBL_MAX"
    also = "" if c.single else " && (FLT_EVAL_METHOD != 1)"
    parts = [_BEGIN.format(**text, math=math, largest=largest, also=also), _tables(c), _HELPERS.format(**text)]
    kinds = [("signs", program.signs, "g", _OBSERVER_CELL), ("sides", program.sides, "g_d", _DESIRED_CELL)]
    kinds = [kind for kind in kinds if kind[1].size]
    parts += [_CELL.format(**text, kind=kind, cells=len(cells), count=cells.shape[1]) for kind, cells, *_ in kinds]
    parts.append(_init(c, text))
    if c.follows is not None:
        parts.append(_advance(c))
    generator = ""
    if of["p"]:
        generator = (
            "        for (a = 0; a < {p}; a++) {{\n"
            "            next.v[{E} + a] = row(table_generator[state->cell_d][a], &state->v[{S}], {known});\n"
            "        }}\n"
        ).format(**text)
    W, s = of["q"] + of["m"] + of["N"] + of["p"], of["s"]
    given = f"    for (a = 0; a < {s}; a++) {{\n        next.v[{W} + a] = ref[a];\n    }}\n" if c.given else ""
    damaged = ["state->ready != READY", f"state->cell >= {len(program.signs)}u"]
    damaged.append(f"state->cell_d >= {len(program.sides)}u")
    if "piece_tick" in c.whole:
        damaged.append(f"state->piece > {len(c.whole['piece_tick'][1])}u")
    numbers = [(field, length) for _, field, length, _ in c.fields if field in ("v", "copies", "late", "x_d")]
    parts.append(
        _STEP.format(
            **text,
            unused="" if c.given else "    (void)ref;\n",
            damaged=_any(damaged),
            missing=_any(["y == NULL", "ref == NULL"] if c.given else ["y == NULL"]),
            refused=_any(["fine == 0", *(f"finite(next.{field}, {length}) == 0" for field, length in numbers)]),
            ref=f", const {real} ref[]" if c.given else "",
            pass_ref=", ref" if c.given else "",
            generator=generator,
            reference="        status = advance(state, &next);\n" if c.follows is not None else "",
            given=given,
            values="".join(f"    {real} {values}[{cells.shape[1]}];\n" for _, cells, values, _ in kinds),
            cells_found="".join(found.format(**text) for *_, found in kinds),
            limits="".join(_limited(c, b) for b in range(of["m"])),
        )
    )
    return "".join(parts)


def _any(conditions: list[str]) -> str:
    """Return what holds where one of the conditions does."""
    return conditions[0] if len(conditions) == 1 else " || ".join(f"({condition})" for condition in conditions)


def _tables(c: CSource) -> str:
    """Return all constants, and what holds their size and that of the state against the header."""
    lines, sizes = [], []
    for name, values in c.tables.items():
        shape = "".join(f"[{k}]" for k in values.shape)
        rows = c.numbers(values).replace("}, {", "},\n    {")
        lines.append(f"static const {c.name}_real table_{name}{shape} =\n    {rows};\n")
        sizes.append(f"sizeof(table_{name})")
    for name, (kind, whole) in c.whole.items():
        shape = "".join(f"[{k}]" for k in whole.shape)
        rows = str(whole.tolist()).replace("[", "{").replace("]", "}")
        if kind == "uint32_t":
            rows = rows.replace(",", "u,").replace("}", "u}")
        lines.append(f"static const {kind} table_{name}{shape} = {rows};\n")
        sizes.append(f"sizeof(table_{name})")
    upper = c.name.upper()
    lines.append(f"\ntypedef char state_size[(sizeof({c.name}_state) == {upper}_STATE_BYTES) ? 1 : -1];\n")
    lines.append(f"typedef char constant_size[(({' + '.join(sizes)}) == {upper}_CONSTANT_BYTES) ? 1 : -1];\n")
    return "\n" + "".join(lines)


def _init(c: CSource, text: dict[str, object]) -> str:
    lines = []
    for kind, field, length, _ in c.fields:
        zero = text["zero"] if kind.endswith("_real") else "0" if kind == "int32_t" else "0u"
        if kind.endswith("_real"):
            lines += [f"for (k = 0; k < {length}; k++) {{", f"    state->{field}[k] = {zero};", "}"]
        else:
            lines.append(f"state->{field} = {'READY' if field == 'ready' else zero};")
    of = c.program.sizes
    X, E = of["q"] + of["m"], of["q"] + of["m"] + of["N"]
    starts = [("start_x_hat", "v", X, of["N"]), ("start_eta_hat", "v", E, of["p"])]
    if c.follows is not None:
        starts.append(("start_w", "v", E + of["p"], of["s"]))
        starts += [("start_w", "copies", copy * of["s"], of["s"]) for copy in range(c.copies)]
    for table, field, first, length in starts:
        if length:
            place = f"{first} + k" if first else "k"
            lines += [f"for (k = 0; k < {length}; k++) {{", f"    state->{field}[{place}] = table_{table}[k];", "}"]
    return _INIT.format(**text, zeros="\n".join(f"        {line}" for line in lines))


def _advance(c: CSource) -> str:
    """Return the step of the reference."""
    follows, of = c.follows, c.program.sizes
    assert follows is not None
    s, W = of["s"], of["q"] + of["m"] + of["N"] + of["p"]
    body: list[str] = []
    if c.counted:
        body.append(
            "    next->tick = state->tick + 1u;\n"
            if follows.end is not None
            else "    next->tick = (state->tick < 0xFFFFFFFFu) ? (state->tick + 1u) : state->tick;\n"
        )
    choose = "    const int level = 0;\n" if not c.copies else "    int level = 0;\n"
    if c.copies:
        body.append(
            "    next->since = state->since + 1u;\n    if ((next->since % 1024u) == 0u) {\n        level = 1;\n    }\n"
        )
    if c.copies == 2:
        body.append("    if (next->since == 1048576u) {\n        level = 2;\n        next->since = 0u;\n    }\n")
    old = f"&state->v[{W}]"
    if c.copies:
        old = f"(level == 0) ? &state->v[{W}] : &state->copies[(level - 1) * {s}]"
    body.append(
        f"    from = {old};\n    for (a = 0; a < {s}; a++) {{\n"
        f"        {c.name}_real total = table_turn[level][a][0] * from[0];\n"
        f"        for (k = 1; k < {s}; k++) {{\n"
        f"            const {c.name}_real product = table_turn[level][a][k] * from[k];\n"
        "            total = total + product;\n        }\n"
        f"        next->v[{W} + a] = total;\n"
        + (
            f"        for (k = 0; k < level; k++) {{\n            next->copies[(k * {s}) + a] = total;\n        }}\n"
            if c.copies
            else ""
        )
        + "    }\n"
    )
    if "piece_tick" in c.whole:
        body.append(_pieces(c, W, s))
    text, status = "".join(body), f"{c.name.upper()}_OK"
    if follows.end is not None:
        ended = f"    if (state->tick >= {follows.end}u) {{\n        status = {c.name.upper()}_ENDED;\n    }}\n"
        text = f"{ended}    else {{\n" + "".join(f"    {line}\n" for line in text.splitlines()) + "    }\n"
        choose, status = f"    int status = {status};\n{choose}", "status"
    return (
        f"\n/* Step the reference on. */\nstatic int advance(const {c.name}_state *state, {c.name}_state *next)\n{{\n"
        f"    const {c.name}_real *from;\n{choose}    int a;\n    int k;\n\n{text}    return {status};\n}}\n"
    )


def _pieces(c: CSource, W: int, s: int) -> str:
    """Return what sets w where pieces begin."""
    assert c.follows is not None
    count = len(c.follows.pieces)
    return (
        f"    while ((next->piece < {count}u) && (table_piece_tick[next->piece] == next->tick)) {{\n"
        "        const int first = (int)table_piece_value[next->piece];\n"
        "        for (a = 0; a < (int)table_piece_length[next->piece]; a++) {\n"
        f"            next->v[{W} + (int)table_piece_start[next->piece] + a] =\n"
        "                table_piece_values[first + a];\n        }\n"
        + (
            f"        for (k = 0; k < {c.copies * s}; k++) {{\n"
            f"            next->copies[k] = next->v[{W} + (k % {s})];\n        }}\n        next->since = 0u;\n"
            if c.copies
            else ""
        )
        + "        next->piece = next->piece + 1u;\n    }\n"
    )


def _limited(c: CSource, b: int) -> str:
    """Return the limits of an input, its steps, and what is put out."""
    program, of = c.program, c.program.sizes
    m, late, lines = of["m"], program.sampling.delay, []
    (low, high), change, quantum = program.limits[b].tolist(), program.change[b], program.quantum[b]

    def cut(value: str, bounds: list[tuple[str, str]]) -> None:
        for k, (sign, bound) in enumerate(bounds):
            lines.append(f"{'else ' * bool(k)}if ({value} {sign} {bound}) {{\n        {value} = {bound};\n    }}")
        if len(bounds) > 1:
            lines.append("else {\n        /* within */\n    }")

    value, before = f"law[{b}]", f"next.before[{b}]"
    if np.isfinite(change):
        most = c.numbers(change)
        cut(value, [("<", f"({before} - {most})"), (">", f"({before} + {most})")])
    lines.append(f"next.wanted[{b}] = {value};")
    limits = [("<", low), (">", high)]
    cut(value, [(sign, c.numbers(bound)) for sign, bound in limits if np.isfinite(bound)])
    lines.append(f"{before} = {value};")
    if quantum > 0:
        q, floor, half = c.numbers(quantum), "floorf" if c.single else "floor", c.numbers(0.5)
        lines.append(f"{value} = {q} * {floor}(({value} / {q}) + {half});")
    if not late:
        lines.append(f"next.v[{of['q'] + b}] = {value};")
    else:
        lines.append(f"next.v[{of['q'] + b}] = state->late[{b}];")
        lines += [f"next.late[{k * m + b}] = state->late[{(k + 1) * m + b}];" for k in range(late - 1)]
        lines.append(f"next.late[{(late - 1) * m + b}] = {value};")
    return "".join(f"    {line}\n" for line in lines)
