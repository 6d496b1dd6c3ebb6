"""Generated planners in programs of C: they keep to what is theirs, and bad input has an error code each."""

import json
import shutil
import struct
from itertools import pairwise

import pytest
from exported_hosts import CC, COMPILERS, SANITIZERS, C, built, export, identifier, numbers, run
from exported_tasks import situations, task

import symgraph as sg

LARGE = ["pouring 2x32", "pouring 3x200"]
TASKS = ["cannon", "push", "toss", *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)]

# Reads states from its arguments and plans for each, with start points, runs and what is held; prints the values.
PLANS = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define COUNT (sizeof(planner_state) / sizeof(double))
static union { double first; unsigned char bytes[PLANNER_MEMORY]; } memory;
int main(int count, char **words) {
  planner_planner *planner;
  planner_state state;
  planner_options options;
  planner_plan plan;
  planner_point start;
  static planner_run runs[8];
  static planner_outcomes outcomes;
  planner_actions gradient;
  double numbers[COUNT], value, *x = (double *) (void *) &start.actions;
  int *choices = (int *) (void *) &start.selections;
  size_t i, at;
  if (planner_begin(memory.bytes, sizeof memory.bytes, &planner)) return 1;
  for (i = 0; i < sizeof start.actions / sizeof(double); ++i) x[i] = NAN;
  for (i = 0; i < sizeof start.selections / sizeof(int); ++i) choices[i] = -1;
  memset(&options, 0, sizeof options);
  options.starts = options.held = &start;
  options.start_count = 1;
  options.runs = runs;
  options.run_room = 8;
  for (at = 1; at + COUNT <= (size_t) count; at += COUNT) {
    for (i = 0; i < COUNT; ++i) numbers[i] = strtod(words[at + i], NULL);
    memcpy(&state, numbers, sizeof state);
    options.seed = at;
    if (planner_solve(planner, &state, &options, &plan)) return 2;
    if (planner_gradient(planner, &state, &plan.actions, &plan.selections, &value, &gradient)) return 3;
    if (planner_foresee(planner, &state, &plan.actions, &plan.selections, &outcomes)) return 4;
    if (!planner_mean(&outcomes, 0, 0) || planner_mean(&outcomes, -1, 0) || planner_mean(&outcomes, 0, 99)) return 5;
    printf("%.17g %.17g %.17g\\n", plan.value, value, outcomes.value[0]);
  }
  return 0;
}
"""


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", TASKS)
def test_sanitizers_have_nothing_to_say(name, precision, tmp_path):
    folder = export(name, tmp_path, precision=precision)
    words = [word for state in situations(name, 2) for word in numbers(name, state)]
    printed = run(built(folder, identifier(name), PLANS, tmp_path / "plans", *SANITIZERS), *words)
    close = 1e-9 if precision == "double" else 1e-3
    for line in printed.splitlines():
        plan, value, outcome = map(float, line.split())
        assert plan == pytest.approx(value, rel=close, abs=close)
        assert plan == pytest.approx(outcome, rel=close, abs=close)
    assert len(printed.splitlines()) == 2


if shutil.which("valgrind"):  # CI has it

    @pytest.mark.parametrize("name", TASKS)
    def test_valgrind_has_nothing_to_say(name, tmp_path):
        folder = export(name, tmp_path)
        (state,) = situations(name, 1)
        program = built(folder, identifier(name), PLANS, tmp_path / "plans", "-g", "-O1")
        run("valgrind", "-q", "--error-exitcode=9", "--leak-check=full", program, *numbers(name, state))


# Requirements, many combinations, other optimizers


def demanding():
    """A task with requirements, more combinations than starts, a loop, chance and risk."""
    slots = {
        "a": sg.Action(2, low=-1.0, high=1.0),
        "x": sg.State(2),
        **{f"s{i}": sg.Selection(["p", "q", "r"]) for i in range(2)},
    }
    graph = sg.Graph(slots, start="here")
    for i in range(2):
        graph.choose(
            f"n{i}" if i else "here",
            f"s{i}",
            {
                choice: (f"n{i + 1}", sg.Model(lambda x, a, c=c: {"x": 0.8 * x + c * a}))
                for choice, c in zip("pqr", (0.3, -0.5, 1.1), strict=True)
            },
        )
    graph.chance("n2", {"left": ("end", None), "right": ("end", lambda x: {"x": -x})}, {"left": 0.3, "right": 0.7})
    graph.reward("end", lambda x: -((x[0] - 0.7) ** 2) - (x[1] + 0.2) ** 2)
    graph.require("n1", lambda x: x[0], high=0.3)
    graph.require("end", lambda x: x[0] + x[1], low=-0.9, high=0.9, confidence=0.9)
    graph.require("n1", lambda a: a[0] - a[1], low=0.1, high=0.1)
    return sg.Objective(sg.unroll(graph), risk=0.5)


OPTIMIZERS = {
    "lbfgs": sg.Lbfgs(),
    "few starts": sg.Lbfgs(starts=4, samples=4),
    "adadelta": sg.Adadelta(starts=6),
    "paper": sg.Adadelta.paper(),
    "enumerate": sg.Enumerate(sg.Lbfgs(starts=2)),
}
STATE = {"x": sg.Gaussian([0.4, -0.3], sd=[0.1, 0.2])}


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_requirements_and_optimizers(optimizer, tmp_path):
    objective = demanding()
    one = OPTIMIZERS[optimizer]
    planner = sg.CPlanner(sg.export_c(objective, tmp_path, name="task", optimizer=one, uncertain=["x"]))
    plan, made = sg.solve(objective, STATE, one), planner.solve(STATE)
    assert made.selections == plan.selections
    assert made.value == pytest.approx(plan.value, rel=1e-6)
    assert made.violation == pytest.approx(plan.violation, abs=1e-7)
    assert made.status == plan.status
    if optimizer in ("few starts", "paper"):  # all that is written is in one of them
        words = [repr(float(x)) for x in (0.4, -0.3, 0.01, 0.0, 0.0, 0.04)]
        run(built(tmp_path, "task", PLANS, tmp_path / "plans", *SANITIZERS), *words)


# Bad input

ERRORS = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
static double zero(void *user) { (void) user; return 0; }
#define EXPECT(call, status) \\
  do { \\
    const int got = (call); \\
    if (got != (status)) { printf("%s: %d, %s\\n", #call, got, planner_message(got)); return 1; } \\
  } while (0)
static planner_planner *other;
static planner_state state;
static int nested(void *user, const planner_plan *best) {
  planner_plan plan;
  (void) best;
  *(int *) user = planner_solve(other, &state, 0, &plan);
  return 1;
}
int main(void) {
  /* exactly as much memory as is wanted, so that the sanitizer sees each byte beyond */
  unsigned char *memory = (unsigned char *) malloc(PLANNER_MEMORY);
  planner_planner *planner = 0, *none;
  planner_options options;
  planner_plan plan;
  planner_point point;
  planner_actions gradient;
  double value = 0;
  int inner = 0;
  memset(&state, 0, sizeof state);
  memset(&options, 0, sizeof options);
  memset(&point, 0, sizeof point);
  state.speed = 3;
  state.target[0] = 1.3;
  state.target[1] = 0.3;
  state.upper_muzzle[1] = 0.8;
  EXPECT(planner_begin(memory, 100, &none), PLANNER_MEMORY_TOO_SMALL);
  EXPECT(planner_begin(memory, PLANNER_MEMORY - 1, &none), PLANNER_MEMORY_TOO_SMALL);
  EXPECT(planner_begin(memory + 1, PLANNER_MEMORY, &none), PLANNER_MISALIGNED);
  EXPECT(planner_begin(0, PLANNER_MEMORY, &none), PLANNER_NULL);
  EXPECT(planner_begin(memory, PLANNER_MEMORY, 0), PLANNER_NULL);
  memset(memory, 0, PLANNER_MEMORY);
  EXPECT(planner_solve((planner_planner *) (void *) memory, &state, 0, &plan), PLANNER_NOT_BEGUN);
  EXPECT(planner_begin(memory, PLANNER_MEMORY, &planner), PLANNER_OK);
  EXPECT(planner_solve(0, &state, 0, &plan), PLANNER_NULL);
  EXPECT(planner_solve(planner, 0, 0, &plan), PLANNER_NULL);
  EXPECT(planner_solve(planner, &state, 0, 0), PLANNER_NULL);
  state.target[1] = NAN;
  EXPECT(planner_solve(planner, &state, 0, &plan), PLANNER_STATE_NOT_FINITE);
  EXPECT(planner_value(planner, &state, &point.actions, &point.selections, &value), PLANNER_STATE_NOT_FINITE);
  state.target[1] = -INFINITY;
  EXPECT(planner_solve(planner, &state, 0, &plan), PLANNER_STATE_NOT_FINITE);
  state.target[1] = 0.3;
  options.starts = &point;
  options.start_count = 1;
  point.actions.theta = 2;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_ACTION);
  point.actions.theta = INFINITY;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_ACTION);
  EXPECT(planner_gradient(planner, &state, &point.actions, &point.selections, &value, &gradient), PLANNER_ACTION);
  point.actions.theta = NAN;
  EXPECT(planner_value(planner, &state, &point.actions, &point.selections, &value), PLANNER_ACTION);
  point.actions.theta = 0.1;
  point.selections.cannon = 2;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_CHOICE);
  EXPECT(planner_value(planner, &state, &point.actions, &point.selections, &value), PLANNER_CHOICE);
  point.selections.cannon = -2;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_CHOICE);
  point.selections.cannon = -1;
  EXPECT(planner_value(planner, &state, &point.actions, &point.selections, &value), PLANNER_CHOICE);
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_OK);
  options.start_count = PLANNER_MOST_STARTS + 1;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_OPTION);
  options.start_count = 1;
  options.starts = 0;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_NULL);
  memset(&options, 0, sizeof options);
  options.held = &point;
  point.actions.theta = -1.6;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_ACTION);
  memset(&options, 0, sizeof options);
  options.seconds = 1;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_OPTION);
  options.clock = zero;
  options.seconds = NAN;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_OPTION);
  options.seconds = 0;
  options.evaluations = -1;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_OPTION);
  options.evaluations = 3;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_EVALUATION_LIMIT);
  EXPECT(plan.evaluations == 3 && plan.found ? 0 : 1000 + (int) plan.evaluations, 0);
  options.evaluations = 0;
  other = planner;
  options.progress = nested;
  options.user = &inner;
  EXPECT(planner_solve(planner, &state, &options, &plan), PLANNER_INTERRUPTED);
  EXPECT(inner, PLANNER_BUSY);
  state.speed = 0; /* the bullet never arrives */
  EXPECT(planner_solve(planner, &state, 0, &plan), PLANNER_NO_PLAN);
  state.speed = 3;
  EXPECT(planner_solve(planner, &state, 0, &plan), PLANNER_OK);
  free(memory);
  return 0;
}
"""


