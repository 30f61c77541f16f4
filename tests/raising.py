"""`raises`, by which tests tell errors apart: by class and code, not by wording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gsmap.errors import GsmapError


@contextmanager
def raises(
    kind: type[GsmapError] | tuple[type[GsmapError], ...],
    *,
    code: str | tuple[str, ...],
    match: str | None = None,
) -> Iterator[pytest.ExceptionInfo[GsmapError]]:
    """Expect a gsmap error of a class with a code of `tools.make.error_codes.ERRORS`.

    Args:
        kind: the class or classes.
        code: the code; several where the outcome depends on chance.
        match: a pattern that the message must hold, where its words matter: the file, the line or the option at fault.
    """
    __tracebackhide__ = True
    with pytest.raises(kind, match=match) as caught:
        yield caught
    codes = (code,) if isinstance(code, str) else code
    assert caught.value.code in codes, f"code {caught.value.code!r}, not {' or '.join(codes)}: {caught.value}"
