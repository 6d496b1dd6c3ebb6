"""Threads that share each evaluation: to the last bit what one finds, and none touches what another one writes."""

import ctypes
import os
import shutil
import subprocess
import threading

import casadi as ca
import numpy as np
import pytest
from compiled_functions import bound, code_for, compiled, function_of
from hypothesis import given, settings
from hypothesis import strategies as st
from wrapped_kernels import ctrl_c_after

from symgraph.compile import crew, sharing
from symgraph.compile.hoist import Hoister
from symgraph.compile.meetings import Access, Notes
from symgraph.compile.schedule import Place
from symgraph.compile.sharing import PARTS, Costs
from symgraph.compile.source import gradient_program, kernel_source

N, WIDE, ODD = 5, 41, 37
SHAPES = [(WIDE, N), (ODD, WIDE), (ODD, ODD), (3, ODD), (4, 1)]


def layer(name, m, n):
    w, x = ca.MX.sym("w", m, n), ca.MX.sym("x", n)
    return ca.Function(name, [w, x], [ca.tanh(w @ x) + 0.1 * ca.sin(x[0])])


WEIGHTS = ca.MX.sym("a", ODD, ODD)
FIRST, SECOND, THIRD = layer("first", WIDE, N), layer("second", ODD, WIDE), layer("third", ODD, ODD)


def network(u, w, v, a, b):
    """Layers with means and variances, and scalars between them."""
    x = FIRST(w, u)
    y = SECOND(v, x) * ca.exp(-(ca.sin(u[1]) ** 2)) + 0.1 * (v**2) @ x**2
    z = THIRD(a, y) + THIRD(a, ca.sin(y)[::-1] + x[:ODD])
    return b @ ca.vertcat(z[3:], z[:2], ca.sumsqr(x) / 40)


def straight(u, s, w, v, a, b, p):
    return ca.sumsqr(network(u, w, v, a, b)) + ca.dot(p, u[:4]) ** 2


def mapped(u, s, w, v, a, b, p):
    return ca.sumsqr(
        THIRD.map("map", "serial", 3, [0], [])(a, ca.horzcat(*(SECOND(v, FIRST(w, u * i)) for i in (1, 2, 3))))
    )


def switched(u, s, w, v, a, b, p):
    """One case is shared, the other one is not."""
    x = ca.MX.sym("x", ODD)
    cases = [ca.Function("heavy", [a, x], [a @ ca.sin(x)]), ca.Function("light", [a, x], [ca.tanh(x)])]
    y = ca.Function.conditional("which", cases[:1], cases[1])(s[0], a, SECOND(v, FIRST(w, u)))
    return ca.sumsqr(y) + ca.sum1(ca.sin(3 * y) * y[::-1])


def matrices(u, s, w, v, a, b, p):
    """Products with several columns, transposed and squared weights."""
    x = ca.horzcat(*(ca.sin(i * u) for i in range(1, 6)))
    y = v @ ca.tanh(w @ x)
    return ca.sumsqr(b @ (a.T @ y + (a**2) @ ca.cos(y)) @ p[0]) + ca.sumsqr(a.T**2 @ y[:, 2])


def long_layer(name, factor):
    """Too long to be written out where it is called."""
    x = ca.MX.sym("x", ODD)
    y = ca.sin(factor * x[0])
    for k in range(35):
        y = ca.sin(y) + 0.02 * k * y
    return ca.Function(name, [WEIGHTS, x], [ca.tanh(WEIGHTS @ (x * y)) + ca.tanh(WEIGHTS.T @ x)])


ONE, TWO = long_layer("one", 1), long_layer("two", 2)
X = ca.MX.sym("x")
TABLE = ca.Function(
    "t", [X], [ca.interpolant("t", "bspline", [np.linspace(-9, 9, 30)], np.cos(np.linspace(-9, 9, 30)))(X)]
)


