import pytest

from gsmap.report.svg import Axis, log_axis, tick_text


def test_values_lie_between_the_ends():
    axis = Axis(10, 20, 100, 0)
    assert [axis.at(v) for v in (10, 15, 20, 5, 50)] == [100, 50, 0, 100, 0]
    log = Axis(0.01, 100, 0, 400, log=True)
    assert [log.at(v) for v in (0.01, 1, 100, 0, 1e9)] == pytest.approx([0, 200, 400, 0, 400])


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 37.2), (-3, 4), (0, 1e-4), (123456, 123999)])
def test_ticks_are_few_round_and_inside(low, high):
    ticks = Axis(low, high, 0, 1).ticks(6)
    assert 2 <= len(ticks) <= 7
    assert low - 1e-9 <= ticks[0] <= ticks[-1] <= high + 1e-9


def test_a_log_axis_holds_its_values():
    axis = log_axis([0.003, 2.0, 0.0, float("nan")], 0, 1)
    assert (axis.low, axis.high) == (0.001, 10)
    assert axis.ticks() == pytest.approx([1e-3, 1e-2, 0.1, 1, 10])
    assert log_axis([], 0, 1).low == 1


def test_tick_texts_are_short():
    assert [tick_text(v) for v in (0, 0.5, 10, 1e-4, 200000)] == ["0", "0.5", "10", "1e-4", "2e5"]
