"""The site: `make docs`."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

import symgraph as sg
from symgraph.drawing import Diagram

sys.path.insert(0, str(Path(__file__).parents[1]))  # models and sims, for the examples

project = "symgraph"
author = "the symgraph developers"
copyright = "2026, the symgraph developers"  # noqa: A001  # Sphinx's name for it
version = release = installed("symgraph")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
# The page on pouring waits for its figures; it goes into the toctree of reproduction/index.md with them.
exclude_patterns = ["_build", "examples"]
default_role = "py:obj"  # `name` is code, and a link where the name has a page

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3

napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # "Attributes:" beside the fields' own entries
napoleon_custom_sections = [("Source", "notes_style")]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
add_module_names = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    # Every example runs, and one that fails fails the build; but pouring takes minutes, and runs as a test.
    "filename_pattern": r"^(?!.*pour\.py$)",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "image_scrapers": ("matplotlib",),
    "capture_repr": ("_repr_html_", "__repr__"),
}

html_theme = "furo"
html_title = f"symgraph {release}"
html_copy_source = False
html_static_path = []
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

for drawn in (sg.Graph, sg.Tree, sg.Plan, Diagram):  # the gallery shows HTML, and SVG is HTML
    drawn._repr_html_ = drawn._repr_svg_


def ready(app, what, name, obj, options, lines):
    """Turn docstrings, which are written for the terminal, into what napoleon and reStructuredText expect."""
    # A colon in the first line of a property would read as "type: description"; an empty comment stands before it.
    written = ["..", ""] if what == "property" else []
    for line in lines:
        if line.startswith("Source: "):  # a section, so that its further lines are not taken for a definition
            written += ["Source:", "    " + line.removeprefix("Source: ")]
        else:
            written.append(line.replace("|", r"\|"))  # |x| is an absolute value, not a substitution
    lines[:] = written


def setup(app):
    """Connect to Sphinx's events."""
    app.connect("autodoc-process-docstring", ready, priority=400)  # before napoleon
