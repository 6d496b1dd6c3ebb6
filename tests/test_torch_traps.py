"""Modules that are easily misread: far from the points at which they are tried, with odd settings, changed later."""

import dataclasses
import functools
import math
import sys
import time
import types

import casadi as ca
import numpy as np
import pytest
import torch
from small_tasks import objective_of, refuses
from torch import nn
from torch.nn import functional as F
from torch_zoo import MODULES, inputs, reference

import symgraph as sg
from symgraph.learned.torch_modules import cache, exporting

from_torch = sg.learned.from_torch


class Of(nn.Module):
    """A module whose forward is a function of it and its inputs."""

    def __init__(self, function, **parts):
        super().__init__()
        self.function = function
        for name, part in parts.items():
            if isinstance(part, torch.Tensor) and not isinstance(part, nn.Parameter):
                self.register_buffer(name, part)
            else:
                setattr(self, name, part)

    def forward(self, *xs):
        return self.function(self, *xs)


def agrees(module, shape, *points, rtol=1e-12):
    """Values at points, as torch has them in double precision."""
    with reference(module) as twin, torch.no_grad():
        expected = [twin(torch.tensor(point, dtype=torch.float64).reshape(shape)).flatten() for point in points]
    model = from_torch(module, {"x": shape}, {"y": len(expected[0])})
    for point, values in zip(points, expected, strict=True):
        found = model.predict(np.ravel(point))[0]
        np.testing.assert_allclose(found, values.numpy(), rtol=rtol, atol=1e-13)
    return model


def refused(module, *words, reads=None, writes=None):
    refuses(lambda: from_torch(module, reads or {"x": 2}, writes or {"y": 2}, name="net"), sg.InputError, *words)


# Values far from where they are tried, and of other kinds of numbers


def test_padding_with_infinity():
    agrees(Of(lambda m, x: F.pad(x, (1, 1), value=-math.inf).exp()), (1, 2), [0.1, 0.2])
    agrees(Of(lambda m, x: F.max_pool1d(F.pad(x, (1, 1), value=-math.inf), 2)), (1, 3), [0.1, 0.3, 0.4])


def attend(mask):
    return Of(lambda m, x: F.scaled_dot_product_attention(x, x, x, attn_mask=mask(m, x)), keep=torch.ones(3))


X = [0.1, 2.0, 9.0, 2.0, 0.3, 3.0]


@pytest.mark.parametrize(
    "mask",
    [
        lambda m, x: (x[..., :1].abs() < 5).transpose(-1, -2),
        lambda m, x: (x[..., :1].abs() > 50).transpose(-1, -2),  # nothing is seen at all
        lambda m, x: torch.where((x[..., :1].abs() < 5).transpose(-1, -2), 0.0, -math.inf),
        lambda m, x: x[..., :1].transpose(-1, -2),
    ],
    ids=["near", "nothing", "as numbers", "added"],
)
def test_attention_masks_that_follow_from_inputs(mask):
    agrees(attend(mask), (1, 3, 2), X, [0.1 * x for x in X])


def test_attention_masks_that_follow_from_weights():
    net = attend(lambda m, x: (m.keep > 0.5).reshape(1, 1, 3))
    model = agrees(net, (1, 3, 2), X)
    net.keep[1] = 0.0
    with torch.no_grad():
        expected = net.double()(torch.tensor(X, dtype=torch.float64).reshape(1, 3, 2))
    np.testing.assert_allclose(model.predict(X)[0], expected.flatten(), rtol=1e-12)


def test_booleans_add_up_to_true():
    agrees(Of(lambda m, x: ((x > 4) + (x > 3.5)) * x), (1, 2), [5.0, 3.7], [0.1, 4.2])
    agrees(Of(lambda m, x: (x > 0).long().sum(1, keepdim=True) * x), (1, 2), [5.0, 3.7], [-0.1, 4.2])


def test_constants_are_computed_in_double_precision():
    agrees(Of(lambda m, x: x * torch.exp(torch.arange(2) * (-math.log(1e4) / 3))), (1, 2), [5.0, 3.7])
    agrees(Of(lambda m, x: x + torch.arange(2) / 3 + torch.sqrt(m.k), k=torch.tensor([2, 3])), (1, 2), [5.0, 3.7])


