"""Links of lanes: the union of all that an OpenDRIVE file says on either side of a connection."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.types import F64, LaneType
from ssad.world.roads.xodr import Connection, Lane, Link, MapRoad, Network

Key = tuple[int, int, int]  # road, section, lane id
End = tuple[Key, int]  # lane, and 0 for its start or 1 for its end, in the direction of the road
TOUCHING = 0.1  # m between a section's start and the position of a link between the ends of a road


class LaneLinks:
    """Lanes that touch, end by end.

    A link has no direction in the file: which lane is entered follows from the traffic in both. So a link that stands
    on one side only, or once on each, counts once.
    """

    def __init__(self, network: Network, road_ends: F64, report: ImportReport) -> None:
        """Collect the links.

        Args:
            network: Roads and junctions.
            road_ends: x and y of the start and end of each road [R, 2, 2], m.
            report: Filled with links to lanes that do not exist.
        """
        self.network = network
        self.report = report
        self.ends = dict(zip(network.roads, road_ends, strict=True))
        self.touching: dict[End, dict[End, None]] = {}
        self.junction_links: set[tuple[End, End]] = set()
        for road in network.roads.values():
            self._within(road)
            for end, link in ((0, road.predecessor), (1, road.successor)):
                if link and link.kind == "road":
                    self._road(road, end, link)
                    self._road_back(road, end, link)
        for number, connections in network.junctions.items():
            for connection in connections:
                self._connection(number, connection)

    def following(self, key: Key) -> list[Key]:
        """Return the lanes that traffic enters from the end of a lane."""
        exit_end = (key, int(self.lane(key).forward))
        return [
            other
            for other, end in self.touching.get(exit_end, ())
            if other != key and self.lane(other).forward == (end == 0) and self._may_enter(exit_end, (other, end))
        ]

    def lane(self, key: Key) -> Lane:
        """Return a lane by its key."""
        return self.network.roads[key[0]].sections[key[1]].lanes[key[2]]

    def _may_enter(self, first: End, second: End) -> bool:
        """Return False for footways and shoulders that a junction does not name among its connections."""
        (key, _), (other, _) = first, second
        into_junction = self.network.roads[key[0]].junction < 0 <= self.network.roads[other[0]].junction
        is_driving = self.lane(key).kind == LaneType.DRIVING
        return is_driving or not into_junction or (first, second) in self.junction_links

    def _within(self, road: MapRoad) -> None:
        for index, (section, after) in enumerate(zip(road.sections[:-1], road.sections[1:], strict=True)):
            for lane in section.lanes.values():
                for target in lane.successors:
                    self._join(((road.id, index, lane.id), 1), ((road.id, index + 1, target), 0))
            for lane in after.lanes.values():
                for target in lane.predecessors:
                    self._join(((road.id, index + 1, lane.id), 0), ((road.id, index, target), 1))

    def _road(self, road: MapRoad, end: int, link: Link) -> None:
        section = len(road.sections) - 1 if end else 0
        for lane in road.sections[section].lanes.values():
            for target in lane.successors if end else lane.predecessors:
                for other in self._ends_of(link, target, self.ends[road.id][end]):
                    self._join(((road.id, section, lane.id), end), other)

    def _road_back(self, road: MapRoad, end: int, link: Link) -> None:
        """Join the lanes that the other road of a link names, where that road itself says nothing of the link."""
        if link.s is not None:
            return
        other = self.network.roads[link.id]
        contact = self._contact(other, link.contact, self.ends[road.id][end])
        if (other.predecessor, other.successor)[contact] is None:
            self._road(other, contact, Link("road", road.id, "end" if end else "start"))

    def _ends_of(self, link: Link, lane: int, place: F64) -> Iterator[End]:
        """Yield the ends of a lane of a road that a link reaches."""
        road = self.network.roads[link.id]
        if link.s is None:
            yield self._end_of(road, self._contact(road, link.contact, place), lane)
            return
        for index, section in enumerate(road.sections):
            if abs(section.s0 - link.s) < TOUCHING:
                yield (road.id, index, lane), 0
            if abs(section.s1 - link.s) < TOUCHING:
                yield (road.id, index, lane), 1

    def _contact(self, road: MapRoad, contact: str, place: F64) -> int:
        """Return the end of a road that a link names, else the one that is nearer to a place."""
        if contact in ("start", "end"):
            return int(contact == "end")
        return int(np.argmin(np.hypot(*(self.ends[road.id] - place).T)))

    def _end_of(self, road: MapRoad, end: int, lane: int) -> End:
        return (road.id, len(road.sections) - 1 if end else 0, lane), end

    def _connection(self, junction: int, connection: Connection) -> None:
        incoming, connecting = self.network.roads[connection.incoming], self.network.roads[connection.connecting]
        starts = self.ends[connecting.id]
        candidates = [
            end
            for end, link in ((0, incoming.predecessor), (1, incoming.successor))
            if link and link.kind == "junction" and link.id == junction
        ]
        named = int(connection.contact == "end") if connection.contact in ("start", "end") else None
        back_link = (connecting.predecessor, connecting.successor)[named] if named is not None else None
        if back_link and back_link.kind == "road" and back_link.id == incoming.id and back_link.s is not None:
            for source, target in connection.lanes:
                for place in self._ends_of(back_link, source, starts[named or 0]):
                    self._join(self._end_of(connecting, named or 0, target), place)
            return
        if not candidates:
            self.report.doubt(
                "a junction names an incoming road that does not name the junction",
                f"junction {junction}, road {incoming.id}",
            )
        # A road may begin and end at one junction: the connecting road begins at one of the two ends.
        distance = np.hypot(*np.moveaxis(self.ends[incoming.id][:, None] - starts[None], -1, 0))
        pairs = [
            (float(distance[end, other]), end, other)
            for end in candidates or (0, 1)
            for other in ((0, 1) if named is None else (named,))
        ]
        _, incoming_end, connecting_end = min(pairs)
        for source, target in connection.lanes:
            link = (self._end_of(incoming, incoming_end, source), self._end_of(connecting, connecting_end, target))
            self._join(*link)
            self.junction_links.add(link)

    def _join(self, first: End, second: End) -> None:
        for (road, section, lane), _ in (first, second):
            if lane not in self.network.roads[road].sections[section].lanes:
                if lane:
                    self.report.doubt("a lane is linked to one that does not exist", f"road {road}, lane {lane}")
                return
        self.touching.setdefault(first, {})[second] = None
        self.touching.setdefault(second, {})[first] = None
