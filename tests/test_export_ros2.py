"""Packages for ROS 2, built against a stub of it (tests/ros2_stub): the node answers what the planner plans."""

import json
import os
import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from exported_tasks import situations, stacked, task

import symgraph as sg
from symgraph.codegen.description import Description
from symgraph.codegen.ros2 import copies, package_name, ros2_files

STUB = Path(__file__).parent / "ros2_stub"
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")
CLOSE = 1e-9  # values, relative: compilers round differently
FIELD = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")  # rosidl's rule, of packages too
CONSTANT = re.compile(r"[A-Z]([A-Z0-9_]?[A-Z0-9]+)*")
KINDS = {"float64": "double", "uint64": "std::uint64_t", "int32": "std::int32_t", "string": "std::string"}


def run(*command, code=0, **options):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout if code == 0 else done.stderr


def odd():
    """Labels and choices that rosidl, C++ and Python would not take, and that are alike in lower case."""
    graph = sg.Graph(
        {
            "Speed": sg.State(unit="m/s"),
            "speed": sg.State(2, unit="µ[m]"),
            "lambda_": sg.State(),
            "seed": sg.State(unit='"'),
            "speed_covariances_": sg.State(),
            "double": sg.Action(low=-10, high=10, unit="m"),
            "value": sg.Action(2, low=-10, high=10),
            "Status": sg.Selection(['the "first"', "what??\\é"]),
        },
        start="here",
    )
    graph.choose("here", "Status", {'the "first"': ("one", None), "what??\\é": ("two", None)})
    graph.reward("one", lambda Speed, speed, double: -((double - Speed) ** 2) - speed[0] ** 2)
    graph.reward(
        "two",
        lambda lambda_, seed, speed, speed_covariances_, value: (
            -((value[0] - lambda_) ** 2) - (value[1] - seed * speed_covariances_) ** 2 - speed[1] ** 2
        ),
    )
    return sg.Objective(sg.unroll(graph)), ("Speed", "speed")


class Package:
    """A package of a planner: written, built against the stub, and called."""

    def __init__(self, folder, name, objective, uncertain, **options):
        self.folder, self.exported = folder / "package", folder / "exported"
        sg.export_c(objective, self.exported, name=name, uncertain=uncertain, **options)
        self.planner = sg.CPlanner(self.exported)
        self.description = Description.from_dict(json.loads((self.exported / f"{name}.json").read_text()))
        self.files = ros2_files(self.description)
        for path, text in self.files.items():
            self.write(path, text.encode())
        for file, path in copies(self.description).items():
            self.write(path, (self.exported / file).read_bytes())
        self.name = package_name(self.description)
        self.asked, self.answered, self.constants = parsed(self.files["srv/Plan.srv"])

    def write(self, path, content):
        (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / path).write_bytes(content)

    def build(self):
        """Do what CMakeLists.txt says: its commands are ROS's, but files and targets are these."""
        name = self.description.name
        made = self.folder.parent / "made"
        generated = made / self.name / "srv/plan.hpp"
        generated.parent.mkdir(parents=True)
        generated.write_text(service_header(self.name, self.asked, self.answered, self.constants))
        run("gcc", "-std=c99", *STRICT, "-c", self.folder / f"src/{name}.c", "-o", made / "core.o")
        node, includes = self.folder / f"src/{name}_node.cpp", ("-I", STUB, "-I", made)
        self.program = made / f"{name}_node"
        run("g++", "-std=c++17", *STRICT, *includes, node, made / "core.o", "-o", self.program, "-lm")
        share = made / "share" / self.name
        share.mkdir(parents=True)
        for path in (self.folder / "weights").glob("*"):
            (share / path.name).write_bytes(path.read_bytes())
        return self

    def call(self, *requests, parameters=(), code=0):
        """Return the response to each request, {field: numbers or text}; "shutdown" is no request."""
        said = "".join(
            "shutdown\n" if request == "shutdown" else "\n".join([*map(line, request.items()), "\n"])
            for request in requests
        )
        given = [word for parameter in parameters for word in ("-p", parameter)]
        variables = os.environ | {"AMENT_PREFIX_PATH": str(self.folder.parent / "made")}
        told = run(self.program, "--ros-args", *given, code=code, input=said, env=variables)
        if code:
            return told
        kinds = dict(map(reversed, self.answered))
        return [
            {field: read(kinds[field], text) for field, _, text in (row.partition(" ") for row in block.splitlines())}
            for block in told.split("\n\n")[:-1]
        ]


def line(item):
    field, value = item
    return " ".join([field, *(f"{number:.17g}" if isinstance(number, float) else str(number) for number in value)])


def read(kind, text):
    if kind == "string":
        return text
    numbers = np.array(text.split(), dtype=float)
    return numbers if kind.endswith("]") else numbers[0]


