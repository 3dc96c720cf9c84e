"""Roads: the lane graph of a town, its router, and nearest-lane and off-road queries."""

from ssad.core.lane_graph import LaneGraph, Marking, load_graph, save_graph
from ssad.world.roads.bake import bake, import_map
from ssad.world.roads.library import is_town, load_town, town_names, town_signals, town_xodr
from ssad.world.roads.query import LaneQuery, Nearest
from ssad.world.roads.router import random_route, route_along

__all__ = [
    "LaneGraph",
    "LaneQuery",
    "Marking",
    "Nearest",
    "bake",
    "import_map",
    "is_town",
    "load_graph",
    "load_town",
    "random_route",
    "route_along",
    "save_graph",
    "town_names",
    "town_signals",
    "town_xodr",
]
