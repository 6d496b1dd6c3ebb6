"""export_c: from an objective to a folder with a planner in C."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from symgraph.codegen.description import checked_name, describe
from symgraph.codegen.foresight import foresight
from symgraph.codegen.header import header
from symgraph.codegen.items import functions_in
from symgraph.codegen.pages import build_file, main_program, manual
from symgraph.codegen.programs import programs_of
from symgraph.codegen.ros2 import copies, package_name, ros2_files
from symgraph.codegen.settings import settings_of
from symgraph.codegen.source import planner_source
from symgraph.codegen.stack import stack_of
from symgraph.codegen.weights import numbers_of, packed
from symgraph.errors import InputError, StorageError, did_you_mean, names
from symgraph.objective import PRECISIONS, Objective
from symgraph.optimizers import Lbfgs, Optimizer
from symgraph.progress import Progress


def export_c(
    objective: Objective,
    folder: str | Path,
    *,
    name: str = "planner",
    optimizer: Optimizer | None = None,
    uncertain: Iterable[str] = (),
    precision: Literal["double", "single"] | None = None,
    weights: Literal["constants", "file"] = "constants",
    ros2: bool = False,
    progress: bool = True,
) -> Path:
    """Write the planner of a task as C: `solve`, and value, gradient and outcomes, for a robot without Python.

    The folder gets `<name>.h` and `<name>.c`, standard C99 that is C++17 too and needs the C library alone, `main.c`, a
    program around them, `CMakeLists.txt`, `README.md` and `<name>.json`, by which `CPlanner` knows it; with
    `weights="file"` also `<name>.weights`. The C planner draws the same start points from the same seed as `solve` and
    climbs in the same steps, so that it finds the same plans, but for rounding.

    Args:
        objective: of the task.
        folder: where to; made where it is not there, files of the same names are replaced.
        name: of the files, and what public names in C begin with.
        optimizer: `Lbfgs()` if left out; else `Adadelta(…)`, or `Enumerate` of one of these.
        uncertain: start states that will come with a covariance; others are exact.
        precision: of the models' arithmetic, the objective's own if left out; "single" halves memory, and is for
            processors that are slow at doubles. The search itself computes in double, to a tolerance of 1e-5 at least.
        weights: of learned models and other parameters: "constants" of the C file, or a "file" that the program hands
            over, so that a model fitted anew needs no new build.
        ros2: write a ROS 2 package with a planning service too, to `ros2/<name>_planning`.
        progress: show a progress bar where it takes longer than two seconds.

    Returns:
        the folder.

    Raises:
        InputError: no objective, a name that is no C identifier, states that are none, an optimizer that needs a
            library.
        CompileError: a model calls what has no C of its own, as CasADi's solvers and callbacks.
        StorageError: the folder cannot be written.
    """
    if not isinstance(objective, Objective):
        raise InputError(f"export_c takes an Objective, got {type(objective).__name__}; write Objective(unroll(graph))")
    name = checked_name(name)
    optimizer = Lbfgs() if optimizer is None else optimizer
    precision = objective.precision if precision is None else precision
    if precision not in PRECISIONS:
        raise InputError(f"export_c: precision = {precision!r}; give 'double' or 'single'")
    if weights not in ("constants", "file"):
        raise InputError(f"export_c: weights = {weights!r}; give 'constants' or 'file'")
    labels = _uncertain(objective, uncertain)
    _warn_of_lacking(objective)
    sizes = tuple(slot.size for slot in objective.graph.selections().values())
    settings = settings_of(optimizer, objective.n_actions, sizes, precision == "single")
    with Progress("writing C", progress) as bar:
        bar.wait("writing C")
        expectation = objective.build(labels).expectation
        outcomes, writes = foresight(objective.tree, expectation.inputs)
        programs = programs_of(expectation, outcomes)
        numbers = numbers_of(programs, [p.value.ravel(order="F") for p in expectation.inputs.parameters])
        description = describe(
            objective,
            expectation,
            writes,
            name=name,
            precision=precision,
            weights_in=weights,
            optimizer=settings.name,
            settings=settings.given,
            most_starts=int(settings.macros["MOST_GUESSES"]),
            notes=_notes(objective),
        )
        source = planner_source(description, programs, settings, numbers)
        stack = stack_of(source.text)
        description = description.with_sizes(source.task, len(numbers), source.memory, stack)
        public, inside = _named(header(description), name), _named(source.text, name)
        _check_clash(name, public, source.text)
        files: dict[str, str | bytes] = {
            f"{name}.h": public,
            f"{name}.c": inside,
            "main.c": _named(main_program(description), name),
            "CMakeLists.txt": build_file(description),
            "README.md": _named(manual(description), name),
            f"{name}.json": json.dumps(description.to_dict(), indent=1) + "\n",
        }
        if weights == "file":
            files[f"{name}.weights"] = packed(numbers, precision, source.task)
        if ros2:
            package = f"ros2/{package_name(description)}"
            files |= {f"{package}/{path}": text for path, text in ros2_files(description).items()}
            files |= {f"{package}/{path}": files[file] for file, path in copies(description).items()}
    folder = Path(folder)
    try:
        for file, content in files.items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if weights != "file":
            (folder / f"{name}.weights").unlink(
                missing_ok=True
            )  # of an earlier export: they would be taken for its own
    except OSError as error:
        raise StorageError(f"export_c cannot write to {str(folder)!r}: {error}; give another folder") from error
    return folder


def _uncertain(objective: Objective, labels: Iterable[str]) -> frozenset[str]:
    given = [labels] if isinstance(labels, str) else list(labels)
    needed = objective.tree.needed_states
    for label in given:
        if label not in needed:
            hint = did_you_mean(label, needed)
            raise InputError(f"export_c: uncertain {label!r} is no start state{hint} Start states: {names(needed)}")
    return frozenset(given)


def _warn_of_lacking(objective: Objective) -> None:
    for model in objective.tree.models:
        if model.lacking:
            warnings.warn(
                f"export_c: model {model.name!r} has {model.lacking}; where solve explores, a planner in C trusts it",
                stacklevel=3,
            )


def _notes(objective: Objective) -> list[str]:
    cuts = sum(node.cut for node in objective.tree.nodes)
    if not cuts:
        return []
    return [
        f"{cuts} paths are cut where a node recurs more than {objective.tree.max_visits} times; they count as "
        f"{objective.tree.cut_value:g} from there"
    ]


def _check_clash(name: str, public: str, source: str) -> None:
    """Refuse a name with which public names would be those of something inside the C file.

    Args:
        name: of the planner.
        public: its header.
        source: its C file, still with `planner_` in the place of the name.
    """
    inside = set(functions_in(source)) | set(re.findall(r"^#define (\w+)", source, re.MULTILINE))
    inside |= set(re.findall(r"^static const \w+ (\w+)", source, re.MULTILINE))
    own = {word for word in inside if word.lower().startswith("planner_")}
    declared = set(re.findall(rf"\b(?:{name}|{name.upper()})_\w+", public))
    declared |= {f"{name}_{word[len('planner_') :]}" for word in own if word.startswith("planner_")}
    clash = sorted((inside - own) & declared)
    if clash:
        raise InputError(
            f"export_c: name = {name!r} makes {clash[0]!r}, which stands for something else; give another name"
        )


def _named(text: str, name: str) -> str:
    text = re.sub(r"\bplanner_(?=\w)", f"{name}_", text)
    text = re.sub(r"\bPLANNER_(?=\w)", f"{name.upper()}_", text)
    return text.replace('"planner.h"', f'"{name}.h"')
