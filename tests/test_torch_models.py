"""Modules of torch as models: what they read and write, live weights, Gaussians, ensembles, processes, the cache."""

import copy
import json
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
import torch
from small_tasks import objective_of, refuses
from torch import nn
from torch.nn import functional as F

import symgraph as sg
from symgraph.compile import toolchain
from symgraph.learned.torch_modules import cache, exporting

from_torch = sg.learned.from_torch


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def mlp(inputs=2, outputs=1, hidden=8, kind=nn.Tanh):
    return nn.Sequential(nn.Linear(inputs, hidden), kind(), nn.Linear(hidden, outputs))


def value(module, *inputs):
    """What torch computes in double precision."""
    with torch.no_grad():
        return copy.deepcopy(module).double().eval()(*(torch.as_tensor(x, dtype=torch.float64) for x in inputs))


def task(model, reads=("a", "b"), goal=0.3, uncertain=(), compiled=False, reward=None):
    """Actions where they are not named uncertain; the reward is largest where y is the goal."""
    slots = {label: sg.State() if label in uncertain else sg.Action(low=-2.0, high=2.0) for label in reads}
    graph = sg.Graph(slots | {"y": sg.State()}, start="before")
    graph.edge("before", "after", model)
    graph.reward("after", reward or (lambda y: -((y - goal) ** 2)))
    return objective_of(graph, compiled=compiled)


def outcome(objective, state, actions):
    return objective.outcomes(state, actions)[-1].states["y"]


# What modules read and write


def test_labels_stand_beside_each_other_in_one_row():
    net = mlp(3, 2)
    slots = {"a": sg.Action(2, low=-1, high=1), "b": sg.State(), "y": sg.State(), "z": sg.State()}
    graph = sg.Graph(slots, start="s")
    graph.edge("s", "e", from_torch(net, {"a": 2, "b": 1}, {"y": 1, "z": 1}))
    graph.reward("e", lambda y, z: 10 * y + z)
    y, z = value(net, [[0.1, -0.2, 0.7]])[0]
    found = objective_of(graph).value({"b": 0.7}, {"a": [0.1, -0.2]})
    assert found == pytest.approx(float(10 * y + z), rel=1e-14)


class TwoTensors(nn.Module):
    def __init__(self):
        super().__init__()
        self.cell = nn.LSTMCell(2, 3)

    def forward(self, x, h):
        h, c = self.cell(x, (h, torch.zeros_like(h)))
        return {"h": h, "c": c}


def test_several_tensors_in_and_out():
    net = TwoTensors()
    slots = {"x": sg.Action(2, low=-1, high=1), "h": sg.State(3), "c": sg.State(3)}
    graph = sg.Graph(slots, start="s")
    graph.edge("s", "e", from_torch(net, [{"x": 2}, {"h": 3}], [{"h": 3}, {"c": 3}]))
    graph.reward("e", lambda h, c: ca.sum1(h) + 10 * ca.sum1(c))
    x, h = [0.4, -0.3], [0.1, 0.2, 0.3]
    made = value(net, [x], [h])
    found = objective_of(graph).value({"h": h}, {"x": x})
    assert found == pytest.approx(float(made["h"].sum() + 10 * made["c"].sum()), rel=1e-14)


def test_outputs_that_nobody_needs_are_left_out():
    model = from_torch(TwoTensors(), [{"x": 2}, {"h": 3}], [{}, {"c": 3}])
    assert model.writes == {"c": 3}


def test_a_shape_gives_a_label_a_tensor_of_its_own():
    """The last index runs fastest."""
    net = nn.Sequential(nn.Conv1d(2, 3, 2), nn.Flatten(), nn.Linear(9, 1))
    window = np.arange(8.0) / 8
    slots = {"window": sg.State(8), "u": sg.Action(low=0, high=1), "y": sg.State()}
    graph = sg.Graph(slots, start="s")
    graph.edge("s", "e", from_torch(net, {"window": (1, 2, 4)}, {"y": 1}))
    graph.reward("e", lambda y, u: y - u**2)
    found = objective_of(graph).value({"window": window}, {"u": 0.0})
    assert found == pytest.approx(float(value(net, window.reshape(1, 2, 4))), rel=1e-14)


