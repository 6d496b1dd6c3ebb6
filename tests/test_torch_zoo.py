"""Modules of all kinds against torch.func: values and Jacobians to 1e-12, Hessians to 1e-10; and what is refused."""

import numpy as np
import pytest
from small_tasks import refuses
from torch_oracles import Subject
from torch_zoo import MODULES, REFUSED

import symgraph as sg

CLOSE = (1e-12, 1e-12, 1e-10)


def some(entries, step, also=()):
    """Parameters of which one in so many, and those that are named, belong to the default suite."""
    return [
        pytest.param(entry, id=entry.name, marks=() if i % step == 0 or entry.name in also else pytest.mark.slow)
        for i, entry in enumerate(entries)
    ]


def close(errors):
    assert all(error <= most for error, most in zip(errors, CLOSE, strict=True)), errors


@pytest.mark.parametrize("entry", some(MODULES, 5))
def test_in_the_interpreter(entry):
    subject = Subject(entry)
    for seed in (5, 6):
        x = subject.point(seed)
        close(subject.by_torch(x).errors(subject.interpreted(x)))


@pytest.mark.parametrize("entry", some(MODULES, 14))
def test_in_machine_code(entry):
    subject = Subject(entry)
    x = subject.point(5)
    close(subject.by_torch(x).errors(subject.compiled(x)))


# gcc 12 once made wrong code of small products of matrices: those of attention.
@pytest.mark.parametrize("entry", some(MODULES, 35, also=("MultiheadAttention",)))
def test_in_generated_c(entry, tmp_path):
    subject = Subject(entry)
    x = subject.point(5)
    expected = subject.by_torch(x)
    value, jacobian = subject.generated(x, tmp_path)
    np.testing.assert_allclose(value, expected.value, atol=1e-12)
    np.testing.assert_allclose(jacobian, expected.jacobian, atol=1e-12)


@pytest.mark.parametrize("entry", REFUSED, ids=lambda entry: entry.name)
def test_refused_by_module_operator_and_remedy(entry):
    reads = [{f"x{i}": shape} for i, shape in enumerate(entry.shapes)]
    place = f"module {entry.path!r} " if entry.path else "the module "
    words = f"from_torch(net): {place}", entry.says, ": "
    refuses(lambda: sg.learned.from_torch(entry.make(), reads, {"y": 2}, name="net"), sg.InputError, *words)
