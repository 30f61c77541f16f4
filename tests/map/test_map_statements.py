"""No verb needs more SQL statements on a larger map."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.make.large_maps import filled, tiny_pattern, verbs

SMALL, LARGE = 12, 24
A_FEW = 8  # how many statements more what a scene touches may need; one for each scene would be 12


def counts(folder: Path, num: int) -> dict[str, int]:
    """Return the number of statements of each verb on a street of so many scenes."""
    out = {}
    (folder / "work").mkdir(parents=True)
    with filled(folder / "street.gsmap", num, tiny_pattern()) as one:
        one.map.with_settings({"objects.min_gaussians": 10})
        for _ in range(2):  # the frame of the first solve is not that of the later ones
            one.add()
            one.map.update()
            one.map.objects()
        for name, call in verbs(one, folder / "work").items():
            with one.counting() as counted:
                call()
            out[name] = counted["sql"]
    return out


def test_no_verb_needs_more_statements_on_a_larger_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    small, large = (counts(tmp_path / str(num), num) for num in (SMALL, LARGE))
    more = {name: (small[name], large[name]) for name in small if large[name] > small[name] + A_FEW}
    assert more == {}