def test_one_label_may_fill_several_tensors():
    class Attention(nn.Module):
        def __init__(self):
            super().__init__()
            self.inner = nn.MultiheadAttention(4, 2, batch_first=True)

        def forward(self, q, k, v):
            return self.inner(q, k, v, need_weights=False)[0]

    net = Attention()
    model = from_torch(net, [{"x": (1, 2, 4)}] * 3, {"y": 8})
    x = np.linspace(-1, 1, 8)
    tensor = x.reshape(1, 2, 4)
    np.testing.assert_allclose(model.predict(x)[0], value(net, tensor, tensor, tensor).flatten(), atol=1e-15)


def test_a_module_as_reward_and_as_probability():
    classes = nn.Sequential(nn.Linear(1, 2), nn.Softmax(-1))
    worth = mlp(1, 1)
    graph = sg.Graph({"u": sg.Action(low=-1, high=1), "x": sg.State()}, start="s")
    graph.chance("s", {"up": ("top", None), "down": ("pit", None)}, from_torch(classes, {"u": 1}, {"up": 1, "down": 1}))
    graph.reward("top", from_torch(worth, {"u": 1}, {"worth": 1}))
    p = value(classes, [[0.3]])[0]
    found = objective_of(graph).value({}, {"u": 0.3})
    assert found == pytest.approx(float(p[0] * value(worth, [[0.3]])[0, 0]), rel=1e-13)


def test_rename_fits_a_module_to_other_labels():
    model = sg.Model(from_torch(mlp(), {"p": 1, "q": 1}, {"r": 1}), rename={"p": "a", "q": "b", "r": "y"})
    assert np.isfinite(sg.solve(task(model), {}).value)


def test_the_module_is_left_as_it_was():
    net = nn.Sequential(nn.Linear(2, 4), nn.BatchNorm1d(4), nn.Dropout(0.5), nn.Linear(4, 1)).train()
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    from_torch(net, {"a": 1, "b": 1}, {"y": 1})
    assert net.training
    assert all(part.dtype in (torch.float32, torch.int64) for part in net.state_dict().values())
    assert all(torch.equal(tensor, before[name]) for name, tensor in net.state_dict().items())
    assert torch.get_default_dtype() == torch.float32


LABELS = [
    ({}, {"y": 1}, "reads = {}; give {label: number of elements}"),
    ({"a": 0}, {"y": 1}, "reads: size of 'a' is 0; give a positive whole number, or the shape"),
    ({"a": 2.5}, {"y": 1}, "size of 'a' is 2.5"),
    ({3: 2}, {"y": 1}, "reads = {3: 2}"),
    ("ab", {"y": 1}, "reads = 'ab'"),
    ({"a": (1, 2), "b": 1}, {"y": 1}, "'a' has the shape (1, 2) and shares its tensor with 'b'"),
    ([{"a": 1}, {"a": 2}], {"y": 1}, "'a' has 1 elements in one tensor and 2 in another"),
    ({"a": 2}, {"y": 2}, "writes gives 2 elements to 'y', the module returns 1 there, a tensor of shape (1, 1)"),
    ({"a": 2}, [{"y": 1}, {"z": 1}], "the module returns 1 tensor of shape (1, 1), for which writes gives labels to 2"),
    ({"a": 2}, [{}], "writes = [{}]"),
    ({"a": 3}, {"y": 1}, "module '0' (Linear)"),
]


@pytest.mark.parametrize(("reads", "writes", "words"), LABELS)
def test_labels_that_do_not_fit(reads, writes, words):
    refuses(lambda: from_torch(mlp(), reads, writes), sg.InputError, "from_torch(Sequential)", words)


