"""The project around the library: the wheel, the layers, the documentation, and the rules of the tests themselves."""

import ast
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import symgraph as sg

ROOT = Path(__file__).parents[1]

# From the bottom up: a layer (a file or a folder) imports only from those before it.
LAYERS = [
    "errors",
    "slots",
    "cubature",
    "propagation",
    "model",
    "binding",
    "layout",
    "drawing",
    "requirement",
    "graph",
    "tree",
    "compile",
    "structure",
    "constraints",
    "worth",
    "folding",
    "expectation",
    "outcomes",
    "situation",
    "progress",
    "objective",
    "optimizers",
    "exploration",
    "plan",
    "plan_table",
    "planner",
    "plan_file",
    "many",
    "plots",
    "codegen",
    "learned",
]

HEAVY = {"torch", "mujoco", "matplotlib", "pyarrow", "scipy.optimize", "scipy.stats", "IPython", "pandas"}


def run(*command, cwd=ROOT, **variables):
    """Run a command and return what it printed; fail with its errors."""
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=os.environ | variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def sources(folder):
    return sorted((ROOT / folder).rglob("*.py"))


def name_of(path):
    return str(path.relative_to(ROOT))


def imported(path):
    """Every module that a file imports anywhere in it, by full name; names imported from a package count as modules."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            inside = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*inside, *(node.module or "").split(".")]).strip(".")
            yield from (f"{module}.{alias.name}" for alias in node.names)


# The wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder)
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def test_wheel_holds_symgraph_alone(wheel):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert {name.split("/")[0] for name in wheel} == {"symgraph", f"symgraph-{version}.dist-info"}


def test_wheel_holds_every_file_of_the_library_and_its_types(wheel):
    files = {path for path in (ROOT / "symgraph").rglob("*") if path.is_file() and path.parent.name != "__pycache__"}
    assert {name_of(path) for path in files} <= wheel
    assert "symgraph/py.typed" in wheel


def test_extra_all_holds_every_other_extra_but_bench():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    del extras["bench"]
    (everything,) = extras.pop("all")
    assert everything == f"symgraph[{','.join(extras)}]"


# The import


def test_import_brings_nothing_heavy():
    printed = run(
        sys.executable,
        "-c",
        "import sys, time; start = time.perf_counter(); import symgraph; "
        "print(time.perf_counter() - start, *sys.modules)",
    )
    seconds, *modules = printed.split()
    print(f"import symgraph: {float(seconds):.2f} s")
    assert not HEAVY & set(modules)


# The layers


@pytest.mark.parametrize("path", sources("symgraph"), ids=name_of)
def test_library_imports_from_layers_below(path):
    layer = path.relative_to(ROOT / "symgraph").with_suffix("").parts[0]
    if layer == "__init__":
        return  # the public names come from everywhere
    assert layer in LAYERS, f"give symgraph/{layer} its place in LAYERS, and in docs/architecture.md"
    assert "symgraph" not in set(imported(path)), "import from the file that defines the name"
    used = {name.split(".")[1] for name in imported(path) if name.startswith("symgraph.")}
    above = used - set(LAYERS[: LAYERS.index(layer) + 1])
    assert not above, f"symgraph/{layer} imports from layers above it"


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [("symgraph", {"models", "sims"}), ("models", {"sims"}), ("sims", {"symgraph", "models"})],
)
def test_folders_stay_apart(folder, forbidden):
    used = {name.split(".")[0] for path in sources(folder) for name in imported(path)}
    assert not used & forbidden


def test_tests_are_no_packages():
    assert not list((ROOT / "tests").rglob("__init__.py"))


# The documentation


@pytest.mark.parametrize("name", sg.__all__)
def test_public_name_is_documented(name):
    public = getattr(sg, name)
    if inspect.isclass(public) or inspect.isroutine(public):
        assert inspect.getdoc(public)
        assert re.search(rf"^\.\. auto\w+:: {name}$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    for member, value in vars(public).items() if inspect.isclass(public) else ():
        if not member.startswith("_") and (inspect.isroutine(value) or isinstance(value, property)):
            assert inspect.getdoc(getattr(public, member)), f"{name}.{member} has no docstring"


def code_of(page):
    """The Python code of a Markdown page, one script."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize(
    "page",
    [page for page in (ROOT / "README.md", *sorted((ROOT / "docs/guide").glob("*.md"))) if code_of(page)],
    ids=name_of,
)
def test_code_of_page_runs(page, tmp_path):
    (tmp_path / "page.py").write_text(code_of(page))
    run(sys.executable, "page.py", cwd=tmp_path)


