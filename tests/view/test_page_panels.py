"""What an operator does on the page, done in headless Chromium over a made map; the 3D view remembers what it is told.

The real 3D view over a real map is `test_page_whole.py`.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hands import Hands
from headless import Page
from made_map import MadeServer, made_map

PAGE = Path(__file__).parents[2] / "gsmap" / "view" / "page"
PHONE = (390, 844)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page with the tests' own 3D view."""
    if not shutil.which("node"):
        pytest.skip("needs Node.js, which bundles the page")
    if not (PAGE / "node_modules" / "esbuild").is_dir():
        pytest.skip("needs the page's packages: tools/build_page.sh")
    out = tmp_path_factory.mktemp("page")
    subprocess.run(["node", str(Path(__file__).parent / "page" / "build.mjs"), str(out)], check=True)
    return out


@pytest.fixture
def server(built: Path) -> Iterator[MadeServer]:
    found = MadeServer(built, made_map())
    yield found
    if found._http is not None:
        found.gone()


@pytest.fixture(scope="module")
def browser(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with Page("about:blank", tmp_path_factory.mktemp("browser"), 1280, 800) as page:
        yield page


@pytest.fixture
def hands(server: MadeServer, browser: Page) -> Iterator[Hands]:
    """A page that is open; whatever is done to it, the console stays free of errors."""
    found = Hands(browser)
    found.go("about:blank")
    browser.messages.clear()
    found.resize(1280, 800)
    found.colours("light")
    found.go(server.url)
    found.wait("globalThis.fake && find('gs-scene-list', null)")
    found.expected = []  # failures that a test provokes
    yield found
    assert [one for one in browser.failures() if not any(word in one for word in found.expected)] == []
    loaded = found.value("performance.getEntriesByType('resource').map((e) => e.name)")
    assert all(name.startswith(server.url) for name in loaded), "nothing of other servers"


def told(hands: Hands, name: str):
    """What the 3D view was told last by one of its methods; None before it was."""
    hands.value("new Promise((rest) => setTimeout(rest, 30))")
    return hands.value(f"fake.calls.filter((call) => call[0] === {json.dumps(name)}).at(-1)?.slice(1) ?? null")


def fill(hands: Hands, element: str, value: str, event: str = "change") -> None:
    """Puts a value into a field at once, as a choice from its list does."""
    hands.value(f"(() => {{ const e = {element}; e.value = '{value}'; e.dispatchEvent(new Event('{event}')); }})()")


def idle(hands: Hands) -> None:
    """Until the server has done what it was asked for."""
    hands.value("new Promise((rest) => setTimeout(rest, 50))")
    hands.wait("!find('gs-notices', null)?.shadowRoot.querySelector('.waiting')")


def hash_of(hands: Hands) -> str:
    hands.value("new Promise((rest) => setTimeout(rest, 350))")
    return hands.value("location.hash")


# --- look ------------------------------------------------------------------------------------------------------------


def test_the_page_opens_and_tells_the_3d_view_what_to_show(hands, server):
    assert hands.value("document.title") == "Plant 4, ground floor · gsmap"
    assert told(hands, "show") == [14, 0]
    assert told(hands, "setVisible") == [list(range(12))]
    assert told(hands, "setOverlay") is not None
    assert told(hands, "fit") is not None
    look = hands.text("gs-look")
    assert "12 scenes" in look
    assert "35 × 2 × 2 m" in look.replace("\u00a0", " ")
    assert "revision 3" in look


def test_scenes_are_found_by_name_date_and_tag_and_shown_hidden_alone(hands):
    hands.click("#filter")
    hands.type("kitchen")
    hands.says("2 of 12", "gs-scene-list")
    hands.value("find('#filter', null).select()")
    hands.type("#north 2025")
    hands.says("2 of 12", "gs-scene-list")
    hands.value("find('#filter', null).select()")
    hands.type("nothing like it")
    hands.says("No scene fits", "gs-scene-list")
    hands.value("find('#filter', null).select()")
    hands.type("2024-0")
    hands.click("input[type=checkbox]", "Show stairs 2024-02")
    assert 1 not in told(hands, "setVisible")[0]
    hands.click("button", "Only kitchen 2024-03")
    assert told(hands, "setVisible") == [[2]]
    hands.says("1 shown", "gs-scene-list")
    hands.click("button", "Show all")
    assert told(hands, "setVisible") == [list(range(12))]
    hands.click("button.choose", "workshop 2024-04")
    hands.says("Uncertainty of its middle", "gs-scene")
    assert told(hands, "fit")[0] == [[8, -1, 0], [10, 1, 2]]


def test_an_island_is_chosen_and_keeps_nothing_of_the_other(hands):
    hands.click("button", "Only hall 2024-01")
    fill(hands, "find('select', null)", "1")
    assert told(hands, "show") == [14, 1]
    assert told(hands, "setVisible") == [[12, 13]]
    hands.says("0.50 m", "gs-look")  # a unit of half a metre
    assert hands.value("find('gs-look', null).shadowRoot.textContent.includes('Merged')") is False


def test_split_view_has_a_divider_by_mouse_and_by_keys_and_halves_of_their_own(hands):
    hands.press("v")
    assert told(hands, "setSplit") == [{"at": 0.5, "source": "merged", "scenes": list(range(12))}]
    x, y = hands.middle(".line")
    hands.drag(x, y, x + 180, y)
    assert told(hands, "setSplit")[0]["at"] > 0.6
    hands.value("find('.line', null).focus()")
    hands.press("Home")
    assert told(hands, "setSplit")[0]["at"] == 0.05
    hands.press("ArrowRight")
    assert told(hands, "setSplit")[0]["at"] == pytest.approx(0.07)
    hands.click("button", "Scenes")
    hands.click("button", "Only hall 2024-01")
    assert told(hands, "setSplit")[0]["scenes"] == [0]
    assert told(hands, "setVisible") == [list(range(12))], "the left half is not touched"
    hands.click("button", "Swap the halves")
    assert told(hands, "setVisible") == [[0]]
    hands.press("v")
    assert told(hands, "setSplit") == [None]


def test_clip_box_by_numbers_and_by_its_handles(hands):
    hands.press("x")
    box = told(hands, "setClip")[0]
    np.testing.assert_allclose(box, [[-1, -1, 0], [34, 1, 2]])
    fill(hands, "find('input[type=number]', 'highest z')", "1")
    assert told(hands, "setClip")[0][1][2] == 1
    fill(hands, "find('input[type=number]', 'lowest z')", "9")
    assert told(hands, "setClip")[0][0][2] < 1, "faces do not cross"
    before = hands.value("fake.calls.length")
    hands.value("fake.clipTo([[0, 0, 0], [5, 0.5, 1]])")
    hands.wait("find('input[type=number]', 'highest x').value === '5.00'")
    calls = hands.value(f"fake.calls.slice({before}).map((call) => call[0])")
    assert "setClip" not in calls, "the 3D view is not told what it said itself"
    assert "clip=0,0,0,5,0.5,1" in hash_of(hands)
    hands.click("button", "Remove")
    assert told(hands, "setClip") == [None]


def test_ceiling_overlays_and_colours(hands):
    hands.press("h")
    assert told(hands, "setCeiling") == [False]
    hands.click("label", "Uncertainty")
    assert told(hands, "setOverlay") == ["ellipsoids", True]
    for expected in ("light", "dark", "system"):
        hands.click("button", "Colours")
        assert hands.value("document.documentElement.dataset.theme") == expected
    hands.colours("dark")
    assert told(hands, "setTheme") == [True]
    dark = hands.page.picture()[-5:, :100].mean()
    hands.colours("light")
    assert told(hands, "setTheme") == [False]
    assert hands.page.picture()[-5:, :100].mean() > dark + 0.5


# --- review ----------------------------------------------------------------------------------------------------------


def review(hands: Hands) -> None:
    hands.press("2", "j")
    hands.wait("findAll('gs-compare').length")


def test_edges_are_listed_by_doubt_and_filtered(hands):
    hands.press("2")
    rows = "findAll('[role=row]').map((row) => row.textContent.replace(/\\s+/g, ' ').trim())"
    listed = hands.value(rows)
    assert len(listed) == 5
    assert "undecided" in listed[0]
    assert "rejected" in listed[-1]
    for name, count in (("Tentative", 2), ("Undecided", 2), ("Rejected", 2), ("Reviewed", 0), ("All", 11)):
        hands.click("button", name)
        hands.wait(f"findAll('[role=row]').length === {count}")
    hands.click("#filter")
    hands.type("cellar")
    hands.wait("findAll('[role=row]').length === 2")


def test_one_click_shows_both_captures_and_the_evidence(hands, server):
    hands.press("2")
    hands.click("button.choose", "stairs 2024-02")
    hands.wait("findAll('img').length === 2 && findAll('img').every((e) => e.complete && e.naturalWidth)")
    said = hands.text("gs-edge")
    for word in ("no cycle confirms it", "camera 1 of 3", "at least 0.35", "would settle", "2 Mar 2025, 10:00"):
        assert word in said
    assert told(hands, "setCorrespondences") == [84]
    assert told(hands, "fit")[0] == [[2, -1, 0], [7, 1, 2]]
    shown = "findAll('img').map((e) => getComputedStyle(e).visibility)"
    first = hands.value(shown)
    assert sorted(first) == ["hidden", "visible"]
    hands.wait(f"JSON.stringify({shown}) !== {json.dumps(json.dumps(first, separators=(',', ':')))}", 3)  # it blinks
    hands.press("b")
    hands.wait("find('input[type=range]', 'first picture')")
    hands.press("b")
    hands.wait("findAll('.pictures.beside img').length === 2")
    hands.press("b")
    hands.wait("findAll('img').length === 1 && find('img', null).src.includes('difference')")
    hands.press(".")
    hands.wait("find('img', null).src.includes('/31-difference')")
    hands.click("button", "Enlarge")
    hands.wait("findAll('dialog[open]').length === 1 && find('img', null).getBoundingClientRect().height > 500")
    hands.press("Escape")
    hands.wait("findAll('dialog[open]').length === 0 && find('.enlarge', null)")
    hands.click("label", "84 correspondences")
    assert told(hands, "setCorrespondences") == [None]
    hands.click("button", "Compare in 3D")
    assert told(hands, "setSplit")[0]["scenes"] == [2]
    assert told(hands, "setVisible") == [[1]]


def test_confirm_reject_withdraw_with_notes_and_undo_of_each(hands, server):
    review(hands)
    pair = "000000000003:000000000004"
    hands.click("#confirm")
    hands.says("Confirmed: workshop 2024-04 : office east 2024-05")
    assert server.log == [("confirm", {"what": pair, "note": ""})]
    hands.says("confirmed by hand", "gs-review")
    hands.says("The poses are older", "gs-review")
    hands.press("n")
    hands.type("same door, see photo 12")
    hands.press("Escape")
    hands.press("r")
    hands.says("Rejected: workshop")
    assert server.log[-1] == ("reject", {"what": pair, "note": "same door, see photo 12"})
    assert hands.value("find('textarea', null).value") == ""
    hands.says("same door, see photo 12", "gs-edge")  # among its events
    hands.click("button", "Undo")
    hands.says("Undone: workshop")
    assert server.log[-1] == ("confirm", {"what": pair, "note": ""}), "what it was before"
    hands.press("u")
    idle(hands)
    assert server.log[-1] == ("withdraw", {"what": pair, "note": ""})
    hands.press("u")
    hands.says("Nothing to undo")
    assert len(server.log) == 4
    hands.press("c")
    hands.wait("find('#withdraw:not(:disabled)', null)")
    hands.press("t")
    hands.says("Review withdrawn")
    assert [name for name, _ in server.log[4:]] == ["confirm", "withdraw"]


def test_buttons_and_heading_of_the_details_stay_where_they_are(hands):
    review(hands)
    hands.wait("findAll('img').every((e) => e.complete && e.naturalWidth)")
    place = "['Side by side', 'Next camera'].map((name) => find('button', name).getBoundingClientRect().y)"
    at = hands.value(place)
    hands.click("button", "Side by side")
    hands.wait("findAll('.pictures.beside img').length === 2")
    assert hands.value(place) == at
    hands.press(".")  # other pictures, which are not there yet
    hands.value("findAll('img').forEach((e) => e.removeAttribute('src'))")
    assert hands.value(place) == at
    hands.resize(1280, 300)  # details of several times its height
    hands.value("find('aside.detail', null).scrollTo(0, 1e6)")
    assert hands.value("find('aside.detail', null).scrollTop") > 400
    assert hands.value("find('.heading', null).getBoundingClientRect().y") == 0


def test_a_pair_without_a_pose_cannot_be_confirmed(hands, server):
    hands.press("2")
    hands.click("button", "All")
    hands.click("button.choose", "no match")
    hands.wait("find('#reject', null)")
    assert hands.value("findAll('#confirm').length") == 0
    hands.press("c")
    hands.says("no pose of this pair", "gs-notices")
    assert server.log == []


def test_the_focus_goes_with_what_is_chosen(hands):
    hands.press("2")
    hands.click("button", "All")
    hands.click("button.choose", "stairs 2024-02")
    for key in ("j", "k", "k"):
        hands.press(key)
        hands.value("new Promise((rest) => setTimeout(rest, 50))")
        assert hands.value("focused().closest('[role=row]').ariaSelected") == "true"


def test_undo_puts_the_note_back_that_a_review_replaced(hands, server):
    server.map["edges"][3].update(review="reject", note="an old reason")
    server.map["state"] = "other"
    hands.press("2")
    hands.click("button", "All")
    hands.click("button.choose", "workshop 2024-04")
    hands.wait("find('textarea', null)?.placeholder.includes('an old reason')", 10)  # the page looks for news by itself
    hands.press("c")
    hands.says("Confirmed")
    hands.press("u")
    hands.says("Undone")
    assert server.log[-1] == ("reject", {"what": "000000000003:000000000004", "note": "an old reason"})


def test_next_and_previous_keep_the_place_in_the_list_when_a_review_changes_it(hands, server):
    review(hands)
    names = []
    for _ in range(3):
        hands.press("c")
        hands.wait(f"{len(names)} < 99 && find('#withdraw:not(:disabled)', null)")
        names.append(hands.value("find('gs-edge', null).shadowRoot.querySelector('h2').textContent"))
        hands.press("j")
        hands.wait("find('#withdraw:disabled', null)")
    assert len(set(names)) == 3
    assert len({body["what"] for _, body in server.log}) == 3


def test_an_action_that_is_refused_says_why_and_loses_nothing(hands, server):
    hands.expected = ["actions/confirm"]
    review(hands)
    server.refuse = "workshop 2024-04 was removed by someone else <b>meanwhile</b>"
    hands.press("n")
    hands.type("a note")
    hands.press("Escape", "c")
    hands.says("was removed by someone else <b>meanwhile</b>")
    assert hands.value("find('textarea', null).value") == "a note"
    assert hands.value("find('#confirm', null).disabled") is False
    hands.press("u")
    hands.says("Nothing to undo")


def test_optimize_after_reviews_makes_a_revision(hands, server):
    review(hands)
    hands.press("c")
    hands.says("The poses are older", "gs-review")
    server.delay_s = 0.5
    hands.click("button", "Optimize now")
    hands.says("all poses are solved for anew")
    hands.press("r")
    hands.says("One thing at a time")
    hands.says("Optimized")
    assert [name for name, _ in server.log] == ["confirm", "optimize"]
    hands.press("1")
    hands.says("revision 4", "gs-look")


def test_a_scene_is_dragged_and_becomes_a_prior(hands, server):
    hands.click("button.choose", "stairs 2024-02")
    hands.click("button", "Move by hand")
    assert told(hands, "drag") == [1]
    turned = [[0, -1, 0, 3.0], [1, 0, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]]
    hands.value(f"fake.dragTo({turned})")
    hands.says("Moved by 0.50 m and 90.0°", "gs-scene")
    hands.value("find('input[name=sigma_m]', null).select()")
    hands.type("0.25")
    hands.click("button", "Save as prior")
    hands.says("pose, 0.25 m, 3", "gs-scene")
    said = {"scene": "000000000001", "S_map_scene": turned, "sigma_m": 0.25, "sigma_deg": 3}
    assert server.log == [("prior", said)]
    assert told(hands, "drag") == [None]
    hands.press("u")
    hands.says("Undone: prior of stairs 2024-02")
    assert server.log[-1] == ("remove_prior", {"scene": "000000000001"})
    hands.click("button.choose", "office east 2024-05")
    hands.click("button", "Remove the prior")
    hands.says("Removed")
    assert server.map["scenes"][4]["prior"] is None
    hands.press("u")
    hands.says("position, 0.30 m", "gs-scene")
    assert server.log[-1] == ("earlier_prior", {"scene": "000000000004", "number": 1})
    hands.click("button", "Move by hand")
    hands.says("It takes the place of what was told before: position, 0.30 m", "gs-scene")
    hands.click("button", "Save as prior")
    hands.wait("find('button', 'Remove the prior')")
    hands.press("u")
    hands.says("position, 0.30 m", "gs-scene")
    assert server.log[-1] == ("earlier_prior", {"scene": "000000000004", "number": 1})
    hands.click("button", "Move by hand")
    hands.press("Escape")
    assert told(hands, "drag") == [None]


# --- time ------------------------------------------------------------------------------------------------------------


def test_time_slider_over_dates_and_revisions(hands):
    hands.press("3")
    hands.value("find('#until', null).focus()")
    hands.press("Home")
    hands.says("Until 11 Jan 2024", "gs-time")
    assert told(hands, "setVisible") == [[0, 3]]  # one has no date
    hands.press("ArrowRight")
    assert told(hands, "setVisible") == [[0, 1, 3]]
    assert "until=2024-02-11" in hash_of(hands)
    assert told(hands, "setChanges") == [["c1", "c3"]]
    hands.press("End")
    hands.says("All dates", "gs-time")
    hands.value("find('#revision', null).focus()")
    hands.press("Home")
    hands.says("Revision 1", "gs-time")
    hands.wait("fake.calls.some((call) => call[0] === 'setPoses' && call[1] === 1)")
    assert told(hands, "setVisible") == [list(range(8))], "scenes that it had placed"
    hands.press("End")
    hands.says("the newest", "gs-time")
    assert told(hands, "setPoses") == [None]


def test_changes_are_listed_by_kind_and_reviewed(hands, server):
    hands.press("3")
    assert told(hands, "setChanges") == [["c6", "c5", "c4", "c2", "c1", "c3"]]
    hands.click("button.choose", "Replaced")
    hands.wait("findAll('img').filter((e) => e.naturalWidth).length === 2")
    assert "office east 2024-05 → 11 May 2024 office west 2024-06 11 Jun 2024" in hands.text("gs-time")
    assert "office east 2024-05 (11 May 2024) → office west 2024-06 (11 Jun 2024)" in hands.text("gs-change")
    assert told(hands, "fit")[0] == pytest.approx(np.array([[11.4, -0.5, -0.8], [13.2, 1, 1.6]]))
    hands.press("c")
    hands.says("confirmed", "gs-change")
    hands.press("j", "r")
    hands.says("Rejected: change c4")
    assert server.log == [("confirm", {"what": "c5", "note": ""}), ("reject", {"what": "c4", "note": ""})]
    hands.click("button", "Confirmed")
    hands.press("u")
    hands.says("Undone: change c4")
    assert server.log[-1] == ("withdraw", {"what": "c4", "note": ""})


def spots(hands: Hands) -> dict[str, list[float]]:
    """Middle of each numbered change on the floor plan, as shares of its width and height."""
    found = """Object.fromEntries(findAll('.spot').map((e) => {
      const [r, s] = [e.getBoundingClientRect(), e.parentElement.getBoundingClientRect()];
      return [textOf(e), [(r.x + r.width / 2 - s.x) / s.width, (r.y + r.height / 2 - s.y) / s.height]];
    }))"""
    return hands.value(found)


def test_a_change_names_its_room_and_is_marked_on_the_floor_plan(hands):
    hands.value("document.getElementById('canvas').dispatchEvent(new Event('drawn'))")
    hands.press("3")
    hands.says("Disappeared in room r2", "gs-time")
    hands.click("button.choose", "Appeared in room r1")
    hands.wait("findAll('.spot').length === 6")
    # c1 has its middle at (0.3, 0.25), c3 6 m further along x.
    assert spots(hands)["1"] == pytest.approx([0.3 / 40 + 0.1, 0.5 - 0.25 / 20], abs=0.004)
    assert spots(hands)["3"] == pytest.approx([6.3 / 40 + 0.1, 0.5 - 0.25 / 20], abs=0.004)
    bold = "findAll('.spot.bold').map((e) => textOf(e))"
    assert hands.value(bold) == ["1"]
    assert hands.value("findAll('path.thing').length") == 1
    assert told(hands, "setHighlighted") == [["c1"]]
    hands.value("find('[role=gridcell].wide', null).dispatchEvent(new Event('pointerenter'))")
    assert told(hands, "setHighlighted") == [["c1", "c6"]]
    assert sorted(hands.value(bold)) == ["1", "6"]
    hands.value("findAll('.spot').find((e) => textOf(e) === '2').click()")
    hands.says("Disappeared in room r2", "gs-change")


def test_two_captures_are_chosen_and_what_is_known_of_them_is_offered(hands, server):
    def choose(first: int, second: int) -> str:
        for place, index in enumerate((first, second)):
            fill(hands, f"find('#capture-{place}', null)", f"{index:012x}")
            hands.value("new Promise((rest) => setTimeout(rest, 30))")
        return hands.text("#known")

    name = "it's; $(touch x) `touch x` ~ \\"
    server.map["scenes"][9]["name"] = name
    server.map.update(compared=[[6, 7]], uncompared=[[7, 8]], state="s8")
    hands.press("2")
    hands.wait("textOf(find('#capture-0', null)).includes('touch x')")
    said = choose(1, 0)
    assert "Edge used" in said
    assert "Appeared" in said
    assert "Not" not in said
    said = choose(0, 9)
    commands = hands.value("findAll('#known kbd').map((e) => e.textContent)")
    pair = f"hall 2024-01:{name}"
    assert [shlex.split(one) for one in commands] == [
        ["gsmap", "register", "Plant 4, ground floor", "--pairs", pair],
        ["gsmap", "changes", "Plant 4, ground floor", pair],
    ]
    assert "has no date" in choose(3, 9)
    assert "different components" in choose(0, 12)
    hands.wait("globalThis.fake.calls.filter((call) => call[0] === 'show').length > 1", 20)
    assert "nothing changed" in choose(7, 6)
    choose(8, 7)
    hands.click("button", "compare now")
    idle(hands)
    assert server.log[-1] == ("compare", {})
    assert "nothing changed" in hands.text("#known")
    hands.click("button", "Side by side in 3D")
    assert told(hands, "setVisible") == [[7]]
    assert told(hands, "setSplit")[0]["scenes"] == [8]
    choose(1, 2)
    hands.click("button", "Edge")
    hands.says("no cycle confirms it", "gs-edge")


def filter_objects(hands, text: str, count: int) -> None:
    """Open the list of objects and type a filter, which leaves some rows."""
    hands.press("4")
    hands.says("forklift", "gs-things")
    hands.click("#filter")
    hands.type(text)
    hands.wait(f"findAll('[role=row]').length === {count}")


def test_the_next_object_is_of_the_list_whatever_tab_is_open(hands):
    filter_objects(hands, "r1", 2)
    hands.press("Escape", "j")
    hands.says("chair", "gs-thing")
    hands.press("1")
    hands.wait("!find('aside.detail', null)")  # it is of the other tab
    hands.value("fake.pick({point: [0, 0, 0], scene: null, thing: {kind: 'object', index: 0}})")
    hands.says("chair", "gs-thing")
    assert hands.value("find('button', 'Previous').disabled") is True
    hands.click("button", "Next")
    hands.says("red cabinet", "gs-thing")
    assert hands.value("find('button', 'Next').disabled") is True
    hands.press("j")
    hands.says("That was the last one")
    hands.press("k")
    hands.says("chair", "gs-thing")


def test_without_a_3d_view_nothing_is_offered_that_needs_one(hands, server):
    hands.go(server.url + "?no-webgl")
    hands.wait("find('gs-plan', null)")
    needing = "findAll('button, input, label').filter(isShown).map((e) => e.ariaLabel || e.textContent.trim())"
    words = ("Fly", "3D", "Only", "Show ", "Hide", "Boxes", "Rooms", "Fit", "Clip", "Split", "Measure", "Move by hand")
    for keys in (("1", "j"), ("2", "j"), ("3", "j"), ("4", "j"), ("Escape", "?")):
        hands.press("Escape", *keys)
        hands.value("new Promise((rest) => setTimeout(rest, 200))")
        found = hands.value(needing)
        assert [one for one in found if one.startswith(words) or "3D" in one] == [], keys
    assert "Clip box" not in hands.text("gs-help")
    hands.press("Escape", "x")
    hands.says("needs the 3D view")
    hands.press("3")
    hands.wait("findAll('.spot').length === 6")
    assert hands.value("findAll('button.scene').length") == 2
    hands.value("find('#until', null).focus()")
    hands.press("Home")
    hands.wait("findAll('button.scene').length === 1")
    hands.click("button.scene", "hall 2024-01")
    hands.says("Uncertainty of its middle", "gs-scene")
    hands.press("Escape", "End", "4")
    hands.wait("findAll('path.object').length === 3")  # of four, one is gone
    x, y = hands.middle("path.object[data-id=o2]")
    wide = hands.value("find('.sheet', null).clientWidth")
    hands._mouse("mouseWheel", x, y, deltaX=0, deltaY=-400)
    hands.wait(f"find('.sheet', null).clientWidth > 2 * {wide}")
    assert hands.middle("path.object[data-id=o2]") == pytest.approx((x, y), abs=2), "it grows about the pointer"
    hands.drag(x, y, x + 40, y + 30)
    assert hands.middle("path.object[data-id=o2]") == pytest.approx((x + 40, y + 30), abs=2)
    assert hands.value("findAll('aside.detail').length") == 0, "a drag chooses nothing"
    hands.click("path.object[data-id=o2]")
    hands.says("red cabinet", "gs-thing")


def test_no_known_change_is_undated_uncompared_or_unchanged(hands, server):
    server.map.update(changes=[], uncompared=[[0, 1], [1, 2]], state="s8")
    hands.press("3")
    hands.wait("find('button', 'Compare them now')", 10)
    text = hands.text("gs-time")
    assert "hall 2024-01 (11 Jan 2024) → stairs 2024-02 (11 Feb 2024)" in text
    assert "Nothing changed" not in text
    fill(hands, "find('input[type=date]', null)", "0202-04-01")  # as it is typed
    fill(hands, "find('input[type=date]', null)", "2024-04-01")
    hands.wait("!find('input[type=date]', null)")
    idle(hands)
    assert server.log == [("date", {"scene": "000000000003", "captured_at": "2024-04-01"})]
    hands.press("u")
    idle(hands)
    assert server.log[-1] == ("date", {"scene": "000000000003", "captured_at": "none"})
    hands.click("button", "Compare them now")
    hands.says("Nothing changed between", "gs-time")
    assert server.log[-1] == ("compare", {})


def test_a_picked_place_tells_its_history_and_picked_things_are_chosen(hands):
    hands.value("fake.pick({point: [3.2, 0.1, 0.9], scene: 1, thing: null})")
    hands.says("3.20, 0.10, 0.90 m", "gs-place")
    hands.click("button", "What happened here")
    hands.says("a chair appeared", "gs-place")
    hands.click("button", "stairs 2024-02")
    hands.says("Uncertainty of its middle", "gs-scene")
    for kind, index, word in (
        ("edge", 1, "stairs 2024-02"),
        ("photo", 2, "IMG_0002.jpg"),
        ("object", 1, "red cabinet"),
    ):
        if kind == "object":
            hands.press("Escape", "Escape", "4")
            hands.says("red cabinet", "gs-things")
        hands.value(f"fake.pick({{point: [0, 0, 0], scene: null, thing: {{kind: '{kind}', index: {index}}}}})")
        hands.wait(f"find('aside.detail', null) && textOf(find('aside.detail', null)).includes({json.dumps(word)})")
    hands.press("Escape")
    assert hands.value("findAll('gs-place .card').length") == 0


def test_the_ruler_stays_taken_and_two_clicks_are_a_length(hands):
    def pick(point: str, scene: int = 1) -> None:
        hands.value(f"fake.pick({{point: [{point}], pixel: 0.03, scene: {scene}, thing: null}})")

    ruler = "find('button', 'Measure a length').getAttribute('aria-pressed')"
    hands.click("button", "Measure a length")
    hands.says("Click one end", "gs-place")
    assert told(hands, "setRuler") == [True]
    pick("1, 0, 0.5")
    hands.says("Click the other end", "gs-place")
    pick("4, 4, 2.5")
    hands.says("5.00 m across, 2.00 m up, 5.39 m straight", "gs-place")
    hands.says("± 6.9 cm", "gs-place")  # hypot(0.03, 0.03, 0.01 * 5.39)
    assert hands.value("findAll('gs-place strong').length") == 0, "no length of the three stands out"
    assert hands.value(ruler) == "true"
    assert told(hands, "setMeasure") == [[[1, 0, 0.5], [4, 4, 2.5]]]
    hands.value("document.getElementById('canvas').dispatchEvent(new Event('drawn'))")
    hands.wait("find('button', 'Walk in')")
    card = hands.value("find('.card', 'straight').getBoundingClientRect().bottom")
    assert hands.value("find('button', 'Walk in').getBoundingClientRect().top") > card
    pick("0, 0, 1")
    pick("2, 0, 1", scene=2)
    hands.wait("find('strong', '2.00 m across')")
    hands.press("Escape")
    assert hands.value(ruler) == "false"
    assert told(hands, "setRuler") == [False]
    assert hands.value("findAll('gs-place .card').length") == 0


def test_the_map_is_walked_into_and_seen_from_above(hands):
    hands.value("document.getElementById('canvas').dispatchEvent(new Event('drawn'))")
    hands.wait("findAll('.scene-label:not(.out)').length > 1")
    hands.click(".scene-label:not(.out)", "hall 2024-01")
    hands.says("hall 2024-01", "gs-scene")
    hands.press("i")
    assert told(hands, "walkIn") == [0], "the chosen scene"
    hands.press("Escape")
    hands.click("button", "Walk in")
    assert told(hands, "walkIn") == [None]


def test_the_floor_plan_stands_in_until_all_is_known_and_where_there_is_no_3d_view(hands, server):
    server.map["components"][0]["overview"]["pending"] = 3
    server.map["state"] = "s5"
    hands.wait("globalThis.fake.calls.filter((call) => call[0] === 'show').length > 1", 20)
    hands.value("Object.assign(fake.state, { hasStood: false }).hasStood")
    hands.value("document.getElementById('canvas').dispatchEvent(new Event('drawn'))")
    hands.wait("find('svg[aria-label=\"Floor plan of the map\"]', null)")
    hands.click("button", "Show what is there")
    assert told(hands, "stand") is not None
    server.map["components"][0]["overview"]["pending"] = 0
    hands.go(server.url + "?no-webgl")
    hands.says("no WebGL", "gs-entry")
    hands.wait("find('svg[aria-label=\"Floor plan of the map\"]', null)")


def test_what_one_pair_places_is_called_so(hands, server):
    server.map["edges"][1]["one_pair"] = True
    server.map["scenes"][2]["status"] = "one pair"
    server.map["state"] = "s9"
    hands.wait("textOf(find('gs-scene-list', null)).includes('one pair')", 20)
    hands.press("2")
    hands.click("button", "One pair")
    assert hands.value("findAll('.mark').map((e) => e.textContent)") == ["one pair"]
    hands.press("j")
    hands.says("kitchen 2024-03 is placed by this pair alone", "gs-edge")
    hands.press("c")
    hands.wait("find('button', 'Undo: review of stairs 2024-02 : kitchen 2024-03')")


def test_an_object_is_seen_hovered_and_given_a_name(hands, server):
    hands.press("4")
    hands.wait("findAll('img').length === 4")
    hands.value("find('[role=gridcell].wide', null).dispatchEvent(new Event('pointerenter'))")
    assert told(hands, "setHighlighted") == [["o1"]]
    hands.value("find('[role=gridcell].wide', null).dispatchEvent(new Event('pointerleave'))")
    assert told(hands, "setHighlighted") == [[]]
    hands.value("fake.pick({point: [2.1, 0, 0.5], scene: null, thing: null})")  # in the box of the second
    hands.says("red cabinet", "gs-thing")
    assert told(hands, "setHighlighted") == [["o2"]]
    hands.press("n")
    fill(hands, "find('#name', null)", "blue cabinet", "input")
    hands.click("button", "Name it")
    hands.says("o2 is called blue cabinet")
    hands.says("blue cabinet", "gs-things")
    assert server.log[-1] == ("name_object", {"object": "o2", "name": "blue cabinet"})
    hands.press("u")
    hands.says("Undone: name of o2")
    assert server.log[-1] == ("name_object", {"object": "o2", "name": "red cabinet"})


def test_objects_and_photos(hands):
    filter_objects(hands, "red", 1)
    hands.click("button.choose", "red cabinet")
    hands.says("chair stands beside red cabinet", "gs-thing")
    hands.says("r1, 12.0 m²", "gs-thing")
    fill(hands, "find('#filter', null)", "r2", "input")
    hands.wait("findAll('[role=row]').length === 2")
    assert told(hands, "setGraph") is not None
    fill(hands, "find('#filter', null)", "", "input")
    hands.click("button", "Photos")
    hands.click("button.choose", "IMG_0001.jpg")
    at = told(hands, "stand")
    assert at[0]["position"] == [2, -4, 1.6]
    assert at[0]["target"] == [2, -2, 1.6]
    assert told(hands, "setOverlay") == ["photos", True]


# --- the address -----------------------------------------------------------------------------------------------------


def test_the_whole_view_is_in_the_address_and_comes_back(hands, server):
    hands.click("button", "Only hall 2024-01")
    hands.press("v", "x", "h", "3")
    hands.click("button.choose", "Replaced")
    hands.value("find('#until', null).focus()")
    hands.press("ArrowLeft")
    hands.value("find('#revision', null).focus()")
    hands.press("ArrowLeft")
    hands.value("fake.move({position: [1.5, 2, 3], target: [4, 5, 6.25]})")
    address = hash_of(hands)
    for part in (
        "tab=time",
        "change=c5",
        "revision=2",
        "at=1.5,2,3",
        "to=4,5,6.25",
        "split=0.500",
        "ceiling=0",
        "until=",
    ):
        assert part in address, (part, address)
    before = {name: told(hands, name) for name in ("setVisible", "setSplit", "setClip", "setCeiling", "setPoses")}
    hands.go("about:blank")
    hands.go(server.url + address)
    hands.wait("globalThis.fake && find('gs-change', null)")
    hands.wait("fake.calls.some((call) => call[0] === 'setPoses' && call[1] === 2)")
    again = {name: told(hands, name) for name in before}
    np.testing.assert_allclose(again.pop("setClip"), before.pop("setClip"), atol=1e-6)
    assert again == before
    assert told(hands, "stand")[0] == {"position": [1.5, 2, 3], "target": [4, 5, 6.25]}
    assert hash_of(hands) == address


def test_back_and_forward_go_through_what_was_chosen(hands):
    hands.press("2", "j")
    first = hash_of(hands)
    hands.press("j")
    second = hash_of(hands)
    assert first != second
    hands.value("history.back()")
    hands.wait(f"location.hash === {json.dumps(first)}")
    hands.says("workshop 2024-04 : office east", "gs-edge")
    hands.value("history.forward()")
    hands.wait(f"location.hash === {json.dumps(second)}")
    hands.says("kitchen 2025-11", "gs-edge")


@pytest.mark.parametrize(
    "address",
    [
        "#island=99&tab=nothing&edge=a:b&revision=77&until=<script>&split=7&clip=1,2&at=1,2,NaN&to=1,2,3&overlays=x,y",
        "#clip=5,5,5,1,1,1&show=none&hide="
        + "a," * 3000
        + "&object=javascript:alert(1)&photo=../../etc/passwd&view=-1",
        "#%E0%A4%A&=&&&island=1e3",
    ],
)
def test_an_address_that_is_wrong_shows_the_map_all_the_same(hands, server, address):
    hands.go("about:blank")
    hands.go(server.url + address)
    hands.wait("globalThis.fake && find('gs-scene-list', null)")
    assert told(hands, "show") == [14, 0]
    assert told(hands, "setClip") == [None]
    assert told(hands, "setPoses") == [None]


def test_a_link_is_copied(hands):
    hands.page._call(
        "Browser.grantPermissions", {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}, None
    )
    hands.press("2", "j")
    address = hash_of(hands)
    hands.press("l")
    hands.says("Link copied")
    assert hands.value("navigator.clipboard.readText()").endswith(address)


# --- every hand, every screen ----------------------------------------------------------------------------------------


def test_by_keyboard_alone_from_the_start_to_a_review(hands, server):
    focused = "(focused().ariaLabel || focused().textContent || focused().id).replace(/\\s+/g, ' ').trim()"
    seen, in_lists = [], 0
    for _ in range(40):
        hands.press("Tab")
        if hands.value("focused() === document.body"):
            break  # the end of the page
        seen.append(hands.value(focused))
        in_lists += hands.value("focused().closest('[role=grid]') !== null")
        outline = hands.value("getComputedStyle(focused()).outlineStyle")
        assert outline != "none", f"{seen[-1]} does not show that it has the focus"
    assert "Fold the panel" in seen[0]
    assert any("Look" in one for one in seen)
    assert in_lists == 1, "a list is one stop of the Tab key"
    # The list of scenes: arrows walk over rows and over what a row offers.
    hands.value("find('[role=grid] [tabindex=\"0\"]', null).focus()")
    hands.press("ArrowDown", "ArrowDown", "ArrowRight", "ArrowRight")
    assert "Only kitchen 2024-03" in hands.value(focused)
    hands.press("Enter")
    assert told(hands, "setVisible") == [[2]]
    hands.press("End")
    assert "Only workshop 2025-12" in hands.value(focused)
    hands.press("ArrowLeft", "Enter")
    hands.says("workshop 2025-12", "gs-scene")
    hands.press("Escape")
    # Tabs by arrows, an edge by j, the comparison by b, a word on it by c.
    hands.value("find('[role=tab][tabindex=\"0\"]', null).focus()")
    hands.press("ArrowRight")
    assert hands.value("find('[role=tab][aria-selected=true]', null).textContent").strip().startswith("Review")
    hands.press("j", "j", "k", "b", "c")
    hands.says("Confirmed: workshop")
    hands.press("?")
    hands.wait("findAll('dialog[open]').length === 1")
    assert "Take the review back" in hands.text("gs-help")
    hands.press("r")  # not while the help is open
    hands.value(
        "find('dialog[open]', null).addEventListener('close', (event) => event.stopImmediatePropagation(), true)"
    )
    hands.press("Escape")  # closes it at once; its own event comes with the next picture, or never
    hands.wait("findAll('dialog[open]').length === 0")
    assert len(server.log) == 1
    idle(hands)
    hands.press("/")
    hands.press("r")  # a letter in a field is a letter
    assert hands.value("focused().value") == "r"
    assert len(server.log) == 1


def test_on_a_phone_the_panel_takes_a_third_at_most_and_folds(hands):
    hands.resize(*PHONE, mobile=True)
    tall = "find('aside', null).getBoundingClientRect().height"
    for key in ("1", "2", "3", "4"):
        hands.press(key)
        assert hands.value(tall) <= PHONE[1] / 3 + 1, key
        assert hands.value("document.documentElement.scrollWidth") == PHONE[0]
        small = hands.value(
            "findAll('button, select, input:not([type=checkbox]):not([type=range])').filter(isShown)"
            ".map((e) => [e.textContent.trim() || e.ariaLabel, Math.round(e.getBoundingClientRect().height)])"
            ".filter(([, h]) => h < 36)"
        )
        assert small == [], "too small for a finger"
    hands.press("2", "j")
    hands.wait("findAll('gs-compare img, img').length")
    assert hands.value("find('aside.detail', null).getBoundingClientRect().height") <= PHONE[1] / 3 + 1
    picture = hands.value("find('.pictures', null).getBoundingClientRect().toJSON()")
    assert picture["bottom"] <= PHONE[1] * 2 / 3 + 1, "pictures stand above the sheet"
    hands.click("#confirm")
    hands.says("Confirmed")
    hands.press("Escape", "p")
    hands.wait("find('aside', null).getBoundingClientRect().height < 60")
    hands.click("button", "Open the panel")
    hands.wait("find('aside', null).getBoundingClientRect().height > 200")


@pytest.mark.parametrize("size", [(1280, 800), (900, 700), PHONE])
def test_no_text_is_clipped(hands, size):
    """Whatever hides what does not fit has room for all of it; lists and fields scroll."""
    hands.resize(*size)
    clipped = """findAll('*').filter((e) => {
      if (!isShown(e) || e.closest('svg') || e.matches('textarea, select, main, dialog')) return false;
      const style = getComputedStyle(e);
      const clips = style.overflowX !== 'visible' && style.overflowX !== 'auto';
      return e.scrollWidth > e.clientWidth + 1 && (clips || style.display === 'inline-flex' || e.matches('button'));
    }).map((e) => [e.tagName, e.className, e.textContent.trim().slice(0, 60), e.scrollWidth, e.clientWidth])"""
    for keys in (("1",), ("v", "x"), ("j",), ("Escape", "2"), ("j",), ("Escape", "3"), ("j",), ("Escape", "4"), ("?",)):
        hands.press(*keys)
        time.sleep(0.15)
        assert hands.value(clipped) == [], keys
        assert hands.value("document.documentElement.scrollWidth") <= size[0], keys


def test_controls_have_names_and_roles(hands):
    nameless = """findAll('button, input, select, textarea, [role=slider], img, dialog').filter((e) =>
      !(e.ariaLabel || e.textContent.trim() || e.alt || e.closest('label') || e.getAttribute('aria-labelledby')))
      .map((e) => e.outerHTML.slice(0, 120))"""
    for keys in (("v", "x"), ("j",), ("2", "j"), ("3", "j"), ("4",), ("?",)):
        hands.press(*keys)
        time.sleep(0.15)
        assert hands.value(nameless) == [], keys


# --- a map of others, a server that is away --------------------------------------------------------------------------


def test_five_hundred_scenes_are_a_list_of_what_is_in_sight(built, tmp_path):
    made = MadeServer(built, made_map(scenes=500, second_island=0))
    try:
        with Page(made.url, tmp_path, 1280, 800) as page:
            hands = Hands(page)
            hands.wait("globalThis.fake && find('gs-scene-list', null)")
            assert hands.value("findAll('[role=row]').length") < 40
            assert hands.value("find('[role=grid]', null).getAttribute('aria-rowcount')") == "500"
            hands.value("find('[role=grid] [tabindex=\"0\"]', null).focus()")
            hands.press("End")
            hands.says("workshop 2086-08", "gs-look")
            started = time.monotonic()
            for _ in range(10):
                hands.press("ArrowUp")
            assert time.monotonic() - started < 3
            hands.value("find('gs-listing', null).scrollTop = 9000")
            hands.value("new Promise((rest) => setTimeout(rest, 100))")
            assert hands.value("findAll('[role=row]').length") < 40
            hands.click("#filter")
            hands.type("cellar 2050")
            hands.wait("findAll('[role=row]').length === 1")
            assert page.failures() == []
    finally:
        made.gone()


def test_names_notes_and_addresses_of_a_map_are_not_trusted(built, tmp_path):
    summary = made_map(hostile=True)
    summary["changes"][0]["pictures"] = ["https://evil.example/x.jpg", "https://evil.example/y.jpg"]
    summary["changes"][1]["pictures"] = ["../../secret.jpg", "changes/c2-after.jpg"]
    summary["edges"][2]["detail"] = "//evil.example/edges.json"
    summary["scenes"][1]["tags"] = ["<svg onload=window.hacked=1>"]
    made = MadeServer(built, summary)
    try:
        with Page(made.url, tmp_path, 1280, 800) as page:
            hands = Hands(page)
            hands.wait("globalThis.fake && find('gs-scene-list', null)")
            assert hands.value("document.title") == "<b>made</b> · gsmap"
            hands.press("j")
            hands.says("<img src=x onerror", "gs-scene")
            hands.press("j")
            hands.says("#<svg onload", "gs-scene")
            hands.press("2")
            hands.click("button", "All")
            for _ in range(4):
                hands.press("j")
                hands.value("new Promise((rest) => setTimeout(rest, 100))")
            hands.value("find('[role=tab]', 'Time').click()")
            hands.click("button.choose", "Appeared")
            hands.says("could not be loaded", "gs-change")
            hands.click("button.choose", "Disappeared")
            hands.says("could not be loaded", "gs-change")
            hands.press("2")
            hands.click("button.choose", "kitchen 2024-03")
            hands.value("new Promise((rest) => setTimeout(rest, 100))")
            assert hands.value("globalThis.hacked ?? null") is None
            assert hands.value("findAll('[onerror], [onload], script:not([src])').length") == 0
            loaded = hands.value("performance.getEntriesByType('resource').map((e) => e.name)")
            assert all(name.startswith(made.url) for name in loaded)
            assert hands.value("document.documentElement.scrollWidth") <= 1280
            assert page.failures() == []
    finally:
        made.gone()


def test_a_static_page_hides_what_needs_a_server_and_says_so(built, tmp_path):
    summary = made_map()
    summary.update(actions=False, history=None)
    made = MadeServer(built, summary)
    try:
        with Page(made.url, tmp_path, 1280, 800) as page:
            hands = Hands(page)
            hands.wait("globalThis.fake && find('gs-scene-list', null)")
            hands.press("2", "j")
            hands.says("This page only shows the map", "gs-review")
            hands.wait("findAll('gs-compare').length")
            assert hands.value("findAll('#confirm, #reject, textarea').length") == 0
            hands.press("c", "u", "o")
            hands.press("1", "j")
            assert hands.value("find('button', 'Move by hand') ?? null") is None
            hands.value("fake.pick({point: [3, 0, 1], scene: 1, thing: null})")
            hands.says("3.00, 0.00, 1.00 m", "gs-place")
            assert hands.value("find('button', 'What happened') ?? null") is None
            hands.value("new Promise((rest) => setTimeout(rest, 4500))")
            asked = hands.value("performance.getEntriesByType('resource').map((e) => e.name)")
            assert not any("state.json" in name for name in asked)
            assert made.log == []
            assert page.failures() == []
    finally:
        made.gone()


def test_nothing_is_lost_while_the_server_is_away(hands, server):
    hands.expected = ["ERR_CONNECTION", "Failed to load"]
    review(hands)
    hands.press("n")
    hands.type("kept")
    hands.press("Escape")
    server.gone()
    hands.press("c")
    hands.says("gsmap view does not answer")
    hands.says("Not saved yet")
    assert hands.value("find('textarea', null).value") == "kept"
    hands.press("j")
    hands.says("kitchen 2025-11", "gs-edge")  # one can go on looking
    hands.click("button", "Try again")
    hands.says("Still no answer")
    assert server.log == []
    server.back()
    hands.click("button", "Try again")
    hands.says("Confirmed: workshop")
    assert server.log == [("confirm", {"what": "000000000003:000000000004", "note": "kept"})]
    hands.wait("!textOf(document.body).includes('does not answer')")
    hands.press("u")
    hands.says("Undone")


def test_what_others_changed_is_seen_without_reloading(hands, server):
    review(hands)
    server.map["scenes"].insert(0, {**server.map["scenes"][0], "id": "ffffffffffff", "name": "a new scene"})
    for edge in server.map["edges"]:
        edge["target"] += 1
        edge["source"] += 1
    server.map["state"] = "s77"
    hands.says("workshop 2024-04 : office east 2024-05", "gs-edge")
    hands.wait("findAll('#capture-0 option').some((e) => e.textContent.includes('a new scene'))")
    hands.says("workshop 2024-04", "gs-edge")  # the same pair, though its numbers are others
    hands.press("1")
    hands.says("a new scene", "gs-look")
    assert told(hands, "show") == [15, 0]


def test_a_map_that_cannot_be_loaded_says_what_to_do(built, tmp_path):
    made = MadeServer(built, made_map())
    made.map = {"schema": 7}
    try:
        with Page(made.url, tmp_path, 800, 600) as page:
            hands = Hands(page)
            hands.says("The map could not be loaded")
            hands.says("schema 7")
            made.map = made_map()
            hands.click("button", "Try again")
            hands.wait("globalThis.fake && find('gs-scene-list', null)")
            assert page.failures() == []
    finally:
        made.gone()


def test_an_empty_map_says_how_it_is_filled(built, tmp_path):
    summary = made_map()
    for part in ("scenes", "edges", "components", "changes", "photos", "revisions"):
        summary[part] = []
    summary["revision"] = None
    made = MadeServer(built, summary)
    try:
        with Page(made.url, tmp_path, 800, 600) as page:
            hands = Hands(page)
            hands.says("This map has no scenes yet")
            hands.press("2", "3", "4", "1")
            assert page.failures() == []
    finally:
        made.gone()


def test_one_failing_answer_leaves_the_rest(hands, server):
    hands.expected = ["404", "edges/"]
    server.map["edges"][3]["detail"] = "edges/gone.json"
    server.map["state"] = "s1"
    time.sleep(4.5)
    hands.press("2", "j")
    hands.says("is not part of this page", "gs-edge")
    hands.press("c")
    hands.says("Confirmed")
    server.map["edges"][3]["detail"] = "edges/000000000003-000000000004.json"
