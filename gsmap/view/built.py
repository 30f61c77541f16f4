"""Find the built page of `gsmap view`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from gsmap.errors import ConfigError

FOLDER = "built"


def built_page() -> Path:
    """Return the folder of the built page: ``index.html``, script, style and licences.

    Raises:
        ConfigError: The page is not built.
    """
    folder = Path(str(resources.files("gsmap.view"))) / FOLDER
    if not (folder / "index.html").is_file() or not (folder / "page.js").is_file():
        raise ConfigError(
            "the page of gsmap view is not built: in a checkout run tools/build_page.sh (needs Node.js with npm); a "
            "package contains the page if npm was installed when the package was built",
            code="page_not_built",
        )
    return folder