@pytest.mark.parametrize("compiler", [CC, *({"g++"} & set(COMPILERS))])
def test_bad_input_has_an_error_code_each(compiler, tmp_path):
    folder = export("cannon", tmp_path)
    flags = (compiler, *C) if compiler == CC else COMPILERS[compiler]
    program = built(folder, "cannon", ERRORS, tmp_path / "errors", *SANITIZERS, compiler=flags)
    assert run(program) == ""


def test_bad_covariances(tmp_path):
    folder = export("push", tmp_path)
    program = built(folder, "push", PLANS, tmp_path / "plans", *SANITIZERS)
    good = numbers("push", next(iter(situations("push", 1))))
    run(program, *good)
    for place, number in ((4, "-0.01"), (5, "0.001"), (4, "nan")):
        run(program, *good[:place], number, *good[place + 1 :], status=2)


WEIGHTS = """
#include <stdio.h>
#include <stdlib.h>
static double memory[PLANNER_MEMORY / 8 + 1];
int main(int count, char **words) {
  FILE *file = fopen(words[count - 1], "rb");
  unsigned char *weights;
  size_t bytes;
  planner_planner *planner;
  if (!file) return 1;
  fseek(file, 0, SEEK_END);
  bytes = (size_t) ftell(file);
  rewind(file);
  weights = (unsigned char *) malloc(bytes ? bytes : 1); /* each byte beyond would be seen */
  if (fread(weights, 1, bytes, file) != bytes) return 1;
  fclose(file);
  printf("%d\\n", planner_begin(memory, sizeof memory, weights, bytes, &planner));
  free(weights);
  return 0;
}
"""


