"""The page of `gsmap view`, as it was built."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from gsmap.errors import ConfigError

FOLDER = "built"


def built_page() -> Path:
    """The folder of the built page: ``index.html``, its script, its style, and the licences of what is in it.

    Raises:
        ConfigError: it is not built.
    """
    folder = Path(str(resources.files("gsmap.view"))) / FOLDER
    if not (folder / "index.html").is_file() or not (folder / "page.js").is_file():
        raise ConfigError(
            "the page of gsmap view is not built: in a checkout run tools/build_page.sh (Node.js with npm); a package "
            "has it where npm was there when it was built",
            code="page_not_built",
        )
    return folder