def test_what_is_no_module():
    refuses(
        lambda: from_torch(torch.tanh, {"a": 1}, {"y": 1}),
        sg.InputError,
        "is no torch.nn.Module; give the module itself, put a function",
    )
    refuses(lambda: from_torch([], {"a": 1}, {"y": 1}), sg.InputError, "the list of modules is empty")
    twice = nn.Sequential(mlp(2, 2))
    refuses(lambda: from_torch(twice, {"a": 2}, [{"y": 2}, {"y": 2}]), sg.InputError, "returns 1 tensor")


def test_a_slot_of_another_size():
    graph = sg.Graph({"a": sg.Action(3, low=0, high=1), "y": sg.State()}, start="s")
    model = from_torch(mlp(), {"a": 2}, {"y": 1}, name="flow")
    refuses(lambda: graph.edge("s", "e", model), sg.GraphError, "flow reads 'a' with size 2, the slot has size 3")


class Cast(nn.Module):
    def __init__(self, back):
        super().__init__()
        self.linear, self.back = nn.Linear(2, 1), back

    def forward(self, x):
        scaled = x.float() * 0.1
        return self.linear(scaled.to(x.dtype) if self.back else scaled)


def test_precisions_within_a_module():
    net = Cast(back=True)
    model = from_torch(net, {"a": 2}, {"y": 1})
    scaled = 0.1 * np.array([[0.3, 0.4]])  # in double precision all the way
    np.testing.assert_allclose(model.predict([0.3, 0.4])[0], value(net.linear, scaled)[0], rtol=1e-14)
    words = "module 'linear' (Linear)", "mixes precisions", "dtype=x.dtype"
    refuses(lambda: from_torch(Cast(back=False), {"a": 2}, {"y": 1}), sg.InputError, *words)


# Weights


@pytest.mark.parametrize("compiled", [False, True])
def test_training_on_changes_plans_without_a_build(compiled, monkeypatch):
    net = mlp()
    objective = task(from_torch(net, {"a": 1, "b": 1}, {"y": 1}), compiled=compiled)
    before = sg.solve(objective, {})
    monkeypatch.setattr(toolchain, "load", lambda *_: pytest.fail("compiled anew"))
    monkeypatch.setattr(exporting, "exported", lambda *_: pytest.fail("exported anew"))
    optimizer = torch.optim.Adam(net.parameters(), lr=0.05)
    x = 4 * torch.rand(256, 2) - 2
    for _ in range(60):
        optimizer.zero_grad()
        F.mse_loss(net(x), x[:, :1] * x[:, 1:]).backward()
        optimizer.step()
    after = sg.solve(objective, {})
    assert after.actions != before.actions
    expected = float(value(net, [[after.actions["a"], after.actions["b"]]]))
    assert after.nodes[-1].states["y"].mean == pytest.approx(expected, rel=1e-12)


CHANGES = {
    "load_state_dict": lambda net: net.load_state_dict({k: 2 * v for k, v in net.state_dict().items()}),
    "data in place": lambda net: net[0].weight.data.mul_(2),
    "data replaced": lambda net: setattr(net[0].weight, "data", 2 * net[0].weight.data),
    "parameter replaced": lambda net: setattr(net[0], "weight", nn.Parameter(2 * net[0].weight.detach())),
    "layer replaced": lambda net: net.__setitem__(0, nn.Linear(2, 8)),
    "other precision": lambda net: net.half().float(),
    "frozen": lambda net: net.requires_grad_(False)[2].bias.add_(1.0),
}


@pytest.mark.parametrize("change", CHANGES)
def test_all_ways_to_change_weights_are_seen(change):
    net = mlp()
    objective = task(from_torch(net, {"a": 1, "b": 1}, {"y": 1}))
    before = objective.value({}, {"a": 0.5, "b": 0.7})
    CHANGES[change](net)
    expected = -((float(value(net, [[0.5, 0.7]])) - 0.3) ** 2)
    assert objective.value({}, {"a": 0.5, "b": 0.7}) == pytest.approx(expected, rel=1e-12)
    assert expected != before