def test_weights_that_are_damaged(tmp_path):
    folder = export("toss", tmp_path, weights="file")
    other = export("toss", tmp_path / "single", weights="file", precision="single")
    program = built(folder, "toss", WEIGHTS, tmp_path / "weights", *SANITIZERS)
    content = (folder / "toss.weights").read_bytes()
    ok, length, damaged, not_its_own = 0, -12, -13, -14
    flipped = [content[:i] + bytes([content[i] ^ 1 << i % 8]) + content[i + 1 :] for i in range(0, len(content), 997)]
    cases = [
        (content, ok),
        (content[:-1], length),
        (content[:-8], length),
        (content[:31], length),
        (b"", length),
        (content + bytes(8), length),
        ((other / "toss.weights").read_bytes(), not_its_own),
        *((one, damaged) for one in flipped),
    ]
    for case, status in cases:
        (tmp_path / "case").write_bytes(case)
        assert run(program, tmp_path / "case").strip() == str(status)


def test_damaged_weights_are_told_in_python(tmp_path):
    folder = export("toss", tmp_path, weights="file")
    path = folder / "toss.weights"
    content = path.read_bytes()
    path.write_bytes(content[:-8])
    with pytest.raises(sg.StorageError, match=r"cut short.*export the planner again"):
        sg.CPlanner(folder)
    path.unlink()
    with pytest.raises(sg.StorageError, match=r"weights cannot be read.*export the planner again"):
        sg.CPlanner(folder)