def test_remainders_and_norms_as_torch_has_them():
    agrees(Of(lambda m, x: torch.remainder(x, 0.1)), (1, 3), [1.0, -1.05, 0.3])
    agrees(Of(lambda m, x: torch.linalg.vector_norm(x, -1, dim=1)), (1, 3), [1.0, 2.0, 3.0], [0.0, 2.0, 3.0])


def test_tensors_without_numbers():
    agrees(Of(lambda m, x: x + x[:, :0].sum(1, keepdim=True) + x[:, :0] @ torch.zeros(0, 2)), (1, 2), [1.0, 2.0])
    agrees(Of(lambda m, x: torch.cat([x[:, :0].cumsum(1), x], 1)), (1, 2), [1.0, 2.0])


def test_integers_among_real_numbers():
    agrees(Of(lambda m, x: torch.cat([x, m.k[None]], 1), k=torch.tensor([1, 2])), (1, 2), [1.5, 2.5])

    def assigned(m, x):
        y = x.clone()
        y[:, :1] = torch.tensor([3])
        return y

    agrees(Of(assigned), (1, 2), [1.5, 2.5])


def test_inputs_changed_in_place():
    agrees(nn.Sequential(nn.ELU(inplace=True), nn.Linear(2, 2)), (1, 2), [-0.3, 0.4])
    agrees(Of(lambda m, x: x.mul_(2) + 1), (1, 2), [-0.3, 0.4])


def test_outputs_that_are_plain_numbers_or_nothing():
    model = from_torch(Of(lambda m, x: (2 * x, 0.5, x.shape[1], None, "text")), {"x": 2}, [{"y": 2}, {"half": 1}, {}])
    assert model.predict([1.0, 2.0])[0].tolist() == [2.0, 4.0, 0.5]
    for nothing in (lambda m, x: "text", lambda m, x: None):
        refused(Of(nothing), "the module returns no tensor")


@pytest.mark.parametrize("entry", MODULES[3::6], ids=lambda entry: entry.name)
def test_at_zero_among_equals_and_far_away(entry):
    """Values are torch's, numbers or not; slopes are numbers where torch's are."""
    module = entry.make()
    sizes = [math.prod(shape) for shape in entry.shapes]
    with reference(module) as twin:
        made = twin(*inputs(entry, 0))
        outputs = [part for part in torch.utils._pytree.tree_leaves(made) if isinstance(part, torch.Tensor)]
    model = from_torch(
        module,
        [{f"x{i}": s} for i, s in enumerate(entry.shapes)],
        [{f"y{i}": o.numel()} for i, o in enumerate(outputs)],
    )
    x = [ca.MX.sym(f"x{i}", size) for i, size in enumerate(sizes)]
    weights = [ca.MX(ca.DM(p.value)) for p in model.parameters]
    y = ca.vertcat(*model._members[0][0].call([*x, *weights], True, False))
    function = ca.Function("f", x, [y, *[ca.jacobian(y, part) for part in x]])
    rng = np.random.default_rng(0)
    for point in (np.zeros, np.ones, lambda n: 1e3 * rng.normal(size=n), lambda n: -1e3 * np.ones(n)):
        columns = [point(size) for size in sizes]
        with reference(module) as twin:
            given = [torch.tensor(c).reshape(s) for c, s in zip(columns, entry.shapes, strict=True)]

            def flat(*parts, twin=twin):
                leaves = torch.utils._pytree.tree_leaves(twin(*parts))
                return torch.cat([part.reshape(-1) for part in leaves if isinstance(part, torch.Tensor)])

            value = flat(*given).detach().numpy()
            slopes = torch.func.jacrev(flat, tuple(range(len(given))))(*given)
        found, *jacobians = function.call(columns)
        np.testing.assert_allclose(np.array(found).ravel(), value, rtol=1e-9, atol=1e-9)
        for jacobian, slope in zip(jacobians, slopes, strict=True):
            assert np.isfinite(np.array(jacobian)).all() or not slope.isfinite().all()


