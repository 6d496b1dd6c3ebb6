"""Learned models in files: what comes back is what was saved."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load
from small_tasks import refuses
from stored_models import HAPPENED, X, Y, fitted, fitted_branches, flow, same

import symgraph as sg
from symgraph.learned import BranchNetwork, StochasticNetwork, storage

MORE = np.vstack([X, X[:5] + 0.01]), np.vstack([Y, Y[:5]])  # few enough for a warm start


@pytest.fixture(scope="module")
def network():
    return flow()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def whole(network, folder):
    """The bytes of a file that is as it should be."""
    network.save(folder / "whole")
    return (folder / "whole").read_bytes()


# What comes back


@pytest.mark.parametrize("error", ["likelihood", "paper", "none"])
def test_a_fit_goes_on_after_loading_as_if_nothing_had_happened(error, tmp_path):
    network = fitted(error)
    network.save(tmp_path / "network")
    loaded = StochasticNetwork.load(tmp_path / "network")
    same(loaded, network)
    np.testing.assert_array_equal(loaded.predict(X)[0], network.predict(X)[0])
    np.testing.assert_array_equal(loaded.predict(X)[1], network.predict(X)[1])
    reports = [model.fit(*MORE, seed=3, progress=False) for model in (network, loaded)]
    assert reports[0].warm
    assert reports[0].steps == reports[1].steps
    same(loaded, network)
    np.testing.assert_array_equal(loaded.predict(X)[1], network.predict(X)[1])


def test_branches_go_on_likewise(tmp_path):
    network = fitted_branches()
    network.save(tmp_path / "network")
    loaded = BranchNetwork.load(tmp_path / "network")
    same(loaded, network)
    for model in (network, loaded):
        assert model.fit(MORE[0], HAPPENED + HAPPENED[:5], seed=3, progress=False).warm
    same(loaded, network)
    np.testing.assert_array_equal(loaded.predict(X), network.predict(X))


def test_propagated_moments_are_the_same(network, whole, folder):
    loaded = StochasticNetwork.load(folder / "whole")
    for given_, expected in zip(
        loaded.predict(X[0], 0.1 * np.eye(3)), network.predict(X[0], 0.1 * np.eye(3)), strict=True
    ):
        np.testing.assert_array_equal(given_, expected)


@pytest.mark.parametrize(
    "model",
    [
        lambda: StochasticNetwork({"größe [m]": 1}, {'"y"\n': 1}, ()),
        lambda: StochasticNetwork({"x": 1}, {"y": 1, "x": 2}, [3], error="none", propagation="paper", name=""),
        lambda: BranchNetwork({"x": 2}, ("b", "a")),
    ],
    ids=["no hidden layer", "no error", "branches"],
)
def test_a_model_without_samples_comes_back(model, tmp_path):
    model = model()
    model.save(tmp_path / "file")
    loaded = type(model).load(tmp_path / "file")
    same(loaded, model)
    assert loaded.lacking == model.lacking == "0 of 3 samples"
    assert list(loaded.reads) == list(model.reads)


def test_a_view_is_saved_with_its_own_rule(network, tmp_path):
    network.with_propagation("mean").save(tmp_path / "view")
    assert StochasticNetwork.load(str(tmp_path / "view")).propagation == "mean"


def test_other_programs_can_read_the_weights(network, whole):
    np.testing.assert_array_equal(load(whole)["mean.weights_0"], network.parameters[0].value)


def test_loading_needs_no_torch_and_executes_nothing(network, tmp_path):
    network.save(tmp_path / "file")
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from symgraph.learned import StochasticNetwork\n"
        "assert not {'safetensors', 'matplotlib', 'scipy.stats', 'scoringrules'} & set(sys.modules)\n"
        "print(StochasticNetwork.load(sys.argv[1]).samples)"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "file"], capture_output=True, text=True)
    assert done.stdout == "40\n", done.stderr
    for path in (Path(sg.__file__).parent / "learned").glob("*.py"):
        assert "import pickle" not in path.read_text()


def test_without_safetensors_the_extra_is_named(network, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    monkeypatch.delitem(sys.modules, "safetensors.numpy", raising=False)
    for call in (network.save, StochasticNetwork.load):
        refuses(lambda call=call: call(tmp_path / "file"), sg.MissingExtraError, "symgraph[learned]")


# How it is written


def test_a_write_that_is_interrupted_leaves_the_old_file_whole(network, tmp_path, monkeypatch):
    path = tmp_path / "file"
    network.save(path)
    before = path.read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    for owner, step in ((os, "fsync"), (Path, "replace")):
        with monkeypatch.context() as patched:
            patched.setattr(owner, step, killed)
            with pytest.raises(KeyboardInterrupt):
                fitted_branches().save(path)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(network, tmp_path):
    network.save(tmp_path / "file")
    (tmp_path / "link").symlink_to("file")
    network.with_propagation("mean").save(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert StochasticNetwork.load(tmp_path / "file").propagation == "mean"


def test_a_file_has_the_rights_that_files_have(network, tmp_path):
    network.save(tmp_path / "file")
    (tmp_path / "other").touch()
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_what_cannot_be_written_says_so(network, tmp_path, monkeypatch):
    refuses(lambda: network.save(tmp_path / "no/file"), sg.StorageError, "no/file cannot be written", "folder that is")
    refuses(lambda: network.save(tmp_path), sg.StorageError, f"{tmp_path} cannot be written")
    refuses(lambda: network.save(tmp_path / ("x" * 300)), sg.StorageError, "cannot be written")
    for path in (3, None, "", "a\0b", "\ud800", b"file"):
        refuses(lambda path=path: network.save(path), sg.StorageError, f"path = {path!r} is no path")
        refuses(lambda path=path: StochasticNetwork.load(path), sg.StorageError, f"path = {path!r} is no path")
    odd = StochasticNetwork({"\ud800": 1}, {"y": 1}, (2,))
    refuses(lambda: odd.save(tmp_path / "odd"), sg.StorageError, "odd", "'\\ud800'; leave it out")
    long = StochasticNetwork({"x" * storage.MOST_HEADER: 1}, {"y": 1}, (2,))
    refuses(lambda: long.save(tmp_path / "long"), sg.StorageError, "long", "take shorter labels")
    assert not list(tmp_path.iterdir())
