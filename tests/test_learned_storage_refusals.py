"""Files that are damaged, foreign or forged: each is refused by name, and costs nothing."""

import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save
from small_tasks import refuses
from stored_models import X, fitted_branches, flow, same

import symgraph as sg
from symgraph.learned import BranchNetwork, StochasticNetwork, storage


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


# Damaged and foreign


def refused(path, *words):
    refuses(lambda: StochasticNetwork.load(path), sg.StorageError, str(path), *words)


def loaded_or_refused(path):
    """Return the model, or None if an error names the file."""
    try:
        return StochasticNetwork.load(path)
    except sg.StorageError as error:
        return None if str(path) in str(error) else pytest.fail(f"{error} does not name the file")


def test_what_is_no_file_is_refused(whole, tmp_path, monkeypatch):
    refused(tmp_path, "is not a file", "`save` was given")
    refused(tmp_path / "none", "cannot be read: No such file")
    refused("/dev/zero", "is not a file")
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / "pipe", "is not a file")
    (tmp_path / "loop").symlink_to("loop")
    refused(tmp_path / "loop", "cannot be read")

    def forbidden(self, mode):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "file").write_bytes(whole)
    monkeypatch.setattr(Path, "open", forbidden)
    refused(tmp_path / "file", "cannot be read: Permission denied", "may be read")


def test_a_file_of_another_kind_is_refused(whole, folder, tmp_path):
    refuses(
        lambda: BranchNetwork.load(folder / "whole"),
        sg.StorageError,
        "holds a 'StochasticNetwork', not a BranchNetwork; load it with the class of that name",
    )
    for metadata in (None, {"format": "pt"}):
        (tmp_path / "other").write_bytes(save({"a": np.zeros(3)}, metadata))
        refused(tmp_path / "other", "a safetensors file, but none of symgraph's")
    with (tmp_path / "numpy.npy").open("wb") as file:
        np.save(file, np.zeros(3))
    refused(tmp_path / "numpy.npy", "no safetensors file", storage.REMEDY)


def test_a_file_cut_off_anywhere_is_refused(whole, tmp_path):
    path = tmp_path / "cut"
    for length in {*range(64), *range(64, len(whole), 61), *range(len(whole) - 16, len(whole))}:
        path.write_bytes(whole[:length])
        refused(path, storage.REMEDY)
    path.write_bytes(whole + b"\0")
    refused(path, "added to")


@settings(max_examples=300)
@given(data=st.data())
def test_a_flipped_bit_is_found(network, whole, folder, data):
    at = data.draw(st.one_of(st.integers(0, 3000), st.integers(0, len(whole) - 1)))
    flipped = bytearray(whole)
    flipped[at] ^= 1 << data.draw(st.integers(0, 7))
    path = folder / "flipped"
    path.write_bytes(flipped)
    loaded = loaded_or_refused(path)
    if loaded is not None:
        same(loaded, network)  # what was flipped says nothing, such as a blank


@settings(max_examples=200)
@given(st.one_of(st.binary(max_size=300), st.binary(max_size=200).map(lambda b: len(b).to_bytes(8, "little") + b)))
def test_random_bytes_are_refused(folder, content):
    (folder / "random").write_bytes(content)
    assert loaded_or_refused(folder / "random") is None


@pytest.mark.parametrize("length", [2**60, 2**63, 2**64 - 1, 2**32])
def test_a_huge_header_is_refused_unread(whole, tmp_path, length):
    (tmp_path / "file").write_bytes(length.to_bytes(8, "little") + whole[8:])
    refused(tmp_path / "file", "no safetensors file, or one that was cut off")


def test_a_long_header_is_refused_unread(whole, tmp_path):
    header = header_of(whole)
    header["__metadata__"]["more"] = " " * storage.MOST_HEADER
    (tmp_path / "file").write_bytes(with_header(whole, header))
    refused(tmp_path / "file", "its header has", f"more than the {storage.MOST_HEADER} of any model")


