"""Towns for the tests of roads: built-in ones, and CARLA's, baked once a session."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ssad.roads import LaneGraph, bake, load_town

BUILT_IN = ("Twinford", "Crossgate", "ProvingGround", "Oldmarket", "Larkhill")
IMPORTED = ("Town_Safebench_Light", "Town02", "Town05")


@cache
def imported(folder: Path, name: str) -> LaneGraph:
    return bake(folder / "maps" / f"{name}.xodr")


def built_in(name: str) -> LaneGraph:
    return load_town(name)