def test_readme_shows_the_cannon_in_25_lines():
    lines = [line for line in code_of(ROOT / "README.md").splitlines() if line.strip()]
    assert len(lines) <= 25


@pytest.mark.parametrize("path", sources("docs/examples"), ids=name_of)
def test_example_runs(path, tmp_path):
    few = ["--episodes", "4"] if path.name == "pour.py" else []  # its 80 take minutes
    run(sys.executable, path, *few, cwd=tmp_path, PYTHONPATH=str(ROOT))


# What makes a run count


@pytest.fixture
def ruled(pytester):
    """A folder of tests under the rules of tests/conftest.py."""
    pytester.makeconftest((ROOT / "tests/conftest.py").read_text())
    return pytester


@pytest.mark.parametrize(
    ("skip", "reason"),
    [
        ("pytest.importorskip('torch')", "pip install -e '.[learned]'"),
        ("pytest.skip('no mujoco here')", "pip install -e '.[sims]'"),
        ("pytest.skip('some tool')", "install what it wants"),
    ],
)
def test_skip_fails_the_run_and_names_the_remedy(ruled, monkeypatch, skip, reason):
    monkeypatch.setitem(sys.modules, "torch", None)  # as if it were not installed
    ruled.makepyfile(f"import pytest\ndef test_it():\n    {skip}")
    result = ruled.runpytest_inprocess()
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["skipped, which fails the run: *", f"Remedy: *{reason.replace('[', '[[]')}*"])


def test_skip_by_marker_fails_the_run(ruled):
    ruled.makepyfile("import pytest\n@pytest.mark.skipif(True, reason='some tool')\ndef test_it(): pass")
    ruled.runpytest_inprocess().assert_outcomes(errors=1)


def test_skip_of_a_whole_file_fails_the_run(ruled):
    ruled.makepyfile("import pytest\npytest.skip('some tool', allow_module_level=True)")
    result = ruled.runpytest_inprocess()
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.stdout.fnmatch_lines(["skipped, which fails the run: some tool"])


def test_allowed_skip_and_expected_failure_pass(pytester):
    rules = (ROOT / "tests/conftest.py").read_text()
    assert "ALLOWED_SKIPS: set[str] = set()" in rules
    pytester.makeconftest(rules.replace("ALLOWED_SKIPS: set[str] = set()", "ALLOWED_SKIPS = {'other system'}"))
    pytester.makepyfile(
        "import pytest\n"
        "def test_skipped():\n    pytest.skip('other system')\n"
        "@pytest.mark.xfail(reason='known')\ndef test_known():\n    assert False"
    )
    pytester.runpytest_inprocess().assert_outcomes(skipped=1, xfailed=1)


def test_run_without_a_compiler_fails_and_names_it(ruled, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda command: None)
    ruled.makepyfile("def test_it(): pass")
    result = ruled.runpytest_inprocess()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*the tests need a C compiler (cc or gcc or clang): apt-get install gcc*"])


def test_make_without_python_says_so(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    for python, words in (("", "No Python 3.11 or newer"), ("false", "PYTHON=false is not a Python 3.11")):
        done = subprocess.run(["make", "test", f"PYTHON={python}"], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode != 0
        assert words in done.stderr


def test_ci_can_be_executed():
    assert os.access(ROOT / ".ci/run", os.X_OK)
    assert "set -euo pipefail" in (ROOT / ".ci/run").read_text()