def test_weights_fitted_anew_need_no_build(tmp_path):
    objective, uncertain = task("toss")
    folder = export("toss", tmp_path / "before", weights="file")
    parameter = next(p for model in objective.tree.models for p in model.parameters if p.value.size > 50)
    kept = parameter.value
    try:
        parameter.value = kept * 1.1
        after = sg.export_c(objective, tmp_path / "after", name="toss", uncertain=uncertain, weights="file")
        assert (after / "toss.c").read_text() == (folder / "toss.c").read_text()
        shutil.copy(after / "toss.weights", folder)
        (state,) = situations("toss", 1)
        plan = sg.CPlanner(folder).solve(state)
        assert plan.value == pytest.approx(sg.solve(objective, state).value, rel=1e-9)
    finally:
        parameter.value = kept


# Threads, time, stack

THREADS = """
#include <pthread.h>
#include <stdio.h>
#include <string.h>
static double memories[2][PLANNER_MEMORY / 8 + 1];
static double values[2];
static void *plan(void *place) {
  const long i = (long) (size_t) place;
  planner_planner *planner;
  planner_state state;
  planner_plan made;
  int n;
  memset(&state, 0, sizeof state);
  state.speed = 3;
  state.target[0] = 1.0 + (double) i;
  state.upper_muzzle[1] = 0.8;
  if (planner_begin(memories[i], sizeof memories[i], &planner)) return 0;
  for (n = 0; n < 50; ++n) planner_solve(planner, &state, 0, &made);
  values[i] = made.value;
  return 0;
}
int main(void) {
  pthread_t threads[2];
  double together[2];
  long i;
  for (i = 0; i < 2; ++i) pthread_create(threads + i, 0, plan, (void *) (size_t) i);
  for (i = 0; i < 2; ++i) pthread_join(threads[i], 0);
  for (i = 0; i < 2; ++i) {
    together[i] = values[i];
    plan((void *) (size_t) i);
    if (values[i] != together[i] || values[i] == 0) return 1;
  }
  return 0;
}
"""


def test_two_planners_in_two_threads(tmp_path):
    folder = export("cannon", tmp_path)
    run(built(folder, "cannon", THREADS, tmp_path / "threads", "-g", "-O1", "-fsanitize=thread"))