def beside(u, s, w, v, a, b, p):
    """Functions that are called beside each other, and one that is CasADi's own."""
    begin = [SECOND(v, FIRST(w, u * k)) for k in (1, 2, 3, 4)]
    each = [(ONE, TWO)[k % 2](a, (ONE, TWO)[k % 2](a, y)) for k, y in enumerate(begin)]
    return ca.sumsqr(ca.vertcat(*each)) + sum(TABLE(ca.sum1(y) / ODD) * ca.sumsqr(y) for y in begin)


CASES = {"straight": straight, "mapped": mapped, "switched": switched, "matrices": matrices, "beside": beside}


def numbers():
    rng = np.random.default_rng(3)
    return [rng.normal(size=shape) / np.sqrt(shape[1]) for shape in SHAPES]


def nothing_that_is_called_is_shared(patch):
    """Each thread calls functions of its own then."""
    patch.setenv("XDG_CACHE_HOME", os.environ["XDG_CACHE_HOME"] + "-alone")
    patch.setattr(sharing.Costs, "is_shared", lambda self, operation: False)


def points_of(count):
    rng = np.random.default_rng(count)
    return rng.uniform(-1, 1, (count, N)), rng.integers(0, 2, (count, 1)).astype(float)


@pytest.fixture(scope="module", autouse=True)
def shared_however_small(tmp_path_factory):
    """All programs count as worth sharing; what is compiled that way must not be found by others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        for name in ("ENOUGH", "GAIN"):
            patch.setattr(sharing, name, 0)
        yield


@pytest.fixture(scope="module", params=["lanes", "narrow", "single", "lanes, functions not shared"])
def kernels(request):
    build = "narrow" if request.param == "narrow" else "lanes"
    return {
        name: compiled(function_of(case, N, 1, SHAPES), build, request.param == "single")
        for name, case in CASES.items()
    }


@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("name", CASES)
def test_evaluations_are_those_of_one_thread(kernels, name, threads):
    alone, together = bound(kernels[name], numbers()), bound(kernels[name], numbers(), threads)
    for count in (1, 5, 40):
        for got, wanted in zip(together.evaluate(*points_of(count)), alone.evaluate(*points_of(count)), strict=True):
            np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("name", CASES)
def test_searches_are_those_of_one_thread(kernels, name):
    ends = [
        dict(bound(kernels[name], numbers(), threads).climb(*points_of(20), 15, np.full(20, 1e-9)))
        for threads in (1, 2)
    ]
    for p in range(20):
        np.testing.assert_array_equal(ends[1][p].history, ends[0][p].history)
        np.testing.assert_array_equal(ends[1][p].point, ends[0][p].point)


def test_what_follows_from_the_weights_is_that_of_one_thread(kernels):
    """It is made by the team that first needs it."""
    for kernel in kernels.values():
        together = bound(kernel, [2 * column for column in numbers()], 3).evaluate(*points_of(9))
        alone = bound(kernel, [2.0 * column for column in numbers()]).evaluate(*points_of(9))
        for got, wanted in zip(together, alone, strict=True):
            np.testing.assert_array_equal(got, wanted)


MAIN = """
#include <pthread.h>
#include <stdlib.h>
#define THREADS 3
static struct team team = {THREADS};
static struct member members[THREADS];
static const real *shared[N_SHARED + 1];
static real *block, *early_space, *work;
static double points[COUNT * N_ACTIONS], chosen[COUNT * N_SELECTIONS];
static double values[COUNT], gradients[COUNT * N_ACTIONS];
static double ends[COUNT * N_ACTIONS], tolerances[COUNT], scales[COUNT], histories[COUNT * 10];
static double low[N_ACTIONS], high[N_ACTIONS];
static int outcomes[COUNT];
static long long spent[COUNT];
static long next;
static const int stop;
static struct search search;