def test_slopes_of_deviations_of_equal_numbers():
    graph = sg.Graph({"x": sg.Action(3, low=-1, high=1)}, "s")
    graph.reward("s", from_torch(Of(lambda m, x: x.std(-1, keepdim=True)), {"x": 3}, {"r": 1}))
    assert objective_of(graph).gradient({}, {"x": [0.5] * 3})["x"].tolist() == [0.0, 0.0, 0.0]


# What follows from weights


def test_weights_on_their_way_through_devices_types_and_complex_numbers():
    def forward(m, x):
        other = torch.ones_like(m.w, device="cpu") + (m.w * 1j).abs() + m.w.to("cpu", torch.float64)
        return x * other

    agrees(Of(forward, w=nn.Parameter(torch.tensor([0.5, 2.0]))), (1, 2), [1.0, 2.0])


def test_long_and_branching_chains_of_weights():
    def long(m, x):
        w = m.w
        for _ in range(600):
            w = w + 0.001
        return x * w

    def sinkhorn(m, x):
        w = m.w.exp()
        for _ in range(40):
            w = w / w.sum(0, keepdim=True)
            w = w / w.sum(1, keepdim=True)
        return x @ w

    agrees(Of(long, w=nn.Parameter(torch.ones(2))), (1, 2), [1.0, 2.0])
    begin = time.perf_counter()
    agrees(Of(sinkhorn, w=nn.Parameter(torch.randn(2, 2))), (1, 2), [1.0, 2.0])
    assert time.perf_counter() - begin < 60  # it once took minutes


def test_weights_used_many_times_are_parameters_once():
    def steps(m, x):
        for _ in range(10):
            x = x + 0.1 * m.f(x)
        return x

    model = agrees(Of(steps, f=nn.Linear(2, 2)), (1, 2), [1.0, 2.0])
    assert len(model.parameters) == 2


def test_weights_that_are_not_finite():
    net = Of(lambda m, x: x / (1 + m.w.exp()), w=nn.Parameter(torch.tensor([0.0, math.nan])))
    refused(net, "the module itself (Of)", "makes numbers of 'w' that are not finite")
    mask = Of(lambda m, x: x + torch.where(m.w > 0, 0.0, -math.inf), w=nn.Parameter(torch.tensor([-1.0, 1.0])))
    refused(mask, "'w'", "not finite")


# What changes later


CHANGES = {
    "tensor that is no buffer": lambda m: setattr(m, "mean", torch.ones(2)),
    "number": lambda m: setattr(m, "gain", 3.0),
    "layer": lambda m: m.body.__setitem__(1, nn.ReLU()),
    "setting": lambda m: setattr(m.body[3], "negative_slope", 0.9),
    "bias left out": lambda m: setattr(m.body, "4", nn.Linear(3, 2, bias=False)),
}


class Changing(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.body = nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 3), nn.LeakyReLU(), nn.Linear(3, 2))
        self.mean, self.gain = torch.zeros(2), 1.0

    def forward(self, x):
        return self.gain * self.body(x - self.mean)


@pytest.mark.parametrize("change", CHANGES)
def test_other_layers_and_settings_are_noticed(change):
    net = Changing()
    model = from_torch(net, {"x": 2}, {"y": 2}, name="net")
    model.predict([0.1, 0.2])
    CHANGES[change](net)
    refuses(lambda: model.predict([0.1, 0.2]), sg.InputError, "net", "call from_torch again")


def test_changes_that_change_nothing():
    net = Changing()
    model = from_torch(net, {"x": 2}, {"y": 2})
    before = model.predict([0.1, 0.2])[0]
    net.train()
    net.remembered = [1, 2, 3]
    net.body[1] = nn.Tanh()
    assert (model.predict([0.1, 0.2])[0] == before).all()


@dataclasses.dataclass
class Limits:
    most: float


class Holder(nn.Module):
    def __init__(self, held):
        super().__init__()
        self.held = held

    def forward(self, x):
        limit = self.held.most if isinstance(self.held, Limits) else self.held
        return self.held(x) if callable(self.held) else x.clamp(max=float(np.asarray(limit).max()))


def by_setting(module):
    return lambda x: x.clamp(max=module.LIMIT)


