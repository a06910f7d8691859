"""Sphinx: a guide, notebooks that run during the build, and the reference from the docstrings."""

import importlib.metadata
import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

import lfrtorch

project = "lfrtorch"
author = "lfrtorch contributors"
release = importlib.metadata.version(project)
html_title = f"{project} {release}"
html_theme = "furo"
html_theme_options = {
    "source_repository": "https://github.com/lfrtorch/lfrtorch",
    "source_branch": "main",
    "source_directory": "docs/",
}
html_show_copyright = False

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
templates_path = ["_templates"]
exclude_patterns = ["**.ipynb_checkpoints"]
suppress_warnings = [
    "myst.header",  # a page of benchmarks/ may leave out a level of headings
    "myst-nb.lexer",  # cells of notebooks that are not run, with -D nb_execution_mode=off
]

# Markdown: links to headings.
myst_heading_anchors = 3

# Notebooks: an exception in one of them fails the build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

# Reference: a page an object, members in the order of the source.
autosummary_context = {
    "without_members": {
        f"lfrtorch.{name}"
        for name in (
            *("Preview", "LevenbergMarquardt", "Adam", "fitting.trainer.Trainer", "Snapshots"),
            *("LfrtorchError", "InputError"),
        )
    }
}
autosummary_filename_map = {  # where case alone tells a function from its result
    f"{module.__name__}.{name}": f"{module.__name__}.{name}-class"
    for module in (lfrtorch, lfrtorch.analysis)
    for name in module.__all__
    if name != name.lower() and name.lower() in module.__all__
}
autodoc_default_options = {
    "members": True,
    "exclude-members": "set_fit_request, set_score_request",  # made by scikit-learn
}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Array", "Complex", "Integers")}
TypeAliasForwardRef.__repr__ = lambda self: self.name  # in a union, too
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Shape", ("Returns", "Shape")]
python_display_short_literal_types = True
python_maximum_signature_line_length = 88

# Every reference must exist. Types of other packages have no page here.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(collections|jaxtyping|matplotlib|numpy|pathlib|scipy|threading|torch|typing)\..*"),
    ("py:class", r"\w+"),  # an alias, or a type variable
    ("py:class", r"lfrtorch\.distributed\.processes\.Shared"),
    # what functions of the package hand each other
    ("py:class", r"lfrtorch\.data\.dataset\.Undecided"),
    ("py:class", r"lfrtorch\.engine\..*\.(Layout|Matrices|Weights)"),
    ("py:class", r"lfrtorch\.maps\..*"),
]

# To other sites: `make docs-links`.
linkcheck_timeout = 20
linkcheck_anchors = False


def as_written(_app: Sphinx, what: str, _name: str, _obj: Any, _options: Any, lines: list[str]):
    """|x| is a norm, and the first words of a property are no type even before a colon."""
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda m: m[1] or r"\|", line) for line in lines]
    if what == "property":
        lines.insert(0, "\\ ")


def left_to_the_source(_app: Sphinx, _what: str, name: str, obj: Any, _skip: bool, _options: Any):
    """Constants, and the fields of named tuples, which the docstring of the class explains."""
    field = (getattr(obj, "__doc__", None) or "").startswith("Alias for field number")
    return True if field or name.isupper() else None


def readable(
    _app: Sphinx, _what: str, _name: str, _obj: Any, _options: Any, signature: str, returned: str
) -> tuple[str, str]:
    """Sphinx cannot parse the default of a field that is made anew for each object."""
    return signature and signature.replace("<factory>", "..."), returned


def setup(app: Sphinx) -> None:
    """Connect all to autodoc, the first before napoleon."""
    app.connect("autodoc-process-docstring", as_written, priority=400)
    app.connect("autodoc-skip-member", left_to_the_source)
    app.connect("autodoc-process-signature", readable)
