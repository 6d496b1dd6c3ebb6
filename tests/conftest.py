"""Rules of every test run: its tools are there, and no test is skipped unseen."""

import os
import shutil

import pytest
from hypothesis import settings

pytest_plugins = ["pytester"]

# What it is: (commands, of which one will do; how to get it).
REQUIRED_TOOLS = {"C compiler": (("cc", "gcc", "clang"), "apt-get install gcc libc6-dev")}
# What generated C is tried with besides, where it is there; CI has it all.
CI_TOOLS = {
    "C++ compiler": (("g++",), "apt-get install g++"),
    "second C compiler": (("clang",), "apt-get install clang"),
    "memory checker": (("valgrind",), "apt-get install valgrind"),
}

# Packages that only some tests import, and the extra of pyproject.toml that brings each.
OPTIONAL_PACKAGES = {
    "distributed": "dev",
    "gymnasium": "sims",
    "imageio": "sims",
    "matplotlib": "plots",
    "mujoco": "sims",
    "pandas": "dev",
    "pyarrow": "learned",
    "safetensors": "learned",
    "scoringrules": "learned",
    "torch": "learned",
}

# Reasons, word for word, for which a test may be skipped: whatever no installation could change.
ALLOWED_SKIPS: set[str] = set()

os.environ.setdefault("MPLBACKEND", "Agg")  # pictures open no windows
settings.register_profile("symgraph", settings(), deadline=None)  # the first call compiles
settings.load_profile("symgraph")


def pytest_configure(config):
    required = REQUIRED_TOOLS | (CI_TOOLS if os.environ.get("SYMGRAPH_CI") else {})
    for tool, (commands, remedy) in required.items():
        if not any(shutil.which(command) for command in commands):
            raise pytest.UsageError(f"the tests need a {tool} ({' or '.join(commands)}): {remedy}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return refuse_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return refuse_skip((yield))


def refuse_skip(report):
    """Turn a skip into a failure that says what to install, unless its reason is allowed."""
    if not report.skipped or hasattr(report, "wasxfail"):
        return report
    _, _, message = report.longrepr
    reason = message.removeprefix("Skipped: ")
    if reason in ALLOWED_SKIPS:
        return report
    wanted = [f"pip install -e '.[{OPTIONAL_PACKAGES[name]}]'" for name in OPTIONAL_PACKAGES if name in reason]
    remedy = " or ".join(dict.fromkeys(wanted)) or "install what it wants, or allow the reason in tests/conftest.py"
    report.outcome = "failed"
    report.longrepr = f"skipped, which fails the run: {reason}\nRemedy: {remedy}"
    return report