def parsed(service):
    """Return what a .srv asks and answers, (kind, field) each, and {constant: number}."""
    asked, answered, constants = [], [], {}
    for side, text in zip((asked, answered), service.split("---\n"), strict=True):
        for row in text.splitlines():
            words = row.partition("#")[0].split()
            if words and "=" in words[1]:
                constant, _, number = words[1].partition("=")
                constants[constant] = int(number)
            elif words:
                side.append(tuple(words))
    return asked, answered, constants


def service_header(package, asked, answered, constants):
    """Return what rosidl makes of a service, as far as the node and the stub use it."""

    def structure(name, fields):
        yield f"struct {name} {{"
        for kind, field in fields:
            base, _, size = kind.rstrip("]").partition("[")
            element = KINDS[base]
            whole = f"std::array<{element}, {size}>" if size else f"std::vector<{element}>"
            yield f"  {whole if '[' in kind else element} {field}{{}};"
        yield "  template <class Visitor> void visit(Visitor &&visitor) {"
        yield from (f'    visitor("{field}", {field});' for _, field in fields)
        yield "  }"

    return "\n".join(
        [
            "#pragma once",
            *(f"#include <{name}>" for name in ("array", "cstdint", "string", "vector")),
            f"namespace {package}::srv {{ struct Plan {{",
            *structure("Request", asked),
            "};",
            *structure("Response", answered),
            *(f"  static constexpr std::int32_t {name} = {number};" for name, number in constants.items()),
            "}; }; }\n",
        ]
    )


def asked_of(state):
    """A request for a state whose labels are its fields."""
    request = {}
    for label, value in state.items():
        mean = value.mean if isinstance(value, sg.Gaussian) else value
        request[label] = np.ravel(np.asarray(mean, dtype=float)).tolist()
        if isinstance(value, sg.Gaussian):
            request[f"{label}_covariance"] = np.ravel(value.covariance, order="F").tolist()
    return request


KEYS = {"cannon": ("cannon", {}), "push": ("push", {}), "push, weights in a file": ("push", {"weights": "file"})}


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """A function: one of KEYS → its package, built once."""
    made = {}

    def find(key):
        if key not in made:
            name, options = KEYS[key]
            made[key] = Package(tmp_path_factory.mktemp(name), name, *task(name), **options).build()
        return made[key]

    return find


@pytest.fixture(params=KEYS)
def package(request, packages):
    return packages(request.param)


@pytest.fixture(scope="module")
def odd_package(tmp_path_factory):
    return Package(tmp_path_factory.mktemp("odd"), "Odd_", *odd()).build()


# What is written


def check_fields(package):
    for fields in (package.asked, package.answered):
        names = [field for _, field in fields]
        assert len(set(names)) == len(names)
        assert all(FIELD.fullmatch(name) for name in names)
    assert all(map(CONSTANT.fullmatch, package.constants))
    assert FIELD.fullmatch(package.name)
    assert package.files["srv/Plan.srv"].isascii()


def test_names_obey_rosidl(package, odd_package):
    check_fields(package)
    check_fields(odd_package)


def test_units_are_where_rosidl_looks_for_them(package):
    d = package.description
    units = {slot.label: slot.unit for slot in (*d.given, *d.actions)}
    comments = dict(re.findall(r"^\S+ (\w+)  # (.*)$", package.files["srv/Plan.srv"], re.MULTILINE))
    for label, unit in units.items():
        assert re.findall(r"\[([^,\]]+)\]", comments[label]) == [unit]


def test_manifest_has_what_ros_requires(package):
    root = ET.fromstring(package.files["package.xml"])
    assert root.tag == "package"
    assert root.get("format") == "3"
    assert root.findtext("name") == package.name
    assert re.fullmatch(r"\d+\.\d+\.\d+", root.findtext("version"))
    assert root.findtext("description")
    assert "@" in root.find("maintainer").get("email")
    assert root.findtext("license")
    assert [one.text for one in root.findall("buildtool_depend")] == ["ament_cmake", "rosidl_default_generators"]
    assert root.findtext("exec_depend") == "rosidl_default_runtime"
    assert root.findtext("member_of_group") == "rosidl_interface_packages"
    assert root.findtext("export/build_type") == "ament_cmake"
    depends = {one.text for one in root.findall("depend")}
    build = package.files["CMakeLists.txt"]
    assert f"project({package.name} " in build
    found = set(re.findall(r"find_package\((\w+) REQUIRED\)", build)) - {"ament_cmake", "rosidl_default_generators"}
    assert found <= depends
    included = set(re.findall(r'#include "(\w+)/', package.files[f"src/{package.description.name}_node.cpp"]))
    assert included == depends | {package.name}


def test_files_that_are_built_and_installed_are_there(package):
    for path in re.findall(r"\b(?:src|srv|weights)/[\w.]+", package.files["CMakeLists.txt"]):
        assert (package.folder / path).is_file()


# What the node answers


