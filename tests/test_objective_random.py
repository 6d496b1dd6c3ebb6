"""The objective on random graphs against an oracle that shares no code with it."""

import numpy as np
import pytest
from random_tasks import break_unselected, broken_matters, random_problem, to_symgraph

import symgraph as sg

SEEDS = range(200)
COMPILED_SEEDS = range(0, 200, 25)  # a C compiler takes seconds for each
CHOICE_SEEDS = range(20)  # of the problems in which another selection would meet a broken model
COMPILED_CHOICE_SEEDS = range(0, 20, 5)

# Two programs that add the same terms in another order agree to rounding.
ROUNDING = 1e-10
# Central differences at h and h/2, the h^2 term extrapolated away, leave about h^4 J^(5) / 480 and rounding
# of about 1e-15 |J| / h. At h = 1e-3 both are near 1e-12 |J|: the worst of the seeds is 6e-13 off for the
# gradient and 2e-12 for the Hessian, relative to 1 + the largest number. The rest is room for noisier digits.
STEP = 1e-3
DIFFERENCES = 1e-9


class Case:
    """A random problem with the objective that symgraph makes of it."""

    def __init__(self, problem, **options):
        self.problem = problem
        graph, unroll_options, (self.state, self.actions, self.selections) = to_symgraph(problem)
        self.objective = sg.Objective(sg.unroll(graph, **unroll_options), **options)

    def value(self):
        return self.objective.value(self.state, self.actions, self.selections)

    def gradient(self):
        return self.gradient_at(self.problem.point)

    def gradient_at(self, point):
        actions = self.problem.split(point)
        gradient = self.objective.gradient(self.state, actions, self.selections)
        return np.concatenate([np.atleast_1d(gradient[label]) for label in actions])

    def hessian(self):
        return self.objective.hessian(self.state, self.actions, self.selections)

    def evaluate(self, points):
        return self.objective.evaluate(self.state, points, self.selections)


@pytest.fixture(scope="module", params=SEEDS, ids="seed{}".format)
def case(request):
    return Case(random_problem(request.param), compiled=False)


def differences(function, point):
    """Derivatives along each coordinate, the coordinate last."""

    def central(h):
        shifts = h * np.eye(len(point))
        return np.stack([(function(point + s) - function(point - s)) / (2 * h) for s in shifts], axis=-1)

    return (4 * central(STEP / 2) - central(STEP)) / 3


def assert_agree(got, expected, tolerance, scale=0.0):
    """Within the tolerance relative to 1 + the largest number at play."""
    assert np.shape(got) == np.shape(expected)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * (1 + max(np.max(np.abs(expected)), abs(scale))))


def test_value_equals_the_oracle(case):
    value = case.value()
    assert isinstance(value, float)
    assert_agree(value, case.problem.value_at(case.problem.point), ROUNDING)


def test_gradient_equals_differences_of_the_oracle(case):
    problem = case.problem
    expected = differences(problem.value_at, problem.point)
    assert_agree(case.gradient(), expected, DIFFERENCES, scale=case.value())


def test_gradient_comes_back_by_label(case):
    gradient = case.objective.gradient(case.state, case.actions, case.selections)
    assert list(gradient) == list(case.problem.action_sizes)
    for label, size in case.problem.action_sizes.items():
        if size == 1:
            assert isinstance(gradient[label], float)
        else:
            assert gradient[label].shape == (size,)


def test_hessian_equals_differences_of_the_gradient(case):
    hessian = case.hessian()
    expected = differences(case.gradient_at, case.problem.point)
    assert_agree(hessian, expected, DIFFERENCES, scale=np.max(np.abs(case.gradient())))
    assert_agree(hessian, hessian.T, ROUNDING)


def test_columns_are_evaluated_as_single_points_are(case):
    """Widths of one and of one more than a batch kernel is likely to be wide."""
    problem = case.problem
    spread = np.random.default_rng(5).uniform(-0.3, 0.3, (len(problem.point), 17))
    points = problem.point[:, None] + np.c_[np.zeros(len(problem.point)), spread[:, 1:]]
    values, gradients = case.evaluate(points)
    assert values.shape == (17,)
    assert_agree(values[[0, -1]], [problem.value_at(point) for point in points.T[[0, -1]]], ROUNDING)
    assert_agree(gradients, np.stack([case.gradient_at(point) for point in points.T], axis=1), ROUNDING)
    value, gradient = case.evaluate(points[:, :1])
    assert_agree(value, values[:1], ROUNDING)
    assert_agree(gradient, gradients[:, :1], ROUNDING)


@pytest.mark.parametrize("seed", COMPILED_SEEDS)
def test_compiled_objective_equals_the_interpreted_one(seed):
    problem = random_problem(seed)
    compiled, interpreted = Case(problem), Case(problem, compiled=False)
    assert_agree(compiled.value(), problem.value_at(problem.point), ROUNDING)
    assert_same_calculus(compiled, interpreted)


@pytest.mark.parametrize("seed", CHOICE_SEEDS)
def test_a_model_broken_in_an_unselected_branch_is_not_seen(seed):
    problem = random_problem(seed, choice_matters=True)
    broken = break_unselected(problem)
    assert broken_matters(broken)
    assert_same_calculus(Case(broken, compiled=False), Case(problem, compiled=False))


@pytest.mark.parametrize("seed", COMPILED_CHOICE_SEEDS)
def test_a_model_broken_in_an_unselected_branch_is_not_seen_when_compiled(seed):
    problem = random_problem(seed, choice_matters=True)
    assert_same_calculus(Case(break_unselected(problem)), Case(problem, compiled=False))


def assert_same_calculus(one, other):
    """Value, gradient, Hessian and a batch: finite and equal."""
    points = other.problem.point[:, None] + np.linspace(0, 0.2, 3)
    for got, expected in [
        (one.value(), other.value()),
        (one.gradient(), other.gradient()),
        (one.hessian(), other.hessian()),
        *zip(one.evaluate(points), other.evaluate(points), strict=True),
    ]:
        assert np.isfinite(got).all()
        assert_agree(got, expected, ROUNDING)
