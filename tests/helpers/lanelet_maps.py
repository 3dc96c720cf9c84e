"""Small Lanelet2 maps, written point by point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

Point = tuple[float, ...]


class MapWriter:
    """Lanelet2 map. Points at one place are one node, and lines through the same points one way."""

    def __init__(self, *, local: bool = True) -> None:
        self.local = local  # local_x and local_y; without them, x is taken for longitude and y for latitude
        self.nodes: dict[Point, int] = {}
        self.ways: dict[tuple[int, ...], tuple[int, dict[str, str]]] = {}
        self.relations: list[str] = []
        self.count = 0

    def number(self) -> int:
        self.count += 1
        return self.count

    def node(self, point: Point) -> int:
        place = tuple(float(number) for number in point)
        if place not in self.nodes:
            self.nodes[place] = self.number()
        return self.nodes[place]

    def way(self, points: Sequence[Point], **tags: str) -> int:
        nodes = tuple(self.node(point) for point in points)
        nodes = nodes if nodes in self.ways or nodes[::-1] not in self.ways else nodes[::-1]
        number, known_tags = self.ways.setdefault(nodes, (self.number(), {}))
        known_tags.update(tags)
        return number

    def relation(self, members: Sequence[tuple[str, int]], tags: Mapping[str, str], kind: str = "way") -> int:
        number = self.number()
        member_text = "".join(f'<member type="{kind}" ref="{ref}" role="{role}"/>' for role, ref in members)
        self.relations.append(f'<relation id="{number}">{member_text}{_tags(tags)}</relation>')
        return number

    def lanelet(self, left: Sequence[Point], right: Sequence[Point], *rules: int, **tags: str) -> int:
        members = [("left", self.way(left)), ("right", self.way(right))]
        members += [("regulatory_element", rule) for rule in rules]
        return self.relation(members, {"type": "lanelet", "subtype": "road", "location": "urban", **tags})

    def rule(self, subtype: str, members: Sequence[tuple[str, int]], **tags: str) -> int:
        return self.relation(members, {"type": "regulatory_element", "subtype": subtype, **tags})

    def text(self) -> str:
        nodes = []
        for point, number in self.nodes.items():
            place = 'lat="" lon=""' if self.local else f'lat="{point[1]!r}" lon="{point[0]!r}"'
            tags = {"local_x": repr(point[0]), "local_y": repr(point[1])} if self.local else {}
            tags |= {"ele": repr(point[2])} if len(point) > 2 else {}
            nodes.append(f'<node id="{number}" {place}>{_tags(tags)}</node>')
        ways = []
        for points, (number, tags) in self.ways.items():
            references = "".join(f'<nd ref="{node}"/>' for node in points)
            ways.append(f'<way id="{number}">{references}{_tags(tags)}</way>')
        return "\n".join(['<?xml version="1.0"?>', '<osm generator="test">', *nodes, *ways, *self.relations, "</osm>"])

    def write(self, path: Path) -> Path:
        path.write_text(self.text(), encoding="utf-8")
        return path


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())


def straight(x0: float, x1: float, y: float) -> list[Point]:
    """Points of a line along x."""
    return [(x0, y), (x1, y)]


def crossing_map() -> MapWriter:
    """Two one-way roads that cross, the eastbound one with a light; the junction is 20 m long."""
    road = MapWriter()
    line = road.way([(-32.0, 2.0), (-32.0, -2.0)], type="stop_line")
    lamp = road.way([(6.0, 3.0), (6.0, 4.0)], type="traffic_light", subtype="red_yellow_green")
    light = road.rule("traffic_light", [("refers", lamp), ("ref_line", line)])
    road.lanelet(straight(-60, -10, 2), straight(-60, -10, -2), light)
    road.lanelet(straight(-10, 10, 2), straight(-10, 10, -2))
    road.lanelet(straight(10, 60, 2), straight(10, 60, -2))
    road.lanelet([(-2.0, -60.0), (-2.0, -10.0)], [(2.0, -60.0), (2.0, -10.0)])
    road.lanelet([(-2.0, -10.0), (-2.0, 10.0)], [(2.0, -10.0), (2.0, 10.0)])
    road.lanelet([(-2.0, 10.0), (-2.0, 60.0)], [(2.0, 10.0), (2.0, 60.0)])
    return road
