"""The source of a controller in C99: constants, and the step that `step.py` states."""

from textwrap import indent

from pwatrack.export.c_source import CSource
from pwatrack.export.notation import Language, names, printed
from pwatrack.export.step import PRODUCT

_WIDTHS = {True: (0, 16, 32), False: (0, 1, 16, 32, 64)}  # of FLT_EVAL_METHOD: these leave floats, or doubles, alone
_BEGIN = """\
#include "{name}.h"

#include <float.h>
#include <stddef.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ != 0))
#error "this controller needs IEEE arithmetic: no -ffast-math, and no part of it"
#endif
#if {widths}
#error "this controller needs arithmetic in the width of its numbers: on x86, -msse2 -mfpmath=sse"
#endif

/* No product may be fused with a sum, whatever the options are. GCC has a pragma that is stronger than they are; no
   other compiler must, and clang heeds none with -ffp-contract=fast: there each product goes through memory. */
#if defined(__GNUC__) && (__GNUC__ >= 5) && !defined(__clang__) && !defined(__EDG__)
#pragma GCC optimize ("fp-contract=off", "no-unsafe-math-optimizations", "no-associative-math")
#define ROUNDED
#else
#define ROUNDED volatile
#endif

#define READY 0x70776131u

{constants}
typedef char state_size[(sizeof({name}_state) == {upper}_STATE_BYTES) ? 1 : -1];
typedef char constant_size[(({sizes}) == {upper}_CONSTANT_BYTES) ? 1 : -1];

/* Put out the input that is held, 0 where that is no number. */
static void hold(const {name}_state *state, {real} u[])
{{
    int32_t b;

{hold}
}}

/* One tick of a state that is ready: each product and each sum is rounded by itself. */
static void tick({name}_state *state, const {real} y[]{ref}, {real} u[])
{{
    {name}_state next;
{own}

{body}
}}

int {name}_init({name}_state *state)
{{
    int status = {upper}_REFUSED;
    int32_t k;

    if (state != NULL) {{
{begin}
        state->ready = READY;
        status = {upper}_OK;
    }}
    return status;
}}

int {name}_reset({name}_state *state)
{{
    return {name}_init(state);
}}

int {name}_step({name}_state *state, const {real} y[],
    const {real} ref[], {real} u[])
{{
    int status = {upper}_REFUSED;
    int32_t b;

{unused}    if ((state != NULL) && (u != NULL)) {{
        if (state->ready != READY) {{
            for (b = 0; b < {m}; b++) {{
                u[b] = {zero};
            }}
            state->status = {upper}_NOT_READY;
        }}
        else if ({missing}) {{
            hold(state, u);
            state->status = {upper}_REFUSED;
        }}
        else {{
            tick(state, y{pass_ref}, u);
        }}
        status = (int)state->status;
    }}
    return status;
}}
"""


def source(c: CSource) -> str:
    """Return the source."""
    step, language = c.step, _language(c)
    used = names(step.body)
    kept = {f"new_{variable.name}" for variable in step.kept}
    own = [variable for variable in step.own if variable.name in used - kept]

    def lines(text: str, depth: int) -> str:
        return indent(printed(text, language), "    " * depth)

    return _BEGIN.format(
        name=c.name,
        upper=c.name.upper(),
        real=c.types["real"],
        zero=language.words["0.0"],
        m=c.program.sizes["m"],
        widths=" && ".join(f"(FLT_EVAL_METHOD != {method})" for method in _WIDTHS[c.single]),
        constants="\n".join(_constant(c, name) for name in step.constants),
        sizes=" + ".join(f"sizeof({name})" for name in step.constants),
        own="\n".join(f"    {'ROUNDED ' * (variable.name == PRODUCT)}{c.declared(variable)}" for variable in own),
        hold=lines(step.hold, 1),
        body=lines(step.body, 1),
        begin=lines(step.begin, 2),
        ref=f", const {c.types['real']} ref[]" if c.given else "",
        pass_ref=", ref" if c.given else "",
        unused="" if c.given else "    (void)ref;\n",
        missing="(y == NULL) || (ref == NULL)" if c.given else "y == NULL",
    )


def _language(c: CSource) -> Language:
    """Return C, with what is remembered in `state`, and what it will be in `next`."""
    kept, number = {variable.name for variable in c.step.kept}, "{}f" if c.single else "{}"

    def name(text: str) -> str:
        if text in kept:
            return f"state->{text}"
        new = text.removeprefix("new_")
        return f"next.{new}" if new != text else "ref" if text == "given" else text

    return Language(
        assign="{} = {};",
        loop="for ({0} = {1}; {0} <= {2}; {0}++) {{\n{3}\n}}",
        branch="if ({}) {{\n{}\n}}\n",
        other="else if ({}) {{\n{}\n}}\n",
        otherwise="else {{\n{}\n}}\n",
        end="",
        within="/* within */",
        truth="{} != 0u",
        words={"and": "&&", "or": "||", "not": "!", "True": "1u", "False": "0u"}
        | {text: number.format(text) for text in ("0.0", "1.0")},
        remainder="{} % {}",
        name=name,
        element="{}[{}]",
        between="][",
        from_one=False,
        comment="/* {} */",
    )


def _constant(c: CSource, name: str) -> str:
    kind, values = c.step.constants[name]
    shape = "".join(f"[{size}]" for size in values.shape)
    rows = c.numbers(values) if kind == "real" else str(values.tolist()).replace("[", "{").replace("]", "}")
    rows = rows.replace("}, {", "},\n    {")
    return f"static const {c.types[kind]} {name}{shape} =\n    {rows};"