@pytest.mark.parametrize("kind", ["object", "partial", "array", "closure", "file"])
def test_an_earlier_export_with_other_settings_is_not_used(kind, tmp_path, monkeypatch):
    """Limits so far away that random points do not tell them apart."""
    monkeypatch.setattr(cache, "private_folder", lambda name: tmp_path)
    monkeypatch.setattr(cache, "_known", {})
    monkeypatch.setattr(exporting, "FAR", (1.0,))
    monkeypatch.setattr(exporting, "NEAR", (1.0,))
    for most in (60.0, 70.0):
        file = types.ModuleType("limits_of_a_user")
        file.LIMIT = most
        monkeypatch.setitem(sys.modules, "limits_of_a_user", file)
        held = {
            "object": Limits(most),
            "partial": functools.partial(torch.clamp, max=most),
            "array": np.array([most]),
            "closure": lambda x, most=most: x.clamp(max=most),
            "file": by_setting(file),
        }[kind]
        assert from_torch(Holder(held), {"x": 2}, {"y": 2}).predict([80.0, 1.0])[0].tolist() == [most, 1.0]


# What messages say


TROUBLES = [
    (Of(lambda m, x: torch.cat([x, torch.ones(3, 3)], 1)), ["tensor of shape (1, 2)"]),
    (Of(lambda m, x: m.e(x), e=nn.Embedding(4, 2)), ["looks up real numbers", "one-hot"]),
    (Of(lambda m, x: x.to(torch.complex64).abs()), ["complex"]),
    (Of(lambda m, x: torch.distributions.Normal(x, 1.0).log_prob(x + x.sum())), ["distribution", "mean and its dev"]),
    (Of(lambda m, x: x[x < 0]), ["size of a result must not depend"]),
    (nn.Bilinear(2, 2, 2), ["cannot be called with 1 tensor", "a list with a dict for each"]),
    (nn.Linear(3, 2), ["with what reads makes, a tensor of shape (1, 2)"]),
]


@pytest.mark.parametrize(("module", "words"), TROUBLES, ids=[words[0] for _, words in TROUBLES])
def test_what_is_told(module, words):
    refused(module, *words)


def test_casts_to_half_precision_are_passed_over():
    model = from_torch(Of(lambda m, x: x.half().double() * 2), {"x": 2}, {"y": 2})
    assert model.predict([1 / 3, 0.1])[0].tolist() == [2 / 3, 0.2]


class Named(nn.Module):
    def forward(me, x):
        if x.sum() > 0:
            return x
        return -x


def test_the_line_of_a_module_that_calls_itself_otherwise():
    refused(nn.Sequential(nn.Linear(2, 2), Named()), "module '1' (Named), test_torch_traps.py:", "decides by the value")


def test_an_encoder_with_a_causal_mask():
    layer = nn.TransformerEncoderLayer(4, 2, 8, batch_first=True)
    mask = nn.Transformer.generate_square_subsequent_mask(3)
    net = Of(lambda m, x: m.e(x, mask=m.mask), e=nn.TransformerEncoder(layer, 2), mask=mask)
    agrees(net, (1, 3, 4), np.linspace(-1, 1, 12))


def test_dicts_are_matched_by_their_keys():
    net = Of(lambda m, x: {"b": x[:, :1], "a": x[:, 1:]})
    for writes in ({"a": 1, "b": 1}, [{"a": 1}, {"b": 1}], [{"b": 1}, {"a": 1}]):
        model = from_torch(net, {"x": 2}, writes)
        found = dict(zip(model.writes, model.predict([1.0, 2.0])[0], strict=True))
        assert found == {"a": 2.0, "b": 1.0}
    positions = from_torch(net, {"x": 2}, [{"p": 1}, {"q": 1}])
    assert positions.predict([1.0, 2.0])[0].tolist() == [1.0, 2.0]


def test_logarithms_of_variances_are_no_deviations():
    net = Of(lambda m, x: (x[:, :1], x[:, 1:] - 7))
    words = "'s', which is to hold the deviations of 'y'", "return exp(0.5"
    call = functools.partial(from_torch, net, {"x": 2}, [{"y": 1}, {"s": 1}], deviations={"y": "s"})
    refuses(call, sg.InputError, *words)
