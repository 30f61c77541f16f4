import pytest

from gsmap.render import native


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def instruction_set(request):
    """Every set of kernels that this machine can run: a map may be opened by another one, which runs fewer."""
    if native.use_instruction_set(request.param) != request.param:
        pytest.skip(f"this machine cannot run {request.param}")
    yield request.param
    native.use_instruction_set("best")
