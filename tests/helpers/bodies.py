"""Bodies that take no time to make, where the test is of something else than what they look like."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ssad.rendering import scene_objects
from ssad.rendering.bodies.actor_bodies import plain_body
from ssad.rendering.meshes.mesh import Mesh, Point


@contextmanager
def plain_bodies() -> Iterator[None]:
    """All bodies of a cast are boxes of their sizes; the target of clips and signs stay what they are."""

    def box(kind: str, *, size: Point, **other: object) -> Mesh:
        return plain_body(size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_objects, "make_body", box)
        yield


@contextmanager
def two_phases() -> Iterator[None]:
    """People walk with two meshes instead of eight, which a few pictures do not show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_objects, "PHASES", 2)
        yield