def test_weights_in_double_precision_are_copied():
    """Kernels keep what follows from numbers, and must see that they are others."""
    net = mlp().double()
    model = from_torch(net, {"a": 1, "b": 1}, {"y": 1})
    objective = task(model, compiled=True)
    point = np.array([[0.5], [0.7]])
    before, held = objective.evaluate({}, point)[0][0], [p.value for p in model.parameters]
    copies = [value.copy() for value in held]
    net[0].weight.data.mul_(2)
    assert all((value == copy).all() for value, copy in zip(held, copies, strict=True))
    after = objective.evaluate({}, point)[0][0]
    assert after == pytest.approx(-((float(value(net, [[0.5, 0.7]])) - 0.3) ** 2), rel=1e-12)
    assert after != before


def test_statistics_of_batch_norms_are_weights_too():
    net = nn.Sequential(nn.Linear(2, 4), nn.BatchNorm1d(4), nn.Tanh(), nn.Linear(4, 1))
    model = from_torch(net, {"a": 1, "b": 1}, {"y": 1})
    net.train()(3 + torch.randn(50, 2))
    np.testing.assert_allclose(model.predict([0.5, 0.7])[0], value(net, [[0.5, 0.7]])[0], rtol=1e-13)


def test_weights_that_follow_from_others_are_computed_by_torch():
    net = nn.utils.parametrizations.orthogonal(nn.Linear(3, 3))
    model = from_torch(net, {"a": 3}, {"y": 3})
    names = [p.name.removeprefix("ParametrizedLinear.") for p in model.parameters]
    assert sorted(names) == ["bias", "parametrizations.weight.0.base + parametrizations.weight.original"]
    with torch.no_grad():
        net.parametrizations.weight.original.add_(0.3)
    np.testing.assert_allclose(model.predict([1.0, 2.0, 3.0])[0], value(net, [[1.0, 2.0, 3.0]])[0], rtol=1e-12)


def test_weights_that_are_no_numbers():
    net = mlp()
    objective = task(from_torch(net, {"a": 1, "b": 1}, {"y": 1}, name="flow"))
    net[2].bias.data[0] = float("nan")
    refuses(lambda: sg.solve(objective, {}), sg.SlotError, "'flow.2.bias'", "the value is not finite")


def test_a_module_that_was_changed_too_much():
    net = mlp()
    objective = task(from_torch(net, {"a": 1, "b": 1}, {"y": 1}, name="flow"))
    net[0] = nn.Linear(2, 5)
    refuses(lambda: sg.solve(objective, {}), sg.InputError, "flow: the module's layers", "call from_torch again")
    net[0] = nn.Identity()
    refuses(lambda: sg.solve(objective, {}), sg.InputError, "flow: the module's layers", "call from_torch again")