# Paints the stack of a thread, plans on it, and prints how much of it is not painted any more.
STACK = """
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define ROOM (1 << 20)
static double memory[PLANNER_MEMORY / 8 + 1];
static double numbers[4096];
static planner_outcomes outcomes;
static void *plan(void *place) {
  planner_planner *planner;
  planner_state state;
  planner_plan made;
  planner_actions gradient;
  double value;
  memcpy(&state, numbers, sizeof state);
  *(char **) place = (char *) &value;
  if (planner_begin(memory, sizeof memory, &planner) || planner_solve(planner, &state, 0, &made)) exit(1);
  planner_gradient(planner, &state, &made.actions, &made.selections, &value, &gradient);
  planner_foresee(planner, &state, &made.actions, &made.selections, &outcomes);
  return 0;
}
int main(int count, char **words) {
  char *stack = (char *) malloc(ROOM), *top = 0, *at = stack;
  pthread_attr_t attributes;
  pthread_t thread;
  int i;
  for (i = 1; i < count; ++i) numbers[i - 1] = strtod(words[i], 0);
  memset(stack, 0x5a, ROOM);
  pthread_attr_init(&attributes);
  pthread_attr_setstack(&attributes, stack, ROOM);
  if (pthread_create(&thread, &attributes, plan, &top)) return 2;
  pthread_join(thread, 0);
  while (at < top && *at == 0x5a) ++at;
  printf("%ld\\n", (long) (top - at));
  return 0;
}
"""


@pytest.mark.parametrize("flags", [("-O0",), ("-O3",)], ids=str)
@pytest.mark.parametrize("name", TASKS)
def test_it_takes_no_more_stack_than_it_says(name, flags, tmp_path):
    folder = export(name, tmp_path)
    (state,) = situations(name, 1)
    program = built(folder, identifier(name), STACK, tmp_path / "stack", *flags)
    used = int(run(program, *numbers(name, state)))
    said = json.loads((folder / f"{identifier(name)}.json").read_text())["stack"]
    print(f"{name} {flags}: {used} of {said} bytes")
    assert used <= said


TIME = """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
/* A clock that is asked how often it was asked: each evaluation takes one second. */
static double now;
static double tell(void *user) { (void) user; return now; }
static int count(void *user, const planner_plan *best) { (void) user; (void) best; now = best->evaluations; return 0; }
static double memory[PLANNER_MEMORY / 8 + 1];
int main(int words, char **word) {
  planner_planner *planner;
  planner_options options;
  planner_state state;
  planner_plan plan;
  int budget;
  (void) words;
  memset(&state, 0, sizeof state);
  memset(&options, 0, sizeof options);
  state.speed = 3;
  state.target[0] = 1.3;
  state.target[1] = 0.3;
  state.upper_muzzle[1] = 0.8;
  options.clock = tell;
  options.progress = count;
  if (planner_begin(memory, sizeof memory, &planner)) return 1;
  for (budget = 1; budget < atoi(word[1]); budget = budget * 5 / 4 + 1) {
    now = 0;
    options.seconds = budget;
    if (planner_solve(planner, &state, &options, &plan) > 1) return 2;
    printf("%d %ld %.17g\\n", budget, plan.evaluations, plan.value);
  }
  return 0;
}
"""


def test_time_is_kept_to_one_evaluation_and_more_of_it_is_no_worse(tmp_path):
    folder = export("cannon", tmp_path)
    printed = run(built(folder, "cannon", TIME, tmp_path / "time", *SANITIZERS), 1000)
    rows = [tuple(map(float, line.split())) for line in printed.splitlines()]
    for budget, spent, _ in rows:
        assert spent <= budget + 1
    best = rows[-1][2]
    for (_, _, before), (_, _, after) in pairwise(rows):
        assert after >= before - 0.1 * abs(best - rows[0][2])
    assert struct.pack("d", best) == struct.pack("d", sg.CPlanner(folder).solve(STATES["cannon"]).value) or best == (
        pytest.approx(sg.CPlanner(folder).solve(STATES["cannon"]).value, rel=1e-12)
    )


STATES = {"cannon": {"speed": 3.0, "target": [1.3, 0.3], "lower_muzzle": [0.0, 0.0], "upper_muzzle": [0.0, 0.8]}}
