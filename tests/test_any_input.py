"""Whatever one hands over, building and solving end with a plan or with a SymgraphError."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import symgraph as sg

FIND = (Phase.explicit, Phase.reuse, Phase.generate)  # what was found is seldom worth minutes of shrinking
LABELS = ("u", "v", "x", "y", "way", "other")
NODES = ("a", "b", "c")
QUICK = (sg.Lbfgs(starts=2, iterations=20), sg.Adadelta(starts=2, run_iterations=10), sg.Ipopt(iterations=10))

# What a user might hand over by mistake, in any place.
THINGS = [
    *(None, True, -1, 0, 1e308, math.nan, math.inf, "u", "", [], [1.0, 2.0], [[1.0]], {}, {"u": 1}, (), b"u"),
    *(np.zeros(2), np.array([]), np.float32(0.5), 1j, object(), ca.MX.sym("u"), ca.DM([1, 2]), lambda: 1.0, sg.State()),
]
ODD = st.integers(0, len(THINGS) - 1).map(THINGS.__getitem__)  # DM cannot be hashed, which sampled_from wants


def or_odd(strategy):
    """Mostly what is meant, in one of sixteen cases something else."""
    return st.integers(0, 15).flatmap(lambda draw: strategy if draw else ODD)


NUMBERS = st.floats(-3, 3)
RANGES = st.tuples(NUMBERS, NUMBERS).map(lambda ends: sg.Action(low=min(ends), high=max(ends)))
FIXED_SLOTS = {"x": sg.State(), "y": sg.State(2), "way": sg.Selection(["left", "right"])}
SLOTS = st.one_of(
    *[RANGES.map(lambda u: {"u": u, **FIXED_SLOTS, "v": sg.Action(2, low=-1, high=1)})] * 7,
    st.fixed_dictionaries({"u": or_odd(RANGES), "x": ODD}, optional={"other": ODD}),
)
MODELS = or_odd(
    st.sampled_from(
        [
            None,
            lambda x, u: {"x": x + u},
            lambda u: {"y": ca.vertcat(u, 1 / u)},
            lambda y: {"x": ca.sqrt(y[0] - 1)},
            lambda way: {"x": way[0]},
            lambda x: {"x": ca.log(x)},
            lambda x: {"u": x},
            lambda z: {"x": z},
            lambda x: x,
            lambda x: {"x": x if x > 0 else -x},
            lambda: {"x": 1.0},
            sg.Model(lambda x: {"x": 2 * x}, noise={"x": 0.1}),
        ]
    )
)
REWARDS = or_odd(
    st.sampled_from(
        [
            lambda x: -(x**2),
            lambda u: ca.fabs(u),
            lambda y: y,
            lambda y, x: y[0] / x,
            lambda: 1.0,
            lambda u: 0 * ca.inf * u,
        ]
    )
)
SHARES = or_odd(
    st.sampled_from(
        [
            {"left": 0.5, "right": 0.5},
            {"left": 0.5, "right": 0.6},
            {"left": 1.0, "right": 0.0},
            lambda u: {"left": u, "right": 1 - u},
            lambda x: {"left": x},
        ]
    )
)
NODE, LABEL = or_odd(st.sampled_from(NODES)), or_odd(st.sampled_from(LABELS))
WAYS = or_odd(st.fixed_dictionaries({name: or_odd(st.tuples(NODE, MODELS)) for name in ("left", "right")}))
BOUND = or_odd(NUMBERS)
CALLS = st.one_of(
    st.tuples(st.just("edge"), NODE, NODE, MODELS),
    st.tuples(st.just("choose"), NODE, LABEL, WAYS),
    st.tuples(st.just("choose"), st.sampled_from(NODES), st.just("way"), WAYS),
    st.tuples(st.just("chance"), NODE, WAYS, SHARES),
    st.tuples(st.just("reward"), NODE, REWARDS),
    st.tuples(st.just("require"), NODE, REWARDS, BOUND, BOUND, or_odd(st.sampled_from([None, 0.9]))),
)
VALUES = or_odd(
    st.one_of(
        NUMBERS, st.just([0.5, 1.5]), st.builds(lambda m: sg.Gaussian(m, 0.2), NUMBERS), st.sampled_from(["left"])
    )
)
GAUSSIANS = st.tuples(NUMBERS, st.sampled_from([0.0, 0.2])).map(lambda pair: sg.Gaussian(pair[0], pair[1]))
STATES = st.fixed_dictionaries({"x": st.one_of(NUMBERS, GAUSSIANS), "y": st.just([0.5, 1.5])})
MAPPING = or_odd(st.dictionaries(st.sampled_from(LABELS), VALUES))
HELD = or_odd(st.sampled_from([{"u": 0.25}, {"way": "left"}, {"u": 5.0}, {"v": [0.0, 2.0]}, {"x": 1.0}, {"u": "left"}]))


def build(slots, calls, start):
    """A way through all nodes with a reward, and those calls that fit."""
    graph = sg.Graph(slots, start)
    graph.edge("a", "b")
    graph.edge("b", "c")
    graph.reward("c", lambda u: -((u - 0.5) ** 2))
    for name, *arguments in calls:
        before = {node: len(groups) for node, groups in graph.groups.items()}, len(graph.requirements)
        try:
            getattr(graph, name)(*arguments)
        except sg.SymgraphError:
            assert before == ({node: len(groups) for node, groups in graph.groups.items()}, len(graph.requirements))
    return graph


@settings(max_examples=400, deadline=None, phases=FIND, suppress_health_check=list(HealthCheck))
@given(
    slots=SLOTS,
    calls=st.lists(CALLS, min_size=1, max_size=7),
    start=or_odd(st.just("a")),
    visits=or_odd(st.integers(1, 2)),
    state=st.one_of(*[STATES] * 5, MAPPING),
    optimizer=or_odd(st.sampled_from(QUICK)),
    options=st.fixed_dictionaries(
        {},
        optional={"guess": MAPPING, "fixed": HELD, "seed": or_odd(st.just(1)), "time_limit": or_odd(st.just(0.1))},
    ),
)
def test_a_plan_or_an_error_of_ours(slots, calls, start, visits, state, optimizer, options):
    try:
        objective = sg.Objective(sg.unroll(build(slots, calls, start), max_visits=visits), compiled=False)
        plan = sg.solve(objective, state, optimizer, progress=False, **options)
    except sg.SymgraphError:
        return
    assert np.isfinite(plan.value)
    assert plan.violation >= 0.0
    for label, value in (options.get("fixed") or {}).items():
        held = plan.selections.get(label, plan.actions.get(label))
        np.testing.assert_array_equal(np.ravel(held), np.ravel(value))
    for label, slot in objective.graph.actions().items():
        if label not in (options.get("fixed") or {}):
            assert (np.ravel(plan.actions[label]) >= slot.lower).all()
            assert (np.ravel(plan.actions[label]) <= slot.upper).all()
    assert str(plan)
    plan.to_json()


REQUIRED = st.lists(
    st.tuples(
        st.sampled_from(NODES),
        st.sampled_from(
            [
                lambda u: u,
                lambda x, u: x * u,
                lambda y: y,
                lambda x: ca.log(x),
                lambda u, way: u**2 + way[1],
                lambda x, u: ca.exp(5 * u) + x,
            ]
        ),
        st.floats(-2, 2),
        st.sampled_from(["low", "high", "equal"]),
        st.sampled_from([None, 0.9]),
    ),
    min_size=1,
    max_size=3,
)
SEARCHES = st.sampled_from([*QUICK, sg.Enumerate(QUICK[0]), sg.Bonmin()])


@settings(max_examples=60, deadline=None, phases=FIND, suppress_health_check=list(HealthCheck))
@given(
    required=REQUIRED, optimizer=SEARCHES, state=STATES, fork=st.booleans(), fixed=st.sampled_from([{}, {"u": 0.25}])
)
def test_what_a_plan_says_of_requirements_is_so(required, optimizer, state, fork, fixed):
    slots = {"u": sg.Action(low=-1, high=1), **FIXED_SLOTS}
    graph = sg.Graph(slots, "a")
    graph.edge("a", "b", lambda x, u: {"x": x + u})
    if fork:
        graph.choose("b", "way", {"left": ("c", lambda u: {"y": ca.vertcat(u, 1)}), "right": ("b", None)})
    else:
        graph.edge("b", "c")
    graph.reward("c", lambda u, y: -ca.sumsqr(y - u))
    for node, model, bound, side, confidence in required:
        bounds = {"low": bound, "high": bound} if side == "equal" else {side: bound}
        graph.require(node, model, **bounds, confidence=None if side == "equal" else confidence)
    objective = sg.Objective(sg.unroll(graph, max_visits=2), compiled=False)
    try:
        plan = sg.solve(objective, state, optimizer, fixed=fixed, progress=False)
    except sg.SolveError:
        return
    violation = objective.violation(state, plan.actions, plan.selections)
    np.testing.assert_equal(plan.violation, violation)
    assert plan.status.startswith("requirements are missed") == (not violation <= 1e-4) or violation < 1e-3
    if "missed" not in plan.status:
        assert violation <= 1e-3
    assert plan.value == pytest.approx(objective.value(state, plan.actions, plan.selections))
