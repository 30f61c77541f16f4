"""Make the pictures of the documents anew: docs/pictures/*.jpg, which are in the repository so that a forge shows them.

    python -m tools.make.doc_pictures [--keep DIR]

Runs the commands of docs/start.md in a folder, unless it has their map, and takes pictures of what they leave and of
`gsmap view` in a headless Chromium. Needs what `tools/setup.sh test` installs.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from tools.harness import argument_parser
from tools.make.docs import DOCS, ROOT, commands_of, run_commands

PICTURES = DOCS / "pictures"
_WIDTH_PX, _QUALITY = 1280, 78


def make_pictures(folder: Path) -> None:
    """Make all pictures from the map in a folder."""
    PICTURES.mkdir(exist_ok=True)
    (pair,) = sorted((folder / "why").glob("*.png"))[:1]
    for path, name in ((folder / "trial" / "map.png", "demo"), (pair, "pair"), (folder / "seen" / "c1.png", "change")):
        save(np.asarray(Image.open(path).convert("RGB")), name)
    page_pictures(folder / "home.gsmap")


def page_pictures(path: Path) -> None:
    """Take screenshots of `gsmap view`: the map from above, a pair and a change under review, and the objects."""
    sys.path.insert(0, str(ROOT / "tests" / "view"))
    from hands import Hands
    from headless import Page

    import gsmap.map

    def take(hands: Hands, name: str) -> None:
        hands.wait("globalThis.gsmap?.settled && findAll('img').every((e) => e.naturalWidth)", 600)
        save((hands.page.picture() * 255).astype(np.uint8), name)

    with (
        gsmap.map.open(path) as m,
        m.view().start() as server,
        tempfile.TemporaryDirectory() as profile,
        Page(server.url, Path(profile) / "desk", 1000, 640) as page,
    ):
        hands = Hands(page)
        hands.wait("globalThis.gsmap?.isShown", 600)
        take(hands, "page")
        hands.press("2")
        hands.click("button", "All")
        hands.click("button.choose", "capture_b")
        hands.wait("findAll('img').length >= 2", 60)
        take(hands, "page_review")
        hands.press("Escape", "3")
        hands.click("button.choose", "isappeared")
        hands.wait("findAll('img').length >= 1", 60)
        take(hands, "page_time")
        hands.press("Escape", "4")
        hands.wait("findAll('img').length >= 3", 200)
        take(hands, "page_things")


def save(picture: np.ndarray, name: str) -> None:
    """Save a picture (H, W, 3) uint8 as a small JPEG."""
    image = Image.fromarray(picture)
    image.thumbnail((_WIDTH_PX, 4 * _WIDTH_PX))
    image.save(PICTURES / f"{name}.jpg", quality=_QUALITY, optimize=True, progressive=True)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--keep", type=Path, help="run the commands in this folder, and keep what they leave")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = arguments.keep or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "home.gsmap").exists():
            run_commands(commands_of((DOCS / "start.md").read_text()), folder)
        make_pictures(folder)


if __name__ == "__main__":
    main()