def test_a_huge_file_is_refused_unread(whole, tmp_path):
    with (tmp_path / "file").open("wb") as file:
        file.write(whole)
        file.truncate(1 << 40)  # without taking room on the disk
    refused(tmp_path / "file", f"{1 << 40} bytes, more than")


# Headers that someone has written on purpose: their lengths and digests are right


def forged(path, whole, change):
    """Write the file with a document, and tensors, that `change` has altered."""
    header = 8 + int.from_bytes(whole[:8], "little")
    document = json.loads(json.loads(whole[8:header])["__metadata__"]["symgraph"])
    arrays = load(whole)
    change(document, arrays)
    said = {key: value for key, value in document.items() if key not in ("format", "version", "kind", "digest")}
    if "digest" in document:
        document["digest"] = storage._digest(said, arrays)
    path.write_bytes(save(arrays, {"symgraph": json.dumps(document)}))
    return path


def set_in(keys, value):
    def change(document, arrays):
        at = document
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = value

    return change


def without(key):
    return lambda document, arrays: document.pop(key)


def replaced(name, make):
    return lambda document, arrays: arrays.__setitem__(name, make(arrays[name]))


def poisoned(value):
    def make(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return make


FORGED = {
    "nothing": (lambda document, arrays: document.clear(), ["names no format and version"]),
    "no kind": (without("kind"), ["holds a None"]),
    "other format": (set_in(["format"], "torch"), ["names no format"]),
    "version of words": (set_in(["version"], "1"), ["names no format and version"]),
    "version true": (set_in(["version"], True), ["names no format and version"]),
    "from the future": (set_in(["version"], 2), ["version 2", "this symgraph knows 1; upgrade it"]),
    "no digest": (without("digest"), ["'digest'"]),
    "no settings": (without("settings"), ["'settings'", "None"]),
    "more": (set_in(["more"], 1), ["'more'"]),
    "settings of words": (set_in(["settings"], "all"), ["'settings'", "'all'"]),
    "setting more": (set_in(["settings", "depth"], 3), ["'depth'"]),
    "name": (set_in(["settings", "name"], 3), ["name is 3"]),
    "reads": (set_in(["settings", "reads"], [["x", 3]]), ["reads = [['x', 3]]", "number of elements"]),
    "reads of words": (set_in(["settings", "reads", "x"], "2"), ["reads: size of 'x' is '2'"]),
    "reads more": (set_in(["settings", "reads", "x"], 3), ["'mean.weights_0' is F64 of shape [8, 3]", "[8, 4]"]),
    "writes empty": (set_in(["settings", "writes"], {}), ["writes = {}"]),
    "writes fewer": (set_in(["settings", "writes", "z"], 1), ["'mean.weights_2'", "[3, 5]", "[2, 5]"]),
    "hidden": (set_in(["settings", "hidden"], 8), ["hidden = 8"]),
    "hidden float": (set_in(["settings", "hidden", 0], 8.0), ["hidden[0] is 8.0"]),
    "hidden other": (set_in(["settings", "hidden", 0], 9), ["'mean.weights_0'", "[8, 3]", "[9, 3]"]),
    "hidden deeper": (set_in(["settings", "hidden"], [8, 5, 5]), ["lacks the tensors 'mean.weights_3'"]),
    "hidden 10^9": (set_in(["settings", "hidden"], [10**9]), ["has too many"]),
    "hidden 10^9 twice": (set_in(["settings", "hidden"], [10**9, 10**9]), ["[8, 3]", "[1000000000, 3]"]),
    "hidden 10^4000": (set_in(["settings", "hidden", 0], 10**4000), ["units of a layer"]),
    "propagation": (set_in(["settings", "propagation"], "diagonl"), ["propagation = 'diagonl'", "did you mean"]),
    "propagation list": (set_in(["settings", "propagation"], ["diagonal"]), ["propagation = ['diagonal']"]),
    "error": (set_in(["settings", "error"], {}), ["error = {}"]),
    "error none": (set_in(["settings", "error"], "none"), ["'networks'", "'mean', 'error'"]),
    "samples needed": (set_in(["settings", "samples_needed"], 0), ["samples_needed is 0"]),
    "no resolution": (lambda document, arrays: document["settings"].pop("resolution"), ["'settings'", "'resolution'"]),
    "resolution of words": (set_in(["settings", "resolution"], "fine"), ["resolution = 'fine'", "that counts"]),
    "resolution label": (
        set_in(["settings", "resolution", "y"], [0.1]),
        ["resolution: 'y' is not read", "Reads: 'x', 'u'"],
    ),
    "resolution negative": (set_in(["settings", "resolution", "u"], [-0.1]), ["of 'u' is [-0.1]", "of at least 0"]),
    "resolution in words": (set_in(["settings", "resolution", "x", 0], "1"), ["of 'x' = ['1', 0.0]", "not a number"]),
    "resolution none": (set_in(["settings", "resolution", "u"], None), ["of 'u' = None", "not a number"]),
    "resolution longer": (set_in(["settings", "resolution", "x"], [0.1] * 3), ["[0.1, 0.1, 0.1]", "its 2 elements"]),
    "resolution empty": (set_in(["settings", "resolution", "x"], []), ["of 'x' is []", "its 2 elements"]),
    "resolution nested": (set_in(["settings", "resolution", "u"], [[0.1]]), ["of 'u' is [[0.1]]", "its 1 elements"]),
    "resolution nan": (set_in(["settings", "resolution", "u"], [float("nan")]), ["it holds NaN"]),
    "resolution 10^400": (set_in(["settings", "resolution", "u"], [10**400]), ["of 'u'"]),
    "samples": (set_in(["samples"], -1), ["samples is -1"]),
    "samples 10^400": (set_in(["samples"], 10**400), ["samples is 1000"]),
    "networks": (set_in(["networks"], []), ["'networks'"]),
    "begun": (set_in(["networks", "mean", "begun_with"], 1.5), ["'mean': begun_with is 1.5"]),
    "copies": (set_in(["networks", "mean", "copies"], 7), ["copies is 7", "at most 6"]),
    "copies fewer": (set_in(["networks", "mean", "copies"], 5), ["'mean.copies.weights_0'", "[6, 3, 8]", "[5, 3, 8]"]),
    "copies none": (set_in(["networks", "error", "copies"], 0), ["too many", "error.copies"]),
    "known": (set_in(["networks", "mean", "known"], 10**9), ["'mean.known'", "[1000000000, 8]"]),
    "missing": (lambda document, arrays: arrays.pop("error.scale"), ["lacks the tensors 'error.scale'"]),
    "extra": (lambda document, arrays: arrays.update(a=np.zeros(2)), ["too many: 'a'"]),
    "transposed": (replaced("mean.weights_0", lambda a: np.ascontiguousarray(a.T)), ["[3, 8]", "[8, 3]"]),
    "single": (replaced("mean.weights_0", lambda a: a.astype(np.float32)), ["is F32", "not F64"]),
    "whole": (replaced("mean.weights_0", lambda a: a.astype(np.int64)), ["is I64", "not F64"]),
    "nan": (replaced("mean.weights_1", poisoned(np.nan)), ["'mean.weights_1'", "not finite"]),
    "infinite": (replaced("error.copies.biases_2", poisoned(np.inf)), ["'error.copies.biases_2'", "not finite"]),
    "no deviation": (replaced("mean.y_sd", poisoned(-1.0)), ["'mean': the scaling of y", "no deviation is below 0"]),
    "sixth fold": (replaced("mean.folds", poisoned(5)), ["'mean'", "fold that does not exist"]),
    "sample twice": (replaced("mean.known", lambda a: np.repeat(a[:1], len(a), 0)), ["'mean'", "stands in it twice"]),
}


@pytest.mark.parametrize("case", FORGED)
def test_a_forged_file_is_refused(whole, tmp_path, case):
    change, words = FORGED[case]
    path = forged(tmp_path / "file", whole, change)
    tracemalloc.start()
    refused(path, *words)
    assert tracemalloc.get_traced_memory()[1] < 20 * len(whole)
    tracemalloc.stop()


def test_a_forged_file_of_branches_is_refused(tmp_path):
    fitted_branches().save(tmp_path / "file")
    whole = (tmp_path / "file").read_bytes()
    for value, words in (
        (["in", "in"], "different names"),
        ("in", "no list"),
        (["in"], "logits"),
        ([1, 2], "different"),
    ):
        path = forged(tmp_path / "forged", whole, set_in(["settings", "branches"], value))
        refuses(lambda path=path: BranchNetwork.load(path), sg.StorageError, str(path), words, storage.REMEDY)


def with_header(whole, header):
    """The file with another header: JSON text, or what becomes JSON."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + whole[8 + int.from_bytes(whole[:8], "little") :]


def header_of(whole):
    return json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"[]", "no JSON object"),
        (b"{", "no JSON"),
        (b'{"a": 1, "a": 1}', "stands in it twice"),
        (b'{"a": NaN}', "it holds NaN"),
        (b'{"a": ' + b"9" * 5000 + b"}", "no JSON"),
        (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "recursion"),
        (b'{"a": "\\ud800"}', "no JSON"),
        (b'{"a": "\xff"}', "no JSON"),
        (b'{"__metadata__": ["symgraph"]}', "none of symgraph's"),
        (b'{"__metadata__": {"symgraph": 3}}', "none of symgraph's"),
        (b'{"__metadata__": {"symgraph": "3"}}', "no JSON object"),
    ],
)
def test_a_header_of_nonsense_is_refused(whole, tmp_path, header, words):
    (tmp_path / "file").write_bytes(with_header(whole, header))
    refused(tmp_path / "file", words)


def test_labels_that_stand_twice_are_refused(whole, tmp_path):
    header = header_of(whole)
    text = header["__metadata__"]["symgraph"].replace('"reads": {', '"reads": {"x": 2, ')
    assert text != header["__metadata__"]["symgraph"]
    header["__metadata__"]["symgraph"] = text
    (tmp_path / "file").write_bytes(with_header(whole, header))
    refused(tmp_path / "file", "stands in it twice")


TENSORS = ["mean.weights_0", "mean.known", "error.folds", "__metadata__"]
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=200)
@given(st.sampled_from(TENSORS), st.sampled_from([None, "dtype", "shape", "data_offsets"]), json_values)
def test_any_other_table_of_tensors_is_refused(whole, folder, name, field, value):
    header = header_of(whole)
    if field is None or name == "__metadata__":
        header[name] = value
    else:
        header[name][field] = value
    path = folder / "table"
    path.write_bytes(with_header(whole, header))
    assert loaded_or_refused(path) is None


@settings(max_examples=200)
@given(st.data())
def test_any_document_is_refused_or_makes_a_model(whole, folder, data):
    def change(document, arrays):
        at = document
        while True:
            key = data.draw(st.sampled_from(sorted(at)))
            if not isinstance(at[key], dict) or data.draw(st.booleans()):
                break
            at = at[key]
        at[key] = data.draw(json_values)

    path = forged(folder / "document", whole, change)
    loaded = loaded_or_refused(path)
    assert loaded is None or np.isfinite(loaded.predict(X)[0]).all()


def test_tensors_that_overlap_are_refused(whole, tmp_path):
    header = header_of(whole)
    header["mean.weights_0"]["data_offsets"] = header["error.weights_0"]["data_offsets"]
    (tmp_path / "file").write_bytes(with_header(whole, header))
    refused(tmp_path / "file", "overlap or leave gaps")
    header["mean.weights_0"]["data_offsets"][1] += 8
    (tmp_path / "file").write_bytes(with_header(whole, header))
    refused(tmp_path / "file", "'mean.weights_0' of shape [8, 3] has not as many bytes")
