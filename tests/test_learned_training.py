"""Training: folds, where copies begin, what each may learn from, and when it ends."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import assert_close

from symgraph.learned import losses, training
from symgraph.learned.initialisation import begin_linear, initial_copies
from symgraph.learned.perceptron import Perceptron, Scaling, rescaled
from symgraph.learned.training import (
    FOLDS,
    Copies,
    Folds,
    active_folds,
    default_steps,
    train,
)
from symgraph.progress import Progress

QUIET = Progress("training", shown=False)

# Folds


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), first=st.integers(0, 60), more=st.integers(1, 60))
def test_folds_are_stable_and_balanced(seed, first, more):
    """Sizes differ by one at most; what has a fold keeps it when samples are added."""
    x = np.random.default_rng(seed).normal(size=(first + more, 3))
    folds = Folds()
    before = folds.assign(x[:first]) if first else np.zeros(0, dtype=int)
    after = folds.assign(x)
    np.testing.assert_array_equal(after[:first], before)
    sizes = np.bincount(after, minlength=FOLDS)
    assert len(sizes) == FOLDS
    assert np.ptp(sizes) <= 1


def test_folds_depend_on_content_alone():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    order = rng.permutation(40)
    expected = Folds().assign(x, y)
    np.testing.assert_array_equal(Folds().assign(x[order], y[order]), expected[order])
    np.testing.assert_array_equal(Folds().assign(np.asfortranarray(x), y), expected)
    assert (Folds().assign(x, -y) != expected).any()


def test_equal_samples_share_a_fold():
    x = np.random.default_rng(0).normal(size=(10, 2))
    folds = Folds().assign(np.vstack([x, x, x[::-1]]))
    np.testing.assert_array_equal(folds[:10], folds[10:20])
    np.testing.assert_array_equal(folds[:10], folds[20:][::-1])


def test_zeros_of_either_sign_are_equal():
    x = np.array([[0.0, 1.0], [-0.0, 1.0]])
    assert len(set(Folds().assign(x).tolist())) == 1


def test_a_sample_that_came_often_fills_its_fold():
    """Twenty of one sample and twenty others: once the one is dealt, the rest go to other folds.

    It comes anywhere in the order of digests, so that 2 of the others share its fold on average (3 or 4 would, if it
    counted once); over 40 tries with standard deviations of 1.2, to 0.2.
    """
    shared = []
    for seed in range(40):
        x = np.random.default_rng(seed).normal(size=(21, 2))
        folds = Folds().assign(np.vstack([x, np.repeat(x[:1], 19, axis=0)]))
        others = np.bincount(folds[1:21], minlength=FOLDS)
        assert np.ptp(np.delete(others, folds[0])) <= 1
        shared.append(others[folds[0]])
    assert np.mean(shared) == pytest.approx(2, abs=0.6)


@pytest.mark.parametrize(
    ("samples", "expected"), [(1, 5), (200, 5), (1000, 5), (1250, 4), (1251, 4), (2500, 2), (5000, 1), (10**6, 1)]
)
def test_fewer_folds_where_one_holds_enough(samples, expected):
    """A fifth of the samples a fold: as many as hold 1000 together."""
    assert active_folds(samples) == expected


@pytest.mark.parametrize(
    ("samples", "widest", "expected"),
    [
        (1, 200, 150),
        (120, 100, 150),
        (200, 200, 250),
        (2_000, 200, 2_500),
        (20_000, 200, 6_000),
        (60, 50, 300),
        (60, 8, 750),
    ],
    ids=lambda value: str(value),
)
def test_steps_from_scratch(samples, widest, expected):
    """As the docstring says."""
    assert default_steps(samples, widest) == expected


# Where copies begin


def outputs(copies, x):
    """(M, N, m), layer by layer."""
    hidden = np.repeat(x[None].astype(float), copies.count, axis=0)
    for i, (w, b) in enumerate(zip(copies.weights, copies.biases, strict=True)):
        hidden = hidden @ w.astype(float) + b.astype(float)
        if i < len(copies.weights) - 1:
            hidden = np.maximum(hidden, 0)
    return hidden


def random_copies(sizes, count, rng):
    layers = list(itertools.pairwise(sizes))
    return Copies(
        [rng.normal(size=(count, n, m)).astype(np.float32) for n, m in layers],
        [rng.normal(size=(count, 1, m)).astype(np.float32) for _, m in layers],
    )


def random_scaling(rng, n):
    return Scaling(rng.normal(size=n), np.exp(rng.normal(size=n)))


@pytest.mark.parametrize("sizes", [(3, 2), (3, 8, 2), (3, 8, 6, 2)], ids=str)
@pytest.mark.parametrize("with_targets", [True, False])
def test_rescaled_copies_are_the_same_functions_of_what_is_not_scaled(sizes, with_targets):
    """To the 1e-7 of single precision, times the 50 of the largest number on the way."""
    rng = np.random.default_rng(2)
    copies = random_copies(sizes, 3, rng)
    (x0, x1), (y0, y1) = [[random_scaling(rng, n) for _ in range(2)] for n in (3, 2)]
    if not with_targets:
        y0 = y1 = None
    anew = rescaled(copies, (x0, y0), (x1, y1))
    x = rng.normal(size=(20, 3))

    def raw(which, by, into):
        y = outputs(which, by(x))
        return y if into is None else y * into.sd + into.mean

    assert_close(raw(anew, x1, y1), raw(copies, x0, y0), 5e-6)


@pytest.mark.parametrize("sizes", [(3, 2), (3, 8, 2)], ids=str)
def test_a_perceptron_takes_over_the_first_copy_in_the_users_units(sizes):
    rng = np.random.default_rng(3)
    copies, x, y = random_copies(sizes, 2, rng), random_scaling(rng, 3), random_scaling(rng, 2)
    points = rng.normal(size=(10, 3))
    for scaling in (y, None):
        perceptron = Perceptron(sizes, "net")
        perceptron.set(copies, x, scaling)
        expected = outputs(copies, x(points))[0]
        assert_close(perceptron(points), expected if scaling is None else expected * y.sd + y.mean, 1e-12)


def test_scalings_whiten_and_only_shift_what_does_not_vary():
    samples = np.random.default_rng(0).normal(3, 7, size=(50, 2))
    samples = np.hstack([samples, np.full((50, 1), 0.1), np.zeros((50, 1))])
    scaled = Scaling.of(samples)(samples)
    assert_close(scaled.mean(axis=0), np.zeros(4), 1e-14)
    assert_close(scaled.std(axis=0), [1, 1, 0, 0], 1e-12)


# Training


def task(rng, n=100):
    x = rng.normal(size=(n, 2))
    y = np.sin(2 * x[:, :1]) + 0.1 * rng.normal(size=(n, 1))
    return x, y, Folds().assign(x, y)


def trained(seed=0, n=100, steps=30, change=None, folds=None, count=1 + FOLDS, loss=losses.squares):
    x, y, assigned = task(np.random.default_rng(7), n)
    assigned = assigned if folds is None else folds(assigned)
    if change is not None:
        y[assigned == change] += 0.1
    rng = np.random.default_rng(seed)
    copies = initial_copies((2, 12, 12, 1), x, count, rng)
    return train(copies, x, y, assigned, loss, steps, rng, QUIET), (x, y, assigned, copies)


def arrays(copies, k):
    return [a[k] for a in copies.weights + copies.biases]


def test_the_same_seed_gives_the_same_weights():
    (a, _), (b, _), (c, _) = trained(0), trained(0), trained(1)
    for k in range(a.copies.count):
        for left, right in zip(arrays(a.copies, k), arrays(b.copies, k), strict=True):
            np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(a.outputs, b.outputs)
    assert any((left != right).any() for left, right in zip(arrays(a.copies, 0), arrays(c.copies, 0), strict=True))


@pytest.mark.parametrize("k", range(FOLDS))
def test_a_copy_never_learns_from_the_fold_it_leaves_out(k):
    """Other targets in fold k change every copy but 1 + k: its weights stay the same to the last bit.

    With as many steps as lie between two looks at the held-out loss, both keep what the last one left.
    """
    (before, (*_, start)), (after, _) = trained(steps=training.EVERY), trained(steps=training.EVERY, change=k)
    for kept in (before, after):
        assert (kept.copies.weights[-1] != start.weights[-1]).any()
    for copy in range(1 + FOLDS):
        pairs = zip(arrays(before.copies, copy), arrays(after.copies, copy), strict=True)
        same = all((left == right).all() for left, right in pairs)
        assert same == (copy == 1 + k), copy


def test_outputs_are_those_of_copies_that_left_the_sample_out():
    result, (x, _, folds, _) = trained()
    expected = outputs(result.copies, x)
    for i, fold in enumerate(folds):
        assert_close(result.outputs[i], expected[1 + fold, i], 1e-5)


def test_outputs_are_nan_exactly_where_every_copy_had_the_sample():
    """Two copies that leave folds 0 and 1 out."""
    result, (_, _, folds, _) = trained(count=3)
    np.testing.assert_array_equal(np.isnan(result.outputs[:, 0]), folds >= 2)


def test_the_loss_is_the_mean_over_held_out_samples_and_no_worse_than_at_the_start():
    """To the single precision of sums of 100 numbers."""
    result, (x, y, folds, start) = trained(steps=100)
    everyone = np.arange(len(x))
    losses_of = [((outputs(c, x)[1 + folds, everyone] - y) ** 2).mean() for c in (result.copies, start)]
    assert result.loss == pytest.approx(losses_of[0], rel=1e-4)
    assert result.loss < 0.7 * losses_of[1]


def test_what_cannot_be_learned_leaves_the_start_or_stops_early():
    """Targets that are noise: held-out losses do not fall below that of 0, and the steps end after a third."""
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(60, 2)), rng.normal(size=(60, 1))
    copies = initial_copies((2, 30, 30, 1), x, 6, rng)
    result = train(copies, x, y, Folds().assign(x, y), losses.squares, 400, rng, QUIET)
    assert result.loss <= (y**2).mean() * (1 + 1e-5)
    assert result.steps < 400
    assert result.steps % training.EVERY == 0


def ridge(x, y, strength):
    return np.linalg.solve(x.T @ x + strength * np.eye(x.shape[1]), x.T @ y)


@pytest.fixture
def to_the_end(monkeypatch):
    """Let a training learn from all samples in each step and keep its last weights, whatever was held out."""
    monkeypatch.setattr(training, "COLUMNS", 10**6)
    scores = itertools.count(0, -1)
    monkeypatch.setattr(training._Scored, "loss", lambda *arguments: next(scores))


def mirrored(rng):
    """Samples whose mean is 0 in every fold, so that biases have no part."""
    x, y = rng.normal(size=(60, 3)), rng.normal(size=(60, 2))
    return np.vstack([x, -x]), np.vstack([y, -y]), np.tile(np.arange(60) % 5, 2)


@pytest.mark.parametrize("decay", [0.5, 40.0])
def test_without_hidden_layers_decay_is_ridge_regression(decay, to_the_end):
    """Of the strength λ, for every number of outputs, and for each copy with its own samples."""
    rng = np.random.default_rng(4)
    x, y, folds = mirrored(rng)
    copies = Copies([np.ones((6, 3, 2), np.float32)], [np.zeros((6, 1, 2), np.float32)])
    result = train(copies, x, y, folds, losses.squares, 3000, rng, QUIET, decay=decay)
    assert_close(result.copies.weights[0][0], ridge(x, y, decay), 1e-3)
    assert_close(result.copies.weights[0][1], ridge(x[folds != 0], y[folds != 0], decay), 1e-3)


@pytest.mark.parametrize("hidden", [(8,), (8, 6)])
def test_a_linear_start_stays_a_ridge_regression_where_nothing_bends(hidden, to_the_end):
    """Units of which nothing is handed on cannot make up for slopes that decay."""
    rng = np.random.default_rng(5)
    x, y, folds = mirrored(rng)
    copies = initial_copies((3, *hidden, 2), x, 6, rng)
    begin_linear(copies, x, y, folds)
    for layer, (weights, biases) in enumerate(zip(copies.weights, copies.biases, strict=True)):
        if layer < len(hidden):  # the other units are dead
            weights[:, :, 2:], biases[:, :, 2:] = 0.0, 0.0
        if layer:
            weights[:, 2:] = 0.0
    result = train(copies, x, y, folds, losses.squares, 3000, rng, QUIET, decay=40.0, linear=True)
    assert_close(result.copies.weights[0][0, :, :2], ridge(x, y, 40.0), 1e-3)
    for weights in result.copies.weights[1:]:
        np.testing.assert_array_equal(weights[:, :2, :2], np.broadcast_to(np.eye(2), (6, 2, 2)))


def test_decay_shrinks_what_bends(to_the_end):
    sizes = []
    for decay in (0.0, 1e4):
        rng = np.random.default_rng(5)
        x, y, folds = mirrored(rng)
        copies = initial_copies((3, 8, 2), x, 6, rng)
        result = train(copies, x, y, folds, losses.squares, 1500, rng, QUIET, decay=decay)
        sizes.append(max(np.abs(weights).max() for weights in result.copies.weights))
    assert sizes[0] > 0.5
    assert sizes[1] < 1e-2


@pytest.mark.parametrize("lengths", [(3, 5, 4), (3, 0, 4), (7,), ()])
def test_held_out_samples_are_judged_by_their_own_copy_once(lengths):
    rng = np.random.default_rng(6)
    n = sum(lengths) + 2
    x, y = (torch.from_numpy(rng.normal(size=(n, size)).astype(np.float32)) for size in (3, 2))
    copies = random_copies((3, 4, 2), 1 + len(lengths), rng)
    rows = np.split(rng.permutation(n)[: sum(lengths)], np.cumsum(lengths)[:-1]) if lengths else []
    tensors = [torch.from_numpy(a) for pair in zip(copies.weights, copies.biases, strict=True) for a in pair]
    found = training._Scored(rows, x, y).loss(tensors, losses.squares)
    each = [((outputs(copies, x.numpy()[at])[1 + k] - y.numpy()[at]) ** 2).mean(axis=-1) for k, at in enumerate(rows)]
    assert found == pytest.approx(np.concatenate(each).mean() if each else 0.0, rel=1e-5)


def test_steps_are_as_many_as_asked_for_where_the_loss_goes_on_falling():
    assert trained(steps=57)[0].steps == 57


@pytest.mark.parametrize("sizes", [(3, 2), (3, 5, 2), (3, 5, 4, 2)], ids=str)
@pytest.mark.parametrize("loss", [losses.squares, losses.gaussian, losses.asymmetric, losses.cross_entropy])
def test_gradients_by_hand_are_those_of_automatic_differentiation(sizes, loss):
    rng = np.random.default_rng(2)
    copies = random_copies(sizes, 4, rng)
    pairs = zip(copies.weights, copies.biases, strict=True)
    tensors = [torch.from_numpy(a).double().requires_grad_() for pair in pairs for a in pair]
    x, targets, weight = (
        torch.from_numpy(a) for a in (rng.normal(size=(7, 3)), rng.random((7, 2)), rng.random((4, 7)))
    )
    hidden = x.expand(4, -1, -1)
    for i in range(0, len(tensors), 2):
        hidden = hidden @ tensors[i] + tensors[i + 1]
        hidden = hidden.relu() if i < len(tensors) - 2 else hidden
    expected = torch.autograd.grad((loss(hidden, targets) * weight).sum(), tensors)
    slopes = [torch.empty_like(tensor) for tensor in tensors]
    with torch.no_grad():
        training._gradient(tensors, slopes, x, targets, weight, loss)
    for mine, theirs in zip(slopes, expected, strict=True):
        assert_close(mine.numpy(), theirs.numpy(), 1e-13)


def test_the_start_is_left_as_it_was():
    _, (_, _, _, copies) = trained()
    assert (copies.weights[-1] == 0).all()


@pytest.mark.parametrize("fails", [False, True])
def test_threads_are_as_many_as_before(fails):
    def loss(outputs, targets):
        assert torch.get_num_threads() == 1
        if fails:
            raise ZeroDivisionError
        return losses.squares(outputs, targets)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        if fails:
            with pytest.raises(ZeroDivisionError):
                trained(loss=loss, steps=3)
        else:
            trained(loss=loss, steps=3)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("n", [3, 5, 7])
def test_a_handful_of_samples(n):
    """Some folds are empty with fewer than five; every sample is left out by one copy all the same."""
    result, _ = trained(n=n)
    assert np.isfinite(result.outputs).all()
    assert np.isfinite(result.loss)
    assert all(np.isfinite(a).all() for a in result.copies.weights + result.copies.biases)


@pytest.mark.parametrize("samples", [1, 2])
def test_where_a_fold_is_all_there_is(samples):
    """A copy that leaves out everything stays where it began."""
    result, (_, _, _, start) = trained(n=samples, steps=10, folds=lambda f: np.zeros_like(f))
    for left, right in zip(arrays(result.copies, 1), arrays(start, 1), strict=True):
        np.testing.assert_array_equal(left, right)
