"""How Sphinx builds the documents: `tools/make/docs.py` runs their commands and calls it."""

from __future__ import annotations

import sys
from pathlib import Path

import gsmap

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

project = "gsmap"
author = "the gsmap developers"
version = release = gsmap.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["site", "_build_*.md"]
html_theme = "furo"
html_title = "gsmap"
html_copy_source = False
html_show_sphinx = False
myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_use_ivar = True
napoleon_use_rtype = False
copybutton_prompt_text = "$ "
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
