"""Roads: the lane graph of a town, its router, and nearest-lane and off-road queries."""

from ssad.roads.graph import LaneGraph, Marking, load_graph, save_graph
from ssad.roads.query import LaneQuery

__all__ = ["LaneGraph", "LaneQuery", "Marking", "load_graph", "save_graph"]
