"""What stands beside a generated planner: how it is built, a program around it, and its manual."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator

from symgraph.codegen.description import Description
from symgraph.codegen.header import STATUSES


def build_file(d: Description) -> str:
    """Return CMakeLists.txt."""
    return f"""\
cmake_minimum_required(VERSION 3.16)
project({d.name}_planner C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_STANDARD_REQUIRED ON)
set(CMAKE_C_EXTENSIONS OFF)
if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library({d.name}_planner STATIC {d.name}.c)
target_include_directories({d.name}_planner PUBLIC "${{CMAKE_CURRENT_SOURCE_DIR}}")
if(UNIX)
  target_link_libraries({d.name}_planner PUBLIC m)
endif()

if(CMAKE_SOURCE_DIR STREQUAL CMAKE_CURRENT_SOURCE_DIR) # not as a part of another project
  add_executable({d.name}_main main.c)
  target_link_libraries({d.name}_main PRIVATE {d.name}_planner)
endif()
"""


def main_program(d: Description) -> str:
    """Return main.c."""
    return "\n".join(_main(d)) + "\n"


def _main(d: Description) -> Iterator[str]:
    count = sum(slot.size + slot.uncertain * slot.size**2 for slot in d.given)
    file = d.weights_in == "file"
    words = " ".join(f"{slot.label}({slot.size})" if slot.size > 1 else slot.label for slot in d.given)
    covariances = " ".join(f"covariance of {slot.label}({slot.size**2})" for slot in d.given if slot.uncertain)
    order = " ".join(part for part in (words, covariances) if part) or "(nothing)"
    yield "/* Reads a state from its arguments, plans, and prints the plan. */"
    yield '#include "planner.h"'
    yield ""
    yield "#include <stdio.h>"
    yield "#include <stdlib.h>"
    yield "#include <string.h>"
    yield ""
    yield "/* A planner's memory must begin where a double may. */"
    yield "static union {"
    yield "  double first;"
    yield "  unsigned char bytes[PLANNER_MEMORY];"
    yield "} memory;"
    if file:
        yield "static union {"
        yield "  double first;"
        yield "  unsigned char bytes[PLANNER_WEIGHTS + 1];"
        yield "} weights;"
    yield "static planner_outcomes outcomes;"
    yield ""
    for slot in d.selections:
        listed = ", ".join(f'"{_string(choice)}"' for choice in slot.choices)
        yield f"static const char *const {slot.name}_choices[] = {{{listed}}};"
    if len(d.nodes) <= 200:
        listed = ",\n  ".join(f'"{_string(node.path)}"' for node in d.nodes)
        yield f"static const char *const paths[] = {{\n  {listed}}};"
    yield ""
    yield "int main(int count, char **arguments) {"
    usage = "usage: %s" + (" WEIGHTS_FILE" if file else "") + " [--seed N] NUMBERS\\n"
    yield f'  static const char usage[] = "{usage}"'
    yield f'                              "NUMBERS are the state, {count} in all: {_quoted(order)}\\n";'
    yield f"  double numbers[{max(count, 1)}] = {{0}};"
    yield "  planner_planner *planner;"
    yield "  planner_options options;"
    yield "  planner_state state;"
    yield "  planner_plan plan;"
    yield f"  int at = {2 if file else 1}, i, status;"
    yield "  memset(&options, 0, sizeof options);"
    yield "  memset(&state, 0, sizeof state);"
    yield '  if (count > 1 && strcmp(arguments[1], "--help") == 0) {'
    yield "    printf(usage, arguments[0]);"
    yield "    return 0;"
    yield "  }"
    yield '  if (count > at + 1 && strcmp(arguments[at], "--seed") == 0) {'
    yield "    char *end;"
    yield "    options.seed = strtoul(arguments[at + 1], &end, 10);"
    yield "    if (*end || end == arguments[at + 1]) {"
    yield "      fprintf(stderr, \"'%s' is no seed\\n\", arguments[at + 1]);"
    yield "      return 2;"
    yield "    }"
    yield "    at += 2;"
    yield "  }"
    yield f"  if (count - at != {count}) {{"
    yield "    fprintf(stderr, usage, arguments[0]);"
    yield "    return 2;"
    yield "  }"
    yield "  for (i = 0; at + i < count; ++i) {"
    yield "    char *end;"
    yield "    numbers[i] = strtod(arguments[at + i], &end);"
    yield "    if (*end || end == arguments[at + i]) {"
    yield "      fprintf(stderr, \"'%s' is no number\\n\", arguments[at + i]);"
    yield "      return 2;"
    yield "    }"
    yield "  }"
    yield f"  memcpy(&state, numbers, {count} * sizeof(double));"
    if file:
        yield "  {"
        yield '    FILE *file = fopen(arguments[1], "rb");'
        yield "    size_t bytes;"
        yield "    if (!file) {"
        yield "      fprintf(stderr, \"'%s' cannot be read\\n\", arguments[1]);"
        yield "      return 2;"
        yield "    }"
        yield "    bytes = fread(weights.bytes, 1, sizeof weights.bytes, file);"
        yield "    fclose(file);"
        yield "    status = planner_begin(memory.bytes, sizeof memory.bytes, weights.bytes, bytes, &planner);"
        yield "  }"
    else:
        yield "  status = planner_begin(memory.bytes, sizeof memory.bytes, &planner);"
    yield "  if (status == PLANNER_OK) status = planner_solve(planner, &state, &options, &plan);"
    yield "  if (status < PLANNER_OK) {"
    yield '    fprintf(stderr, "%s\\n", planner_message(status));'
    yield "    return 1;"
    yield "  }"
    for slot in d.selections:
        yield f'  printf("{_quoted(slot.label)} = %s\\n", {slot.name}_choices[plan.selections.{slot.name}]);'
    for action in d.actions:
        unit = f" {_quoted(action.unit)}" if action.unit else ""
        if action.size == 1:
            yield f'  printf("{_quoted(action.label)} = %.6g{unit}\\n", plan.actions.{action.name});'
        else:
            yield f'  printf("{_quoted(action.label)} =");'
            yield f'  for (i = 0; i < {action.size}; ++i) printf(" %.6g", plan.actions.{action.name}[i]);'
            yield f'  printf("{unit}\\n");'
    yield '  printf("value %.6g: best of %d starts; %s\\n", plan.value, plan.starts, planner_message(status));'
    yield '  if (plan.missed > 0) printf("requirements are missed, the largest by %.3g\\n", plan.missed);'
    yield "  status = planner_foresee(planner, &state, &plan.actions, &plan.selections, &outcomes);"
    yield "  for (i = 0; status == PLANNER_OK && i < PLANNER_NODES; ++i)"
    yield "    if (outcomes.probability[i] > 0)"
    what = (
        '"  %s: probability %.3g, value %.6g\\n", paths[i]'
        if len(d.nodes) <= 200
        else '"  node %d: probability %.3g, value %.6g\\n", i'
    )
    yield f"      printf({what}, outcomes.probability[i], outcomes.value[i]);"
    yield "  return 0;"
    yield "}"


def _paragraph(text: str) -> list[str]:
    return textwrap.wrap(text, 110, break_long_words=False, break_on_hyphens=False)


def _string(text: str) -> str:
    """Return text as it stands between quotes in C, without trigraphs."""
    plain = "".join(character if character.isprintable() else " " for character in text)
    return re.sub(r"\?(?=\?)", '?""', plain.replace("\\", "\\\\").replace('"', '\\"'))


def _quoted(text: str) -> str:
    """Return text as it stands in a format of printf."""
    return _string(text).replace("%", "%%")


def manual(d: Description) -> str:
    """Return README.md."""
    return "\n".join(_manual(d)) + "\n"


def _manual(d: Description) -> Iterator[str]:
    file = d.weights_in == "file"
    yield f"# The planner {d.name}"
    yield ""
    yield "From a state to the actions and choices with the highest expected reward, in C. Generated by symgraph"
    yield f"{d.version}."
    yield ""
    yield "## Build"
    yield ""
    yield f"Add `{d.name}.c` and `{d.name}.h` to your build; or add the folder with `add_subdirectory` and link"
    yield f"`{d.name}_planner`. On its own:"
    yield ""
    yield "```console"
    yield "$ cmake -B build . && cmake --build build"
    yield f"$ ./build/{d.name}_main --help"
    yield "```"
    yield ""
    yield from _paragraph(
        "It is standard C99, and C++17, and needs the C library's mathematics alone. It allocates nothing and has no "
        "variables of its own: each planner lives in memory that you hand in. Where it is possible, "
        "`-O3 -march=native` pays; with gcc on x86 processors, only together with `-fno-ipa-ra`: otherwise vector "
        "registers are left in a state in which the C library's functions are slow."
    )
    yield ""
    yield "## Use"
    yield ""
    yield "```c"
    yield "static union { double first; unsigned char bytes[PLANNER_MEMORY]; } memory;"
    yield "planner_planner *planner;"
    yield "planner_plan plan;"
    yield "planner_state state = {0};"
    if file:
        yield "/* weights: the bytes of the file, beginning where a double may */"
        yield "planner_begin(memory.bytes, sizeof memory.bytes, weights, PLANNER_WEIGHTS, &planner);"
    else:
        yield "planner_begin(memory.bytes, sizeof memory.bytes, &planner);"
    for slot in d.given[:2]:
        yield f"state.{slot.name}{'[0]' if slot.size > 1 else ''} = …;"
    yield "if (planner_solve(planner, &state, 0, &plan) >= 0) …"
    yield "```"
    yield ""
    yield from _paragraph(
        "`planner_options` says the rest: a seed, start points, what is held, budgets of evaluations and of time (with "
        "a clock of yours), and a function that is called before each evaluation, which may read the plan so far. "
        "Zeros are good defaults. `planner_value`, `planner_gradient` and `planner_foresee` tell what a point is worth "
        "and what it leads to."
    )
    yield ""
    yield from _paragraph(
        "A status of at least 0 says that there is a plan, no more. "
        + (
            "Where `plan.missed` is above 0 it misses a requirement, the one with the number `plan.worst`. "
            if d.demands
            else ""
        )
        + "Start points and held values have to lie within the bounds; `planner_value` and the like take any. "
        + ("A covariance of zeros is an exact state. " if any(slot.uncertain for slot in d.given) else "")
        + "Do not build with `-ffast-math`: the search has to notice infinity and NaN."
    )
    yield ""
    if file:
        yield from _paragraph(
            "Read the file of weights as `main.c` does, into memory that stays; `planner_begin` checks it. For new "
            "weights read the new file and call `planner_begin` again."
        )
        yield ""
    yield "| | |"
    yield "|---|---|"
    yield f"| memory of a planner | {d.memory} bytes (`PLANNER_MEMORY`) |"
    yield f"| stack of a call | at most {d.stack} bytes (`PLANNER_STACK`) |"
    yield f"| arithmetic of the models | {d.precision} |"
    where = f"`{d.name}.weights`, which must be handed in" if file else "constants"
    yield f"| weights | {d.weights} numbers, {where} |"
    yield f"| search | {d.optimizer}: {', '.join(f'{key} {value}' for key, value in d.settings.items())} |"
    yield f"| nodes of the tree | {len(d.nodes)} |"
    yield ""
    yield "## The state"
    yield ""
    yield "| member | numbers | unit |"
    yield "|---|---|---|"
    for slot in d.given:
        yield f"| `{slot.name}` | {slot.size} | {slot.unit or ''} |"
    for slot in d.given:
        if slot.uncertain:
            unit = f"({slot.unit})²" if slot.unit else ""
            yield f"| `{slot.name}_covariance` | {slot.size**2}, column by column | {unit} |"
    yield ""
    if d.actions:
        yield "## Actions"
        yield ""
        yield "| member | numbers | unit | low | high |"
        yield "|---|---|---|---|---|"
        for action in d.actions:
            low, high = (", ".join(f"{x:g}" for x in dict.fromkeys(bound)) for bound in (action.low, action.high))
            yield f"| `{action.name}` | {action.size} | {action.unit or ''} | {low} | {high} |"
        yield ""
    if d.selections:
        yield "## Selections"
        yield ""
        yield "| member | choices, from 0 |"
        yield "|---|---|"
        for selection in d.selections:
            yield f"| `{selection.name}` | {', '.join(selection.choices)} |"
        yield ""
    if d.demands:
        yield "## Requirements"
        yield ""
        for i, one in enumerate(d.demands):
            yield f"{i}. {one.told}"
        yield ""
    for note in d.notes:
        yield f"Note: {note}."
        yield ""
    yield "## What functions return"
    yield ""
    yield "| | | |"
    yield "|---|---|---|"
    for name, code, told in STATUSES:
        yield f"| {code} | `PLANNER_{name}` | {told} |"
