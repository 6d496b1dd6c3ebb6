"""The errors: their kinds, and the hints that their messages are made of."""

import inspect

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import symgraph as sg
from symgraph import errors

# What a Python user would expect each kind to be.
BUILTIN = {
    sg.SlotError: ValueError,
    sg.GraphError: ValueError,
    sg.InputError: ValueError,
    sg.SolveError: RuntimeError,
    sg.CompileError: RuntimeError,
    sg.StorageError: OSError,
    sg.MissingExtraError: ImportError,
}


@pytest.mark.parametrize("kind", BUILTIN)
def test_kind_is_a_symgraph_error_and_what_python_users_expect(kind):
    assert issubclass(kind, sg.SymgraphError)
    assert issubclass(kind, BUILTIN[kind])


def test_every_kind_is_public():
    kinds = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, sg.SymgraphError)]
    assert set(kinds) == {sg.SymgraphError, *BUILTIN}
    assert all(getattr(sg, kind.__name__) is kind and kind.__name__ in sg.__all__ for kind in kinds)


def test_missing_extra_names_the_package_its_purpose_and_the_command():
    message = str(sg.MissingExtraError("torch", "learned", "fitting a network"))
    assert message == "fitting a network needs the package 'torch': install it with  pip install 'symgraph[learned]'"


@pytest.mark.parametrize(
    ("labels", "listed"), [((), "(none)"), (("a",), "'a'"), (("b", "a", "b"), "'b', 'a'"), (("it's",), '"it\'s"')]
)
def test_names_are_listed(labels, listed):
    assert errors.names(labels) == listed
    assert errors.names(iter(labels)) == listed


@pytest.mark.parametrize(
    ("name", "options", "meant"),
    [
        ("lowr", ["lower", "upper"], "lower"),
        ("Lower", ["upper", "lower"], "lower"),
        ("muzle", ["target", "lower_muzzle"], "lower_muzzle"),  # a word of the label
        ("targt", ["speed", "target", "targets"], "target"),
        ("x1", ["x2", "x10", "x1y"], "x10"),  # the first of equals
        ("abc", ["xyz"], None),
        ("abc", [], None),
        ("abc", [""], None),
        ("", ["abc"], None),
        ("same", ["same", "same"], "same"),
    ],
)
def test_did_you_mean(name, options, meant):
    hint = errors.did_you_mean(name, options)
    assert hint == (f"; did you mean {meant!r}?" if meant else ".")


@settings(max_examples=30)
@given(st.lists(st.text(min_size=1), min_size=1, max_size=4, unique_by=str.lower), st.data())
def test_a_name_that_exists_is_always_meant(options, data):
    name = data.draw(st.sampled_from(options))
    hint = errors.did_you_mean(name, options)
    best = [option for option in options if repr(option) in hint]
    assert best
    assert any(part.lower() == name.lower() for option in best for part in [option, *option.split("_")])


@settings(max_examples=30)
@given(st.text(), st.lists(st.text(), max_size=4))
def test_a_hint_never_fails_and_only_names_options(name, options):
    hint = errors.did_you_mean(name, options)
    assert hint == "." or any(hint == f"; did you mean {option!r}?" for option in options)