def test_constants_that_were_changed():
    class Chosen(nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("order", torch.tensor([1, 0]))
            self.linear = nn.Linear(2, 1)

        def forward(self, x):
            return self.linear(x[:, self.order])

    net = Chosen()
    model = from_torch(net, {"a": 2}, {"y": 1}, name="flow")
    net.order[0] = 0
    refuses(
        lambda: model.parameters[0].value, sg.InputError, "flow: the buffer 'order' was a constant", "from_torch again"
    )


def test_weights_are_changed_in_the_module_alone():
    model = from_torch(mlp(), {"a": 2}, {"y": 1})
    with pytest.raises(sg.InputError, match="read from a torch module"):
        model.parameters[0].value = 3.0


# Gaussians


def test_rules_are_those_of_plain_functions():
    """The same function, as a module and as CasADi expression."""
    net = mlp(2, 1)
    w, b = (net[0].weight.detach().double().numpy(), net[0].bias.detach().double().numpy())
    v, c = (net[2].weight.detach().double().numpy(), net[2].bias.detach().double().numpy())

    def plain(a, b_):
        return {"y": ca.mtimes(ca.DM(v), ca.tanh(ca.mtimes(ca.DM(w), ca.vertcat(a, b_)) + ca.DM(b))) + ca.DM(c)}

    state = {"a": sg.Gaussian(0.3, sd=0.4), "b": sg.Gaussian(-0.2, sd=0.5)}
    for rule in (None, "mean", "linear", "second-order", "unscented", "quadrature"):
        module = sg.Model(from_torch(net, {"a": 1, "b": 1}, {"y": 1}), propagation=rule)
        function = sg.Model(plain, rename={"b_": "b"}, propagation=rule)
        moments = [outcome(task(model, uncertain=("a", "b")), state, {}) for model in (module, function)]
        assert moments[0].mean == pytest.approx(moments[1].mean, rel=1e-12)
        assert moments[0].covariance == pytest.approx(moments[1].covariance, rel=1e-11)


@pytest.mark.parametrize("rule", ["linear", "second-order", "unscented", "quadrature"])
def test_gradients_through_each_rule(rule):
    """Against finite differences, compiled and not."""
    model = sg.Model(from_torch(mlp(), {"a": 1, "b": 1}, {"y": 1}), propagation=rule)
    state = {"b": sg.Gaussian(-0.2, sd=0.5)}
    for compiled in (False, True):
        objective = task(model, uncertain=("b",), compiled=compiled)
        values, gradients = objective.evaluate(state, np.array([[0.4, 0.4 + 1e-5, 0.4 - 1e-5]]))
        assert gradients[0, 0] == pytest.approx((values[1] - values[2]) / 2e-5, rel=1e-6)


def test_a_reward_weighs_curvature_unless_told_otherwise():
    net = mlp(1, 1)
    model = from_torch(net, {"x": 1}, {"reward": 1})
    found = {}
    for rule in (None, "linear", "second-order"):
        graph = sg.Graph({"x": sg.State()}, start="s")
        graph.reward("s", sg.Model(model, propagation=rule))
        found[rule] = objective_of(graph).value({"x": sg.Gaussian(0.4, sd=0.8)}, {})
    assert found[None] == found["second-order"] != found["linear"]


def test_quadrature_counts_uncertain_directions_only():
    model = sg.Model(from_torch(mlp(5), {"a": 4, "b": 1}, {"y": 1}), propagation="quadrature")
    graph = sg.Graph({"a": sg.State(4), "b": sg.State(), "y": sg.State()}, start="s")
    graph.edge("s", "e", model)
    graph.reward("e", lambda y: y)
    objective = objective_of(graph)
    assert np.isfinite(objective.value({"a": [0.1] * 4, "b": sg.Gaussian(0.2, sd=0.1)}, {}))
    state = {"a": sg.Gaussian([0.1] * 4, sd=0.1), "b": 0.2}
    refuses(lambda: objective.value(state, {}), sg.GraphError, "'quadrature' over 4 uncertain directions")


def test_hessians_that_would_take_minutes_are_refused():
    graph = sg.Graph({"x": sg.State(300)}, start="s")
    graph.reward("s", from_torch(mlp(300), {"x": 300}, {"r": 1}, name="worth"))
    state = {"x": sg.Gaussian(np.zeros(300), sd=0.1)}
    objective = objective_of(graph)
    assert np.isfinite(objective.value({"x": np.zeros(300)}, {}))
    words = "worth: propagation 'second-order' over 300 uncertain directions ('x')", "'linear'"
    refuses(lambda: objective.value(state, {}), sg.GraphError, *words)


def test_noise_is_added():
    model = sg.Model(from_torch(mlp(), {"a": 1, "b": 1}, {"y": 1}), noise={"y": 0.04})
    assert outcome(task(model), {}, {"a": 0.0, "b": 0.0}).sd == pytest.approx(0.2)


class TwoHeads(nn.Module):
    """Mean and logarithm of the deviation, as networks that are fitted by likelihood have them."""

    def __init__(self):
        super().__init__()
        self.body = mlp(2, 2)

    def forward(self, x):
        y = self.body(x)
        return y[:, :1], y[:, 1:].exp()


HEADS = {"writes": [{"y": 1}, {"s": 1}], "deviations": {"y": "s"}}


def test_deviations_that_a_module_predicts():
    net = TwoHeads()
    model = from_torch(net, {"a": 1, "b": 1}, **HEADS)
    assert model.writes == {"y": 1}
    y, s = (float(part) for part in value(net, [[0.3, -0.4]]))
    for compiled in (False, True):
        found = outcome(task(model, compiled=compiled), {}, {"a": 0.3, "b": -0.4})
        assert found.mean == pytest.approx(y, rel=1e-13)
        assert found.sd == pytest.approx(s, rel=1e-13)


def test_expected_deviations_of_uncertain_inputs():
    """Against a million samples."""
    net = TwoHeads()
    model = sg.Model(from_torch(net, {"a": 1, "b": 1}, **HEADS), propagation="quadrature")
    found = outcome(task(model, uncertain=("b",)), {"b": sg.Gaussian(-0.4, sd=0.5)}, {"a": 0.3})
    b = -0.4 + 0.5 * torch.randn(1_000_000)
    y, s = value(net, torch.stack([torch.full_like(b, 0.3), b], 1))
    assert found.mean == pytest.approx(float(y.mean()), abs=2e-3)
    assert found.covariance == pytest.approx(float(y.var() + (s**2).mean()), rel=5e-3)


def test_an_ensemble_of_modules_with_deviations():
    nets = [TwoHeads() for _ in range(3)]
    model = from_torch(nets, {"a": 1, "b": 1}, **HEADS)
    y, s = np.array([[float(part) for part in value(net, [[0.3, -0.4]])] for net in nets]).T
    mean, covariance = model.predict([0.3, -0.4])
    assert mean[0] == pytest.approx(y.mean(), rel=1e-13)
    assert covariance[0, 0] == pytest.approx(y.var() + (s**2).mean(), rel=1e-12)


@pytest.mark.parametrize(
    ("deviations", "words"),
    [
        ("s", "deviations = 's'; give {label"),
        ({"y": "t"}, "deviations name 't'. Labels in writes: 'y', 's'"),
        ({"z": "s"}, "deviations name 'z'"),
        ({"y": "y"}, "'y' holds the deviations of 'y'"),
        ({"y": "s", "s": "y"}, "'s' holds the deviations of 'y', and can be nothing else"),
    ],
)
def test_deviations_that_do_not_fit(deviations, words):
    writes = [{"y": 1}, {"s": 1}]
    refuses(lambda: from_torch(TwoHeads(), {"a": 2}, writes, deviations=deviations), sg.InputError, words)


def test_all_edges_call_the_same_function():
    """So that a chain of ten steps compiles no longer than one of two."""
    model = from_torch(mlp(), {"a": 1, "b": 1}, {"y": 1})
    slots = {"y": sg.State()} | {f"u{k}": sg.Action(low=-1.0, high=1.0) for k in range(3)}
    graph = sg.Graph(slots, start="n0")
    for k in range(3):
        graph.edge(f"n{k}", f"n{k + 1}", sg.Model(model, rename={"a": "y", "b": f"u{k}"}))
    graph.reward("n3", lambda y: y)
    function = objective_of(graph).situation({"y": sg.Gaussian(0.1, sd=0.1)}).build.expectation.value_function()
    inner = [f for f in function.find_functions() if f.name() == "moments"]
    assert len({hash(f) for f in inner}) == len(inner) == 1


# Ensembles


def test_an_ensemble_is_a_mixture():
    nets = [mlp() for _ in range(4)]
    model = from_torch(nets, {"a": 1, "b": 1}, {"y": 1})
    each = np.array([float(value(net, [[0.3, -0.4]])) for net in nets])
    found = outcome(task(model, compiled=True), {}, {"a": 0.3, "b": -0.4})
    assert found.mean == pytest.approx(each.mean(), rel=1e-12)
    assert found.covariance == pytest.approx(each.var(), rel=1e-10)


def test_members_pass_on_what_is_uncertain():
    nets = [mlp() for _ in range(3)]
    state = {"b": sg.Gaussian(-0.4, sd=0.3)}
    each = [
        outcome(task(from_torch(net, {"a": 1, "b": 1}, {"y": 1}), uncertain=("b",)), state, {"a": 0.3}) for net in nets
    ]
    found = outcome(task(from_torch(nets, {"a": 1, "b": 1}, {"y": 1}), uncertain=("b",)), state, {"a": 0.3})
    means, variances = np.array([g.mean for g in each]), np.array([g.covariance for g in each])
    assert found.mean == pytest.approx(means.mean(), rel=1e-12)
    assert found.covariance == pytest.approx(variances.mean() + means.var(), rel=1e-10)


def test_members_may_differ_and_are_trained_on():
    nets = [mlp(), mlp(hidden=5, kind=nn.ELU)]
    model = from_torch(nets, {"a": 1, "b": 1}, {"y": 1})
    nets[1][2].bias.data += 5.0
    each = np.array([float(value(net, [[0.3, -0.4]])) for net in nets])
    mean, covariance = model.predict([0.3, -0.4])
    assert mean[0] == pytest.approx(each.mean(), rel=1e-12)
    assert covariance[0, 0] == pytest.approx(each.var(), rel=1e-10)


def test_members_of_a_kind_are_exported_once(monkeypatch):
    made = []
    original = exporting.exported
    monkeypatch.setattr(cache, "_known", {})
    monkeypatch.setattr(cache, "private_folder", lambda name: cache.Path("/nowhere"))
    monkeypatch.setattr(exporting, "exported", lambda *given: made.append(given) or original(*given))
    from_torch([mlp(), mlp(), mlp()], {"a": 2}, {"y": 1})
    assert len(made) == 1


def test_calibration_takes_an_ensemble():
    model = from_torch([mlp(), mlp()], {"a": 1, "b": 1}, {"y": 1})
    x = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    report = sg.learned.calibrate(model, x, model.predict(x)[0] + 0.01)
    assert "40 held-out samples" in str(report)


def test_rows_that_do_not_fit():
    model = from_torch(mlp(), {"a": 1, "b": 1}, {"y": 1}, name="flow")
    refuses(lambda: model.predict([[1.0, 2.0, 3.0]]), sg.InputError, "flow: x", "3")


# Processes and disks


def test_a_plan_in_another_process_needs_no_torch():
    objective = task(from_torch(mlp(), {"a": 1, "b": 1}, {"y": 1}))
    expected = objective.value({}, {"a": 0.5, "b": 0.7})
    script = (
        "import pickle, sys; objective = pickle.load(sys.stdin.buffer); "
        "print(repr(objective.value({}, {'a': 0.5, 'b': 0.7})), 'torch' in sys.modules)"
    )
    import cloudpickle

    done = subprocess.run(
        [sys.executable, "-c", script], input=cloudpickle.dumps(objective), capture_output=True, timeout=100
    )
    assert done.stdout.decode().split() == [repr(expected), "False"], done.stderr.decode()[-2000:]


def test_copies_keep_the_weights_of_their_time():
    net = mlp()
    model = from_torch(net, {"a": 2}, {"y": 1})
    twin = pickle.loads(pickle.dumps(model))
    before = model.predict([0.1, 0.2])[0]
    net[2].bias.data += 1.0
    assert twin.predict([0.1, 0.2])[0] == before
    assert model.predict([0.1, 0.2])[0] == pytest.approx(before + 1.0)


@pytest.fixture
def disk(tmp_path, monkeypatch):
    """A cache of its own, and a count of exports."""
    monkeypatch.setattr(cache, "private_folder", lambda name: tmp_path)
    monkeypatch.setattr(cache, "_known", {})
    made = []
    original = exporting.exported
    monkeypatch.setattr(exporting, "exported", lambda *given: made.append(given) or original(*given))
    return tmp_path, made


def forgotten(monkeypatch):
    monkeypatch.setattr(cache, "_known", {})


def test_what_was_exported_once_is_found_on_the_disk(disk, monkeypatch):
    folder, made = disk
    for _ in range(3):
        net = mlp()
        model = from_torch(net, {"a": 2}, {"y": 1})
        forgotten(monkeypatch)
        np.testing.assert_allclose(model.predict([0.3, 0.4])[0], value(net, [[0.3, 0.4]])[0], rtol=1e-13)
    assert len(made) == 1
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("damage", ["cut", "empty", "another", "list"])
def test_damaged_files_are_made_anew(disk, monkeypatch, damage):
    folder, made = disk
    from_torch(mlp(), {"a": 2}, {"y": 1})
    (file,) = folder.iterdir()
    text = file.read_text()
    document = json.loads(text)
    document["weights"][0][2:] = [1, 1]
    file.write_text({"cut": text[:200], "empty": "", "another": json.dumps(document), "list": "[]"}[damage])
    forgotten(monkeypatch)
    net = mlp()
    model = from_torch(net, {"a": 2}, {"y": 1})
    np.testing.assert_allclose(model.predict([0.3, 0.4])[0], value(net, [[0.3, 0.4]])[0], rtol=1e-13)
    assert len(made) == 2


def by_sine(x):
    return torch.sin(x)


def by_cosine(x):
    return torch.cos(x)


class Calls(nn.Module):
    def __init__(self, function, gain=1.0):
        super().__init__()
        self.linear = nn.Linear(2, 1)
        self.function = function
        self.gain = gain

    def forward(self, x):
        return self.gain * self.function(self.linear(x))


def test_other_code_and_other_settings_are_other_modules(disk):
    _, made = disk
    kinds = [
        Calls(by_sine),
        Calls(by_cosine),
        Calls(by_sine, 2.0),
        Calls(lambda x: x + 1),
        Calls(lambda x: x + 2),
        mlp(kind=nn.ELU),
        mlp(kind=nn.SiLU),
        nn.Sequential(nn.Linear(2, 1), nn.LeakyReLU(0.1)),
        nn.Sequential(nn.Linear(2, 1), nn.LeakyReLU(0.2)),
    ]
    for net in kinds:
        model = from_torch(net, {"a": 2}, {"y": 1})
        np.testing.assert_allclose(model.predict([0.3, 0.4])[0], value(net, [[0.3, 0.4]])[0], rtol=1e-13)
    assert len(made) == len(kinds)


def test_what_no_key_sees_is_seen_in_numbers(disk):
    """A table that forward reads through a name of its file's namespace."""
    _, made = disk
    namespace = {"torch": torch, "nn": nn, "TABLE": type("Table", (), {})()}
    exec("class Net(nn.Module):\n  def forward(self, x):\n    return x.sum().reshape(1) * TABLE.gain\n", namespace)
    for gain in (2.0, 3.0):
        namespace["TABLE"].gain = gain
        model = from_torch(namespace["Net"](), {"a": 2}, {"y": 1})
        assert model.predict([0.3, 0.4])[0] == pytest.approx(0.7 * gain)
    assert len(made) == 2


def test_a_module_that_is_not_a_function_is_refused():
    class Counting(nn.Module):
        calls = 0

        def forward(self, x):
            Counting.calls += 1
            return x * Counting.calls

    refuses(lambda: from_torch(Counting(), {"a": 2}, {"y": 2}), sg.InputError, "must return the same each time")