static real *some(long count) {
  real *const x = aligned_alloc(64, (count * sizeof(real) + 64) / 64 * 64);
  long i;
  for (i = 0; i < count; ++i) x[i] = (real) (sin((double) (i + count)) / 4);
  return x;
}
static void *thread(void *given) {
  struct member *const me = given;
  symgraph_bind(me, shared, block, early_space);
  symgraph_evaluate(me, COUNT, points, chosen, shared, &stop, values, gradients, work);
  symgraph_advance(me, &search, shared, work, 20);
  return 0;
}
int main(void) {
  const long lengths[] = LENGTHS;
  pthread_t threads[THREADS];
  long long sizes[5];
  long i, part;
  struct settings set = {low, high, 10, 0, 0, 0, 0, 0, 0, &stop};
  symgraph_sizes(sizes);
  block = some(sizes[0]);
  early_space = some(sizes[1]);
  work = some(sizes[2]);
  for (i = 0; i < N_SHARED; ++i) shared[i] = some(lengths[i]);
  shared[N_SHARED] = block;
  for (i = 0; i < COUNT * N_ACTIONS; ++i) points[i] = sin((double) i);
  for (i = COUNT / 2; i < COUNT; ++i) chosen[i] = 1;
  for (i = 0; i < COUNT; ++i) { tolerances[i] = 1e-9; scales[i] = 1; outcomes[i] = UNDER_WAY; }
  for (i = 0; i < N_ACTIONS; ++i) { low[i] = -2; high[i] = 2; }
  symgraph_begin(&search, &set, &next, 1, COUNT, points, chosen, tolerances, scales, ends, values, histories, outcomes,
                 spent);
  for (i = 0; i < THREADS; ++i) {
    members[i].team = &team;
    members[i].index = i;
    for (part = i; part < PARTS; part += THREADS) members[i].parts |= 1u << part;
    pthread_create(threads + i, 0, thread, members + i);
  }
  for (i = 0; i < THREADS; ++i) pthread_join(threads[i], 0);
  return !sizes[4] || !isfinite(values[0]);
}
"""


WATCHED = [
    *((name, "lanes") for name in CASES),
    *((name, "narrow") for name in ("straight", "beside")),
    *((name, "lanes, functions not shared") for name in ("mapped", "beside")),
]


@pytest.mark.parametrize(("name", "build"), WATCHED)
def test_no_two_threads_touch_what_one_of_them_writes(name, build, tmp_path, monkeypatch):
    """ThreadSanitizer watches all that generated code reads and writes."""
    if "not shared" in build:
        nothing_that_is_called_is_shared(monkeypatch)
    gcc = shutil.which("gcc")
    if gcc is None or subprocess.run([gcc, "-fsanitize=thread", "-xc", "-", "-o", tmp_path / "probe"],
                                     input=b"int main(void) { return 0; }", check=False).returncode:  # fmt: skip
        pytest.skip("no compiler with ThreadSanitizer")
    (source,) = kernel_source(function_of(CASES[name], N, 1, SHAPES), build != "narrow", single=False)
    lengths = ", ".join(str(m * n) for m, n in SHAPES)
    constants = f"#define COUNT 20\n#define LENGTHS {{{lengths}}}\n#define PARTS {PARTS}\n"
    (tmp_path / "main.c").write_text(source + constants + MAIN)
    flags = ["-std=c11", "-O1", "-march=native", "-fsanitize=thread", "-pthread"]
    subprocess.run([gcc, *flags, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=False, timeout=300)
    if "unexpected memory mapping" in done.stderr:
        pytest.skip("ThreadSanitizer does not run here")
    assert done.returncode == 0, done.stderr[:3000]


def test_other_processors_share_too():
    with code_for("any processor"):
        kernel = compiled(function_of(straight, N, 1, SHAPES))
    for got, wanted in zip(
        *(bound(kernel, numbers(), threads).evaluate(*points_of(9)) for threads in (1, 2)), strict=True
    ):
        np.testing.assert_array_equal(got, wanted)


# The threads


def test_a_team_that_was_interrupted_works_again(kernels):
    kernel = bound(kernels["straight"], numbers(), 2)
    wanted = kernel.evaluate(*points_of(40))

    def go_on():
        while True:
            kernel.evaluate(*points_of(40))

    with pytest.raises(KeyboardInterrupt), ctrl_c_after(0.3):
        go_on()
    for _ in range(5):
        for got, one in zip(kernel.evaluate(*points_of(40)), wanted, strict=True):
            np.testing.assert_array_equal(got, one)


@pytest.mark.parametrize("place", range(3))
def test_nobody_waits_for_a_member_that_failed(place):
    def meet(member):
        index = members.setdefault(member, len(members))
        if index == place:
            raise MemoryError
        team = ctypes.cast(member, ctypes.POINTER(ctypes.c_void_p))[0]
        broken = ctypes.c_int.from_address(team + crew._Team.broken.offset)
        while not broken.value:
            threading.Event().wait(0.001)

    members = {}
    with pytest.raises(MemoryError):
        crew.Crew(1, 3).work(meet, [()])


@pytest.mark.parametrize(("threads", "teams", "members"), [(1, 1, 1), (2, 1, 2), (4, 1, 4), (5, 1, 4), (8, 2, 4)])
def test_more_threads_than_parts_are_several_teams(kernels, threads, teams, members):
    library = kernels["straight"].wide
    assert library.shared
    assert (threads // library.members(threads), library.members(threads)) == (teams, members)


ACCESSES = st.lists(
    st.builds(
        lambda base, begin, size, writes: (Place(base, begin, wide=True), size, writes),
        st.sampled_from(["w", "r0"]),
        st.integers(0, 5),
        st.integers(1, 4),
        st.booleans(),
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=300)
@given(st.lists(st.tuples(st.integers(0, PARTS - 1), ACCESSES), min_size=2, max_size=6))
def test_they_meet_before_one_touches_what_another_one_wrote(steps):
    """Between two meetings nothing that one part writes is touched by another one."""

    def touched(accesses, written):
        return {(a.place.base, a.place.offset + i) for a in accesses if a.writes or not written for i in range(a.size)}

    notes, since = Notes(), []
    for part, accesses in steps:
        step = [Access(place, size, part, writes) for place, size, writes in accesses]
        if notes.forbid(step):
            notes, since = Notes(), []
        notes.add(step)
        for earlier in since:
            if earlier[0].part != part:
                assert not touched(earlier, written=True) & touched(step, written=False)
                assert not touched(earlier, written=False) & touched(step, written=True)
        since.append(step)


# Into parts


def late(function):
    return Hoister(lanes=True).halves(gradient_program(function))[1]


@pytest.mark.parametrize("name", CASES)
def test_parts_are_in_an_order_that_is_possible(name):
    program = late(function_of(CASES[name], N, 1, SHAPES))
    shares = Costs().shares(program)
    assert set(shares.part) == set(program.operations)
    place = {operation: i for i, operation in enumerate(shares.part)}
    for operation in program.operations:
        assert all(place[arg.maker] < place[operation] for arg in operation.args if arg.maker is not None)


def side_by_side(count, size=200):
    """Networks that have nothing to do with each other but the actions and the sum."""

    def body(u, s, *weights):
        outputs = []
        for i in range(count):
            x = ca.sin(weights[3 * i] @ u)
            outputs.append(ca.sumsqr(weights[3 * i + 2] @ ca.tanh(weights[3 * i + 1] @ x)))
        return ca.sum1(ca.vertcat(*outputs))

    return function_of(body, N, 0, [(size, N), (size, size), (4, size)] * count)


@pytest.mark.parametrize(("count", "gain"), [(1, 1.0), (2, 2.0), (3, 1.5), (4, 2.0), (8, 2.0)])
def test_networks_beside_each_other_are_divided_evenly(count, gain):
    assert Costs().shares(late(side_by_side(count))).gain == pytest.approx(gain, rel=0.1)


def test_a_network_and_what_follows_from_it_is_one_threads():
    """Two networks, two threads: they meet at the beginning and at the end."""
    (source,) = kernel_source(side_by_side(2), lanes=True, single=False)
    assert source.split("static void late(")[0].count("  meet(me);") <= 12  # of both halves
