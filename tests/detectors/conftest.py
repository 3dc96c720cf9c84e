"""Detectors are tested on one core: their pictures are small, and threads that wait for each other cost the most."""

from collections.abc import Iterator

import pytest
from helpers.mono3d import one_thread


@pytest.fixture(autouse=True, scope="module")
def _on_one_thread() -> Iterator[None]:
    with one_thread():
        yield
