"""Fixtures for tests of the vision methods."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tactflow.vision import compiled


@pytest.fixture(params=["numba", "plain"])
def each_way(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run a test twice: with compiled kernels, and with numpy and OpenCV alone."""
    on = request.param == "numba"
    with compiled.switched(on):
        if on and not compiled.active():
            pytest.skip('numba is not here: pip install "tactflow[fast]"')
        yield request.param
