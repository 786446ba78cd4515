"""Sphinx configuration of the documentation site; `make docs` builds it."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from sacformer_jax.version import __version__

project = "sacformer-jax"
author = "The sacformer-jax authors"
project_copyright = author
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "site_tools.sphinx_extension",
]
exclude_patterns = ["_build", "site_tools", "**.ipynb_checkpoints"]

html_theme = "furo"
html_title = f"sacformer-jax {__version__}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 4
# MathML, which browsers render by themselves: nothing is fetched when a page is read.
html_math_renderer = "mathml"

# Notebooks are committed without outputs; they are executed where they changed.
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parent / "_build" / "notebooks")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True

# External links need a network: `make linkcheck`, apart from what CI runs.
linkcheck_timeout = 20
linkcheck_retries = 2
