"""gsmap edge: add a measured relative pose."""

from __future__ import annotations

import json as _json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

if TYPE_CHECKING:
    import numpy as np

    from gsmap.types import Sim3

PANEL = "Scenes and edges", 4
OUTPUTS = {"edge": Output("pairs.EdgeRow")}
_RIGID_SIGMA = 1e-5  # standard deviation of the log scale of an edge without a scale


def command(
    map: MapPath,
    pair: Annotated[str, typer.Argument(metavar="A:B", help="Pair of scenes, by names or ids.")],
    pose: Annotated[
        str,
        typer.Option("--pose", metavar="FILE", help="Pose of B in A: a 4x4 matrix (`x_a = M x_b`), as text or JSON."),
    ],
    sigma: Annotated[
        str,
        typer.Option(
            "--sigma",
            metavar="DEG,M[,SCALE]",
            help="Standard deviations of rotation (degrees, per axis), translation (units of B, per axis) and, if the "
            "scale was measured, of its logarithm.",
        ),
    ],
    note: Annotated[str, typer.Option("--note", help="Description of the measurement, which the history keeps.")] = "",
    json: AsJson = False,
) -> None:
    """Add your own measurement of the pose of scene B in scene A. The next optimize uses it like other edges.

    Example: `gsmap edge site.gsmap monday:tuesday --pose tape.txt --sigma 0.5,0.02`
    """
    S_target_source = read_pose(Path(pose))
    sigmas = read_sigmas(sigma, S_target_source)
    with opened(map) as m:
        row = m.add_edge(pair, S_target_source, sigmas, note)
    say(f"noted; run: gsmap optimize {map}")
    print_rows("edge", row, json)


def read_pose(path: Path) -> Sim3:
    """Read a 4x4 similarity from text (16 numbers) or JSON (4 rows, or an object with ``S_target_source``).

    Raises:
        NotFoundError: The file is missing.
        InputError: The file holds no similarity matrix.
    """
    import numpy as np

    from gsmap.errors import MALFORMED, InputError, NotFoundError
    from gsmap.types import Sim3

    try:
        content = path.read_text(encoding="utf-8")
        if content.lstrip()[:1] in ("[", "{"):
            data = _json.loads(content)
            numbers = np.array(data["S_target_source"] if isinstance(data, dict) else data, dtype=np.float64)
        else:
            numbers = np.array(content.replace(",", " ").split(), dtype=np.float64)
        return Sim3.from_matrix(numbers.reshape(4, 4))
    except FileNotFoundError as error:
        raise NotFoundError(f"no pose file at {path}", code="file_not_found") from error
    except (OSError, *MALFORMED) as error:
        raise InputError(
            f"{path} is not a pose (a 4x4 matrix as text or JSON): {error}", code="invalid_pose"
        ) from error


def read_sigmas(text: str, pose: Sim3) -> np.ndarray:
    """Parse ``DEG,M[,SCALE]`` to standard deviations (7,): rotation (3, rad), translation (3), log scale.

    Raises:
        ConfigError: The text is not two or three positive numbers, or the pose has a scale and the text has none.
    """
    import numpy as np

    from gsmap.errors import ConfigError

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(0 < number < float("inf") for number in numbers):
        raise ConfigError(
            f"--sigma takes two or three positive numbers, DEG,M[,SCALE], got {text!r}", code="invalid_sigma"
        )
    if len(numbers) == 2 and not pose.is_rigid:
        raise ConfigError(
            f"the pose has scale {pose.scale:.6g}: pass its standard deviation, too: --sigma DEG,M,SCALE",
            code="invalid_sigma",
        )
    log_scale = numbers[2] if len(numbers) == 3 else _RIGID_SIGMA
    return np.array([np.radians(numbers[0])] * 3 + [numbers[1]] * 3 + [log_scale])
