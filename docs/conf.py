"""How Sphinx builds the site: `python -m sphinx -W --keep-going -n -b html docs OUT`. Nothing is fetched from anywhere."""

import sys
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import kfgs  # noqa: E402

project, author, copyright = "kfgs", "The kfgs developers", "The kfgs developers, Apache-2.0"
version = release = kfgs.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
    "kfgs_commands",
    "kfgs_gallery",
    "kfgs_live",
    "kfgs_references",
    "kfgs_shapes",
    "kfgs_offline",
]
exclude_patterns = ["_build", "_ext", "pictures", "runs"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # notebooks are shown with the outputs that are in the file
nb_ipywidgets_js: dict[
    str, dict[str, str]
] = {}  # they would come from a server: of a viewer its still picture is shown
nb_mime_priority_overrides = [
    ("html", kind, None) for kind in ("application/vnd.jupyter.widget-view+json", "application/javascript")
]

default_role = "py:obj"  # `Scene` in a docstring is a link if there is a page of it
add_module_names = False
python_use_unqualified_type_names = True
python_display_short_literal_types = True
python_maximum_signature_line_length = 80
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "undoc-members": True,
}  # fields that have a comment beside them; see kfgs_shapes
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
napoleon_use_rtype = False
napoleon_custom_sections = ["Convention"]
nitpick_ignore_regex = [
    ("py:obj", ".*"),  # the default role: not all that stands in backticks is a name
    ("py:.*", r"(?!kfgs).*"),  # names of other packages: their pages are not on this machine
]

html_theme = "furo"
html_title = f"kfgs {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
templates_path: list[str] = []
copybutton_exclude = ".linenos, .gp, .go"

# MathJax in one file, from a wheel; without it the site would ask a server for it.
_mathjax = find_spec("sphinx-mathjax-offline")
if _mathjax is None:
    raise ImportError('the site needs MathJax; run: pip install -c constraints.txt torch==2.13.0 ".[docs]"')
html_static_path.append(str(Path(str(_mathjax.origin)).parent / "static" / "mathjax" / "tex-svg.js"))
mathjax_path = "tex-svg.js"
mathjax3_config = {"options": {"enableMenu": False}}  # some of the menu's entries load from a server
