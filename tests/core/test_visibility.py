"""Visibility behind occluders, against shadows that can be worked out by hand."""

from dataclasses import replace

import numpy as np

from ssad.core.driving import Belief
from ssad.core.types import AgentKind
from ssad.core.visibility import is_visible


def test_objects_in_the_shadow_of_a_bus_are_hidden() -> None:
    """Eye at 0, a bus from 14.9 to 25.1 m and 2.5 m wide: it covers |y| < 1.25 x / 14.9 behind it, no more."""

    def rows(*places, size=(0.5, 0.5)):
        pose = np.array([[[20.0, 0.0, 0.0], *[(x, y, 0.0) for x, y in places]]], np.float32)
        sizes = np.array([[(10.27, 2.5), *[size] * len(places)]], np.float32)
        kind = np.array([[AgentKind.BUS, *[AgentKind.WALKER] * len(places)]], np.int32)
        return Belief(pose, np.zeros(kind.shape, np.float32), sizes, kind)

    eye = np.zeros((1, 2), np.float32)
    edge = 1.25 / (20.0 - 5.135) * 30.0  # of the shadow, 30 m ahead
    places = [
        (30.0, 0.0),
        (30.0, edge - 0.4),
        (30.0, edge + 0.4),
        (10.0, 0.0),
        (99.0, 30.0),
        (101.0, 0.0),
        (0.0, 101.0),
    ]
    assert is_visible(eye, rows(*places)).tolist() == [[True, False, False, True, True, False, False, False]]
    # a corner is enough: a walker whose middle lies in the shadow, 0.2 m from its edge
    assert is_visible(eye, rows((30.0, edge - 0.2))).tolist() == [[True, True]]
    people = rows((30.0, 0.0))
    hedge = replace(people, kind=np.full((1, 2), AgentKind.WALKER, np.int32))
    assert is_visible(eye, hedge).all()  # people hide nobody
    unused = replace(people, kind=np.array([[AgentKind.NONE, AgentKind.WALKER]], np.int32))
    assert is_visible(eye, unused).tolist() == [[False, True]]
    assert is_visible(np.array([[20.0, 0.5]], np.float32), people).all()  # who looks from inside sees out
