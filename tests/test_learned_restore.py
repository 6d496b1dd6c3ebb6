"""Restore: a model takes over in place what another has saved, and whatever holds it goes on with that."""

import numpy as np
import pytest
from small_tasks import refuses
from stored_models import HAPPENED, HIDDEN, READS, WRITES, X, Y, fitted, fitted_branches, same

import symgraph as sg
from symgraph.learned import BranchNetwork, StochasticNetwork

MORE = np.vstack([X, X[:5] + 0.01]), np.vstack([Y, Y[:5]])  # few enough for a warm start
BRANCHES = ["in", "out"]


def unfitted(error="likelihood", **options):
    return StochasticNetwork(READS, WRITES, HIDDEN, error=error, **options)


def unfitted_branches():
    return BranchNetwork({"x": 3}, BRANCHES, (6,), name="falls")


def objective_with(network):
    """The expected sum of what the network writes, over x and u."""
    slots = {"x": sg.State(2), "u": sg.Action(low=-1.0, high=1.0), "y": sg.State(), "z": sg.State(2)}
    graph = sg.Graph(slots, start="before")
    graph.edge("before", "after", network)
    graph.reward("after", lambda y, z: y + z[0] + z[1])
    return sg.Objective(sg.unroll(graph))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A fitted network and its file."""
    path = tmp_path_factory.mktemp("models") / "network"
    network = fitted()
    network.save(path)
    return network, path


@pytest.mark.parametrize("before", ["unfitted", "fitted otherwise"])
def test_an_objective_that_was_built_before_plans_with_the_restored_weights(saved, before):
    network, path = saved
    restored = unfitted()
    if before != "unfitted":
        restored.fit(-X, Y, progress=False)
    objective = objective_with(restored)
    state, actions = {"x": X[3, :2]}, {"u": 0.3}
    objective.value(state, actions)  # so that everything is built
    restored.restore(path)
    mean = network.predict([*X[3, :2], 0.3])[0]
    assert objective.value(state, actions) == pytest.approx(mean.sum(), rel=1e-10)
    u = np.linspace(-1.0, 1.0, 401)
    sums = network.predict(np.column_stack([np.tile(X[3, :2], (401, 1)), u]))[0].sum(axis=1)
    plan = sg.solve(objective, state, progress=False)
    assert not plan.status.startswith("exploring")
    assert plan.value >= sums.max() - 1e-6 * np.ptp(sums)


def test_a_model_that_explored_plans_after_it(saved):
    restored = unfitted()
    objective = objective_with(restored)
    assert sg.solve(objective, {"x": X[0, :2]}, progress=False).status.startswith("exploring")
    restored.restore(saved[1])
    assert restored.lacking is None
    assert not sg.solve(objective, {"x": X[0, :2]}, progress=False).status.startswith("exploring")


def test_views_take_part(saved):
    network, path = saved
    restored = unfitted()
    view = restored.with_propagation("diagonal")
    parameters = restored.parameters
    restored.restore(path)
    assert all(p is q for p, q in zip(restored.parameters, parameters, strict=True))
    assert view.samples == restored.samples == 40
    assert view.propagation == "diagonal"
    expected = network.with_propagation("diagonal").predict(X[0], 0.1 * np.eye(3))
    for found, wanted in zip(view.predict(X[0], 0.1 * np.eye(3)), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)
    view.fit(*MORE, progress=False)
    assert restored.samples == 45


@pytest.mark.parametrize(
    "options", [{}, {"error": "paper"}, {"error": "none"}, {"start": "linear", "decay": 1.0}], ids=str
)
@pytest.mark.parametrize("begun", [False, True])
def test_the_next_fit_is_that_of_the_model_that_was_saved(options, begun, tmp_path):
    network, restored = fitted(**options), unfitted(**options)
    if begun:
        restored.fit(X[:7] + 1.0, Y[:7], progress=False)
    network.save(tmp_path / "network")
    restored.restore(tmp_path / "network")
    same(restored, network)
    for model in (network, restored):
        assert model.fit(*MORE, seed=3, progress=False).warm
    same(restored, network)
    for found, wanted in zip(restored.predict(X), network.predict(X), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_branches_are_restored_likewise(tmp_path):
    network, restored = fitted_branches(), unfitted_branches()
    graph = sg.Graph({"x": sg.State(3)}, start="n")
    graph.chance("n", {"in": ("a", None), "out": ("b", None)}, restored)
    graph.reward("a", lambda: 1.0)
    objective = sg.Objective(sg.unroll(graph))
    assert objective.value({"x": X[0]}) == pytest.approx(0.5)
    network.save(tmp_path / "network")
    restored.restore(tmp_path / "network")
    same(restored, network)
    assert objective.value({"x": X[0]}) == pytest.approx(network.predict(X[0])[0], rel=1e-10)
    for model in (network, restored):
        assert model.fit(MORE[0], HAPPENED + HAPPENED[:5], seed=3, progress=False).warm
    same(restored, network)


def test_what_was_saved_does_not_follow_what_is_restored(tmp_path):
    """Neither model holds arrays of the other, and the file can go."""
    network, restored = fitted(), unfitted()
    network.save(tmp_path / "network")
    restored.restore(tmp_path / "network")
    (tmp_path / "network").unlink()
    before = network.predict(X)[0]
    restored.fit(2 * X, -Y, progress=False)
    np.testing.assert_array_equal(network.predict(X)[0], before)


def test_a_model_without_samples_unlearns(saved, tmp_path):
    unfitted().save(tmp_path / "empty")
    restored = unfitted()
    restored.restore(saved[1])
    restored.restore(tmp_path / "empty")
    same(restored, unfitted())
    assert restored.lacking == "0 of 3 samples"


OTHER = {
    "name": (lambda: unfitted(name="flow"), ["name = 'network', 'flow' has 'flow'"]),
    "reads": (lambda: StochasticNetwork({"x": 3}, WRITES, HIDDEN), ["reads = {'x': 2, 'u': 1}", "has {'x': 3}"]),
    "reads in another order": (
        lambda: StochasticNetwork({"u": 1, "x": 2}, WRITES, HIDDEN),
        ["reads = {'x': 2, 'u': 1}", "has {'u': 1, 'x': 2}"],
    ),
    "writes": (lambda: StochasticNetwork(READS, {"y": 3}, HIDDEN), ["writes = {'y': 1, 'z': 2}", "has {'y': 3}"]),
    "writes in another order": (
        lambda: StochasticNetwork(READS, {"z": 2, "y": 1}, HIDDEN),
        ["writes = {'y': 1, 'z': 2}", "has {'z': 2, 'y': 1}"],
    ),
    "hidden": (lambda: StochasticNetwork(READS, WRITES, (8, 6)), ["hidden = (8, 5)", "has (8, 6)"]),
    "propagation": (lambda: unfitted(propagation="mean"), ["propagation = 'auto'", "has 'mean'"]),
    "error": (lambda: unfitted("paper"), ["error = 'likelihood'", "has 'paper'"]),
    "samples_needed": (lambda: unfitted(samples_needed=4), ["samples_needed = 3", "has 4"]),
    "resolution": (lambda: unfitted(resolution={"u": 0.1}), ["resolution = {}", "has {'u': [0.1]}"]),
}


@pytest.mark.parametrize("case", OTHER)
def test_a_model_of_other_settings_is_refused_and_nothing_changes(saved, case):
    make, words = OTHER[case]
    model = make()
    remedy = "make it with the same settings, or load the file as a new model"
    refuses(lambda: model.restore(saved[1]), sg.StorageError, str(saved[1]), *words, remedy)
    assert (model.settings, model.samples) == (make().settings, 0)
    for p, q in zip(model.parameters, make().parameters, strict=True):
        np.testing.assert_array_equal(p.value, q.value)


def test_branches_in_another_order_are_refused(tmp_path):
    fitted_branches().save(tmp_path / "file")
    other = BranchNetwork({"x": 3}, BRANCHES[::-1], (6,), name="falls")
    refuses(lambda: other.restore(tmp_path / "file"), sg.StorageError, "branches = ('in', 'out')", "('out', 'in')")


def test_the_order_of_resolutions_does_not_matter(tmp_path):
    one, other = unfitted(resolution={"u": 0.1, "x": 0.2}), unfitted(resolution={"x": (0.2, 0.2), "u": 0.1})
    one.save(tmp_path / "file")
    other.restore(tmp_path / "file")


def test_what_cannot_be_loaded_is_refused_and_nothing_changes(saved, tmp_path):
    network, path = saved
    restored = fitted()
    (tmp_path / "cut").write_bytes(path.read_bytes()[:-9])
    fitted_branches().save(tmp_path / "branches")
    refuses(lambda: restored.restore(tmp_path / "none"), sg.StorageError, "none cannot be read")
    refuses(lambda: restored.restore(tmp_path / "cut"), sg.StorageError, "cut off")
    refuses(
        lambda: restored.restore(tmp_path / "branches"),
        sg.StorageError,
        "holds a 'BranchNetwork', not a StochasticNetwork",
    )
    same(restored, network)
