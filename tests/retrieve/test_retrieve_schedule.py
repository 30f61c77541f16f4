"""Which pairs are tried: lists are gone down until the map is rigid, and no island is left for it."""

from gsmap.retrieve import PairSchedule, Params

PARAMS = Params(max_edges_per_scene=2)


def _tried(rounds, right=()):
    """All pairs that are tried, where those in ``right`` hold."""
    out = []
    while pairs := rounds.next():
        out += pairs
        for pair in pairs:
            if pair in right:
                rounds.add_edge(*pair)
    return out


def test_a_list_is_gone_down_to_its_end_where_nothing_holds():
    rounds = PairSchedule([[("n", other) for other in "abcde"]], (), (), PARAMS)
    assert rounds.next() == [("a", "n"), ("b", "n")]
    assert rounds.next() == [("c", "n"), ("d", "n")]
    assert rounds.next() == [("e", "n")]
    assert rounds.next() == []


def test_it_ends_where_edges_hold_that_tie_both_scenes():
    clique = [("a", "b"), ("a", "c"), ("b", "c"), ("a", "d"), ("b", "d"), ("c", "d")]
    pairs = [("n", other) for other in "abcd"]
    rounds = PairSchedule([pairs], (), clique, PARAMS)
    assert _tried(rounds, right={("a", "n"), ("b", "n")}) == [("a", "n"), ("b", "n")]
    assert not {("c", "n"), ("d", "n")} & rounds.tried


def test_an_edge_between_two_islands_is_tried_however_rigid_they_are():
    islands = [("a", "b"), ("a", "c"), ("b", "c"), ("x", "y"), ("x", "z"), ("y", "z")]
    rounds = PairSchedule([[("a", "x"), ("a", "b")]], (), islands, PARAMS)
    assert _tried(rounds) == [("a", "x")]


def test_a_loop_is_closed_where_the_map_knows_another_way():
    chain = [(a, b) for k, a in enumerate("abcdefg") for b in "abcdefg"[k + 1 : k + 3]]
    rounds = PairSchedule([[("b", "g"), ("b", "d")]], (), chain, PARAMS)
    assert rounds.is_redundant("b", "d")
    assert rounds.is_redundant("b", "f")
    assert not rounds.is_redundant("b", "g")
    assert _tried(rounds) == [("b", "g")]


def test_pairs_of_several_lists_are_tried_once_by_their_best_rank_and_none_again():
    lists = [[("a", "b"), ("a", "c")], [("b", "a"), ("b", "d")]]
    rounds = PairSchedule(lists, [("d", "b")], (), PARAMS)
    assert rounds.next() == [("a", "b"), ("a", "c")]
    assert rounds.next() == []
    swapped = PairSchedule([[("c", "a"), ("b", "a")], [("a", "b")]], (), (), PARAMS)
    assert swapped.next() == [("a", "b"), ("a", "c")]
