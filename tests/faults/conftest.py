from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fault_client import Client, described, faulty
from fault_shim import why_not


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """A process with everything imported that runs verbs and disturbs them."""
    if (reason := why_not()) is not None:
        pytest.skip(reason)
    with Client() as made:
        yield made


@pytest.fixture(scope="session")
def sound() -> Callable[[list[dict[str, Any]]], None]:
    """Fails where something was wrong at a point."""

    def check(points: list[dict[str, Any]]) -> None:
        bad = [described(point) for point in points if faulty(point)]
        assert not bad, "\n".join(bad[:10])

    return check
