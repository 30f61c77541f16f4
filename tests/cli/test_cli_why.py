"""gsmap why: the steps of a pair, their bars, what would settle it, and the picture."""

import numpy as np
from PIL import Image

import gsmap.map
from gsmap.register import recipe_key
from gsmap.types import Registration, Sim3


def _steps(found):
    return {step["name"]: step for step in found["steps"]}


def _doubtful(site, look_alike):
    """Has registration say with what probability the pair shows two places."""
    with gsmap.map.open(site) as m:
        a, b = (m.store.scenes.get(name).id for name in ("left", "right"))
        edge = Registration(
            min(a, b),
            max(a, b),
            "accepted",
            S_target_source=Sim3.identity(),
            information=np.eye(7) * 1e4,
            proposer="graph:landmarks",
            evidence={"look_alike": look_alike, "colour_correlation": 0.6, "free_space_violation": 0.12},
        )
        m.store.registrations.save(edge, recipe_key().of(a, b, str(look_alike)))
        m.optimize()


def test_every_step_has_its_bar_and_says_whether_it_passed(site, cli):
    steps = _steps(cli("why", site, "left:right", "--json").json)
    assert steps["retrieval"]["passed"] is True
    assert steps["verdict"] == {"name": "verdict", "value": "accepted", "bar": "accepted", "passed": True}
    assert steps["probability"]["bar"].startswith("at least 0.9")
    assert steps["colour correlation"]["passed"] is True
    assert steps["look-alike"]["passed"] is True
    assert steps["disagreement"]["value"] < 0.1
    assert steps["clique"]["passed"] is None  # told, not asked


def test_what_disagrees_is_named_with_what_would_settle_it(site, cli):
    _doubtful(site, 0.05)
    found = cli("why", site, "left:right", "--json").json
    steps = _steps(found)
    assert steps["look-alike"]["passed"] is False
    assert steps["free-space violation"]["passed"] is True
    assert steps["the other edges"] == {
        "name": "the other edges", "value": "tentative", "bar": "bear it out: used", "passed": False
    }  # fmt: skip
    assert "look alike" in found["advice"]
    assert "--captured-at" in found["advice"]
    _doubtful(site, 0.005)
    assert _steps(cli("why", site, "left:right", "--json").json)["look-alike"]["passed"] is True


def test_a_person_has_the_last_word(site, cli):
    _doubtful(site, 0.05)
    cli("confirm", site, "left:right")
    found = cli("why", site, "left:right", "--json").json
    assert found["advice"] == ""
    assert _steps(found)["review"]["value"] == "confirm"


def test_both_captures_are_drawn_from_the_same_cameras_and_a_purge_finds_the_picture(site, cli, tmp_path):
    folder = tmp_path / "why"
    file = cli("why", site, "left:right", "--pictures", folder, "--json").json["picture"]
    drawn = np.asarray(Image.open(file)).astype(float)
    height, width = drawn.shape[0], (drawn.shape[1] - 8) // 3
    left, right = drawn[:, :width], drawn[:, width + 4 : 2 * width + 4]
    assert height >= width // 2
    assert left.std() > 10
    assert right.std() > 10
    assert cli("remove", site, "right", "--purge").code == 0
    assert not list(folder.glob("why-*.png"))
