"""Small tasks, and how a refused call is judged, for many test files."""

import numpy as np
import pytest

import symgraph as sg


def refuses(call, kind, *words):
    """The call raises this kind of error, and its message holds all the words."""
    with pytest.raises(sg.SymgraphError) as caught:
        call()
    message = str(caught.value)
    assert type(caught.value) is kind, message
    missing = [word for word in words if word not in message]
    assert not missing, f"{missing} not in: {message}"
    assert "?." not in message, f"a question with a full stop: {message}"
    assert ".." not in message.replace("...", ""), f"two full stops: {message}"


def objective_of(graph, compiled=False, **options):
    return sg.Objective(sg.unroll(graph, **options), compiled=compiled)


def over_box(function, low, high, compiled=False, states=None):
    """The objective that maximises function(u, further slots) over low <= u <= high."""
    size = np.size(low)
    graph = sg.Graph({"u": sg.Action(size, low=low, high=high), **(states or {})}, start="here")
    graph.reward("here", function)
    return objective_of(graph, compiled)


def fork(left, right, low=-1.0, high=1.0, reward=lambda y: y, compiled=False):
    """The objective of one selection between two ways to compute y from the action u."""
    slots = {"u": sg.Action(low=low, high=high), "way": sg.Selection(["left", "right"]), "y": sg.State()}
    graph = sg.Graph(slots, start="fork")
    graph.choose("fork", "way", {"left": ("end", left), "right": ("end", right)})
    graph.reward("end", reward)
    return objective_of(graph, compiled)


def assert_close(got, expected, tolerance=1e-12):
    """Within the tolerance relative to 1 + the largest number."""
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * (1 + np.max(np.abs(expected), initial=0.0)))
