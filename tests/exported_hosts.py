"""Programs in C around generated planners, built with what finds faults, and run."""

import re
import shutil
import subprocess

import numpy as np
from exported_tasks import task

import symgraph as sg

STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic")
C, CXX = ("-std=c99", *STRICT), ("-x", "c++", "-std=c++17", *STRICT)
# Those that are here; CI has them all.
COMPILERS = {
    name: (name, *flags)
    for name, flags in {"gcc": C, "clang": C, "g++": CXX, "clang++": CXX}.items()
    if shutil.which(name)
}
CC = next(name for name in ("gcc", "cc", "clang") if shutil.which(name))
SANITIZERS = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")


def identifier(name):
    """The planner's name for a task."""
    return re.sub(r"\W", "_", name)


def export(name, folder, **options):
    """Write the planner of a task."""
    objective, uncertain = task(name)
    return sg.export_c(objective, folder, name=identifier(name), uncertain=uncertain, progress=False, **options)


def run(*command, status=0, **options):
    """Run a command that must end with a status; return what it printed."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout


def built(folder, name, program, target, *flags, compiler=(CC, *C)):
    """Build a program, whose names begin with `planner_`, with a planner of a folder; return where it is."""
    text = re.sub(r"\bplanner_", f"{name}_", re.sub(r"\bPLANNER_", f"{name.upper()}_", program))
    source = target.with_suffix(".c")
    source.write_text(f'#define _POSIX_C_SOURCE 200112L\n#include "{name}.h"\n{text}')
    run(*compiler, *flags, f"-I{folder}", source, folder / f"{name}.c", "-o", target, "-lm", "-lpthread")
    return target


def numbers(name, state):
    """A start state as the header's structure has it."""
    objective, _ = task(name)
    situation = objective.situation(state)
    return [repr(float(x)) for x in np.concatenate([situation.means, situation.covariances])]
