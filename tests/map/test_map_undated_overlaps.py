from types import SimpleNamespace

import pytest

from gsmap.map.undated_overlaps import undated_notes


def scene(name, date=None):
    return SimpleNamespace(id=f"id-{name}", name=name, captured_at=date)


def store(bent=(), **differences):
    edges = [
        SimpleNamespace(target=f"id-{pair[0]}", source=f"id-{pair[1]}", disagreement=share)
        for pair, share in differences.items()
    ]
    noted = [SimpleNamespace(registration=edge) for edge in edges if edge.target[-1] + edge.source[-1] in bent]

    def current_with_note(*texts):
        return noted if any(text.startswith("one capture is bent") for text in texts) else []

    return SimpleNamespace(
        registrations=SimpleNamespace(summaries=lambda usable: edges, current_with_note=current_with_note)
    )


def test_differences_of_undated_overlaps_are_noted_in_numbers():
    scenes = [scene("a"), scene("b"), scene("c", "2026-01-01"), scene("d", "2026-02-01")]
    (note,) = undated_notes(store(ab=0.02, bc=0.08, ac=0.05, cd=0.3), scenes)
    assert note.startswith("3 pairs ")
    assert "5.0%" in note
    assert "8.0% (b:c)" in note


def test_bent_pairs_do_not_count():
    scenes = [scene("a"), scene("b"), scene("c")]
    (note,) = undated_notes(store(bent=("bc",), ab=0.02, bc=0.08), scenes)
    assert note.startswith("1 pair ")
    assert "8.0%" not in note
    assert undated_notes(store(bent=("bc",), bc=0.08), scenes) == ()


@pytest.mark.parametrize("share", [0.0, 0.001, float("nan")])
def test_undated_captures_that_agree_need_no_note(share):
    assert undated_notes(store(ab=share), [scene("a"), scene("b")]) == ()


def test_dated_captures_and_other_scenes_need_no_note():
    assert undated_notes(store(ab=0.2), [scene("a", "2026-01-01"), scene("b", "2026-02-01")]) == ()
    assert undated_notes(store(ab=0.2), [scene("a")]) == ()
