"""The C source of a kernel: from a CasADi function to its gradient with the search around it."""

from __future__ import annotations

from importlib import resources

import casadi as ca

from symgraph.compile.differentiate import Differentiator
from symgraph.compile.hoist import Hoister
from symgraph.compile.program import Kind, Program
from symgraph.compile.reading import Reader
from symgraph.compile.units import in_units
from symgraph.compile.writing import Writer, signature

MOST_LANES = (64, 32, 16)  # points that are evaluated side by side: as many as have room in the cache
CACHE = 6e6  # bytes of workspace that are still read fast


def kernel_source(function: ca.Function, lanes: bool, single: bool) -> list[str]:
    """Return the source of a kernel, in one translation unit or several.

    Args:
        function: actions (n, 1), selections (m, 1) and what is bound to a kernel → value (1, 1).
        lanes: write it for points side by side, else for one at a time.
        single: compute in single precision.
    """
    early, late = Hoister(lanes).halves(gradient_program(function))
    writer = Writer()
    shares = {program: writer.costs.is_worth_sharing(program) for program in (early, late)}
    late_name, late_work = writer.function(late, lanes, shares[late])
    if shares[late] and lanes and 8 * late_work * MOST_LANES[-1] > CACHE:
        # What parts keep to themselves would have no room in the cache, which costs more than they gain.
        writer, shares = Writer(), dict.fromkeys(shares, False)
        late_name, late_work = writer.function(late, lanes, False)
    early_name, early_work = writer.function(early, False, shares[early])
    numbers = {
        "N_ACTIONS": function.nnz_in(0),
        "N_SELECTIONS": function.nnz_in(1),
        "N_SHARED": function.n_in() - 2,
        "MOST_LANES": _most_lanes(late_work) if lanes else 1,
        "BLOCK": early.outputs[0].size,
        "EARLY_WORK": early_work,
        "LATE_WORK": late_work,
        "SHARED": int(shares[late]),
    }
    head = [PRECISION[single], *map(text_of, ("scalars.c", "arrays.c", "lanes.c", "products.c", "team.c"))]
    tail = [
        _entry("early", early_name, shares[early]),
        _entry("late", late_name, shares[late]),
        *(f"#define {name} {value}" for name, value in numbers.items()),
        *map(text_of, ("walks.c", "search.c", "kernel.c")),
    ]
    casadi = writer.casadi()
    if casadi:  # its functions are in one piece
        return ["\n".join([*head, casadi, *writer.pieces, *tail])]
    return in_units("\n".join(head), writer.pieces, "\n".join(tail))


def _entry(name: str, function: str, shared: bool) -> str:
    """Return a function that all members of a team call, whether or not they share what it does."""
    call = f"{function}(arg, res, w, B{', me' * shared});"
    body = call if shared else f"if (me->index == 0) {call}\n  meet(me);"
    return f"static void {name}{signature(shared=True)} {{\n  {body}\n}}"


def _most_lanes(work: int) -> int:
    fitting = [lanes for lanes in MOST_LANES if 8 * work * lanes <= CACHE]
    return max(fitting, default=MOST_LANES[-1])


def gradient_program(function: ca.Function) -> Program:
    """Return the program of a function of actions, selections and bound inputs, and its gradient by the actions."""
    kinds = [Kind.LANE, Kind.BLOCK, *[Kind.BOUND] * (function.n_in() - 2)]
    return Differentiator().with_gradient(Reader(function).program(kinds), by=0)


PRECISION = {
    False: """
typedef double real;
typedef long long whole;
#define MATH(name) name
#define LEAST_EXPONENT -708.0
""",
    True: """
typedef float real;
typedef int whole;
#define MATH(name) name##f
#define LEAST_EXPONENT -87.0f
#define SINGLE
""",
}


def text_of(name: str) -> str:
    """Return a C file of this package."""
    return (resources.files("symgraph.compile") / name).read_text()
