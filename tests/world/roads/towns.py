"""Towns for the tests of roads: built-in ones, and CARLA's, as the fixture `carla_home` has imported them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ssad.world.roads import LaneGraph, load_graph, load_town

BUILT_IN = ("Twinford", "Crossgate", "ProvingGround", "Oldmarket", "Larkhill", "Ringmere", "Longreach")
IMPORTED = ("Town_Safebench_Light", "Town02", "Town05")


@cache
def imported(home: Path, name: str) -> LaneGraph:
    return load_graph(home / "towns" / f"{name}.npz")


def built_in(name: str) -> LaneGraph:
    return load_town(name)