def test_node_answers_what_the_planner_plans(package):
    states = list(situations(package.description.name, 3))
    seeds = [0, 7, 2**40 + 1]
    responses = package.call(*({**asked_of(s), "seed": [n]} for s, n in zip(states, seeds, strict=True)))
    for state, seed, response in zip(states, seeds, responses, strict=True):
        plan = package.planner.solve(state, seed=seed)
        assert response["value"] == pytest.approx(plan.value, rel=CLOSE)
        assert response["violation"] == plan.violation
        made = {label: response[label] for label in plan.actions}
        assert stacked(made) == pytest.approx(stacked(plan.actions), abs=1e-6)
        assert {label: response[label] for label in plan.selections} == plan.selections
        assert response["status"] == package.constants["STATUS_OK"]
        assert response["message"] == "ok"


def test_limits_and_seeds_are_the_requests_or_the_nodes(package):
    (state,) = situations(package.description.name, 1)
    request, status = asked_of(state), {number: name for name, number in package.constants.items()}
    short, negative, interrupted = package.call(
        {**request, "time_limit": [1e-9]}, {**request, "time_limit": [-1.0]}, "shutdown", request
    )
    assert status[short["status"]] == "STATUS_TIME_LIMIT"
    assert status[negative["status"]] == "STATUS_OPTION"
    assert status[interrupted["status"]] == "STATUS_INTERRUPTED"
    limited, patient = package.call(request, {**request, "time_limit": [60.0]}, parameters=["time_limit:=1e-9"])
    assert status[limited["status"]] == "STATUS_TIME_LIMIT"
    assert status[patient["status"]] == "STATUS_OK"
    (seeded,) = package.call({**request, "seed": [7]})
    (same,) = package.call(request, parameters=["seed:=7"])
    assert seeded.keys() == same.keys()
    assert all(np.array_equal(seeded[field], same[field]) for field in seeded)


def test_without_a_plan_no_number_looks_like_one(package):
    (state,) = situations(package.description.name, 1)
    request = asked_of(state)
    label = package.description.given[0].label
    (response,) = package.call({**request, label: [float("nan")] * len(request[label])})
    assert response["status"] == package.constants["STATUS_STATE_NOT_FINITE"]
    assert response["message"] == "a number of the state is not finite"
    for kind, field in package.answered:
        if kind.startswith("float64"):
            assert np.isnan(response[field]).all()
        elif kind == "string" and field != "message":
            assert response[field] == ""


def test_covariances_may_be_left_out_but_not_cut(packages):
    package = packages("push")
    (state,) = situations("push", 1)
    exact = asked_of({label: value.mean for label, value in state.items()})
    zeros = {"first_covariance": [0.0] * 4, "second_covariance": [0.0] * 4}
    response, same, refused = package.call(exact, {**exact, **zeros}, {**exact, "first_covariance": [1e-4] * 3})
    assert response["status"] == package.constants["STATUS_OK"]
    assert all(np.array_equal(response[field], same[field]) for field in response)
    assert refused["status"] == package.constants["STATUS_COVARIANCE"]


def test_weights_come_from_the_share_folder_or_where_the_parameter_says(packages, tmp_path):
    package = packages("push, weights in a file")
    (state,) = situations("push", 1)
    content = (package.exported / "push.weights").read_bytes()
    (tmp_path / "new").write_bytes(content)
    (tmp_path / "long").write_bytes(content + b"0" * 8)
    assert package.call(asked_of(state), parameters=[f"weights_file:={tmp_path / 'new'}"])[0]["status"] == 0
    for file, told in (("long", "too long"), ("none", "cannot be read: set the parameter weights_file")):
        assert told in package.call(parameters=[f"weights_file:={tmp_path / file}"], code=1)


def test_labels_that_ros_does_not_take(odd_package):
    assert odd_package.name == "odd_planning"
    numbers = {
        "speed": [3.0],
        "speed_2": [0.5, 0.25],
        "lambda_slot": [-2.0],
        "seed_slot": [2.0],
        "speed_covariances": [4.0],
        "speed_covariance": [0.01],
        "speed_2_covariance": [0.02, 0.005, 0.005, 0.03],
    }
    assert set(numbers) | {"seed", "time_limit"} == {field for _, field in odd_package.asked}
    state = {
        "Speed": sg.Gaussian(3.0, covariance=[[0.01]]),
        "speed": sg.Gaussian([0.5, 0.25], covariance=[[0.02, 0.005], [0.005, 0.03]]),
        "lambda_": -2.0,
        "seed": 2.0,
        "speed_covariances_": 4.0,
    }
    plan = odd_package.planner.solve(state)
    (response,) = odd_package.call(numbers)
    assert plan.selections == {"Status": "what??\\é"}
    assert response["status_slot"] == "what??\\é"
    assert response["value"] == pytest.approx(plan.value, rel=CLOSE, abs=CLOSE)
    assert response["value_slot"] == pytest.approx([-2.0, 8.0], abs=1e-6)
    assert response["double_slot"] == pytest.approx(plan.actions["double"], abs=1e-6)
