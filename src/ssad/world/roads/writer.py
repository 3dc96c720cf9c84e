"""Writes streets and junctions as OpenDRIVE 1.4: the geometry of towns that are made of straight arms and arcs."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from ssad.world.roads.writer_parts import (
    CROSSWALK,
    CROSSWALK_END,
    Arm,
    Junction,
    Piece,
    Point,
    RoadSpec,
    Roundabout,
    Town,
    ahead,
    decimal,
    fill_way,
    lane_element,
    lane_section,
    mark_lane,
    plan_pieces,
    road_element,
    turn_pieces,
    wrap,
)

STOP_LINE = CROSSWALK_END + CROSSWALK + 1.0  # m from the end of a street with a crosswalk to where it is waited
PARTING = 0.25  # m from the middle of an interchange to the ends of its arms
SIGN_ASIDE = 0.75  # m from the kerb to the post of a sign
YIELDS = 3  # at every so manieth T-junction without lights the stem yields, elsewhere it stops


def write_town(town: Town) -> str:
    """The town as OpenDRIVE text, the same for the same town."""
    ends = _ends(town)
    root = Element("OpenDRIVE")
    SubElement(
        root,
        "header",
        revMajor="1",
        revMinor="4",
        name=town.name,
        version="1",
        north="0",
        south="0",
        east="0",
        west="0",
        vendor="SSAD",
    )
    roads: list[Element] = []
    lengths: dict[int, float] = {}
    for number, street in enumerate(town.streets, start=1):
        start, end = ends[number, False], ends[number, True]
        pieces = plan_pieces(street, start.setback, end.setback)
        lengths[number] = sum(piece.length for piece in pieces)
        roads.append(_street(number, street, pieces, (start, end)))
    gates = {place.place: (place.on, place.off) for place in town.interchanges}
    special = {*(gate for pair in gates.values() for gate in pair), *(ring.place for ring in town.roundabouts)}
    junctions = list({id(junction): junction for junction in ends.values()}.values())
    by_place = {junction.place: junction for junction in junctions}
    plain = [junction for junction in junctions if junction.place not in special]
    for junction in plain:
        if junction.place in gates:
            on, off = (by_place[gate] for gate in gates[junction.place])
            _interchange(roads, root, junction, (on, off))
        else:
            _connect(roads, root, junction)
    places = set(town.signalled)
    stems = 0
    for junction in plain:
        if junction.place in places:
            _signals(root, roads, junction, lengths)
            continue
        if junction.place in gates:
            continue
        ruled = _ruled(junction)
        stems += len(ruled) == 1
        _signs(roads, junction, ruled, lengths, stop=len(ruled) > 1 or stems % YIELDS > 0)
    for ring in town.roundabouts:
        entries = [junction for junction in junctions if junction.place == ring.place]
        _ring(roads, root, ring, entries)
        for junction in entries:
            _signs(roads, junction, junction.arms, lengths, stop=False)
    order = {"header": 0, "controller": 2, "junction": 3}  # as the format asks for it, between them the roads
    root[:] = sorted([*root, *roads], key=lambda element: order.get(element.tag, 1))
    indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _ends(town: Town) -> dict[tuple[int, bool], Junction]:
    """(number of a street, whether its last end) -> the junction there; each arm of a roundabout has one of its own."""
    rings = {ring.place: ring for ring in town.roundabouts}
    middle = {gate: place.place for place in town.interchanges for gate in (place.on, place.off)}
    found: dict[object, Junction] = {}
    ends: dict[tuple[int, bool], Junction] = {}
    for number, street in enumerate(town.streets, start=1):
        for place, inner, at_end in (
            (street.points[0], street.points[1], False),
            (street.points[-1], street.points[-2], True),
        ):
            key: object = (place, number, at_end) if place in rings else place
            junction = found.setdefault(key, Junction(1000 * (len(found) + 1), place))
            heading = math.atan2(inner[1] - place[1], inner[0] - place[0])
            junction.arms.append(Arm(number, street, heading, at_end))
            junction.ring = rings.get(place)
            if junction.ring:
                junction.apart = junction.ring.setback
            ends[number, at_end] = junction
    for interchange in town.interchanges:
        found[interchange.place].apart = PARTING
    for gate, place in middle.items():
        found[gate].id, found[gate].apart = found[place].id, 0.0
    return ends


def _street(number: int, street: RoadSpec, pieces: list[Piece], ends: tuple[Junction, Junction]) -> Element:
    road = road_element(f"street {number}", number, -1, pieces)
    for name, junction in zip(("predecessor", "successor"), ends, strict=True):
        SubElement(road[0], name, elementType="junction", elementId=str(junction.id))
    kind = Element("type", s="0", type="rural" if not street.sidewalk else "town")
    SubElement(kind, "speed", max=f"{street.limit:g}", unit="mph")
    road.insert(1, kind)
    lanes = lane_section(road)
    middle = ("broken", "yellow") if street.lanes == 1 else ("solid solid", "yellow")
    if street.one_way or street.median:
        middle = ("solid", "white") if street.one_way else ("none", "white")
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        if street.one_way and sign > 0:
            continue
        group = SubElement(lanes, side)
        if not sign:
            mark_lane(SubElement(group, "lane", id="0", type="none", level="false"), *middle)
            continue
        rows = [("median", 0.5 * street.median, ("solid", "white"))] if street.median else []
        rows += [
            ("driving", street.width, ("broken", "white") if k < street.lanes else ("solid", "white"))
            for k in range(1, street.lanes + 1)
        ]
        if street.shoulder:
            rows.append(("shoulder", street.shoulder, ("curb" if street.sidewalk else "none", "white")))
        if street.sidewalk:
            rows.append(("sidewalk", street.sidewalk, ("none", "white")))
        table = [(sign * (k + 1), row) for k, row in enumerate(rows)]
        for lane, (what, width, mark) in sorted(table, key=lambda item: -item[0]):
            lane_element(group, lane, what, (width, 0.0, 0.0, 0.0), mark=mark)
    objects = SubElement(road, "objects")
    length = sum(piece.length for piece in pieces)
    for k, junction in enumerate(ends):
        aside = junction.crosswalk
        if aside and street.sidewalk and not street.one_way:
            _crosswalk(objects, number, k, length - aside if k else aside, street)
    SubElement(road, "signals")  # the last child: `_signals` fills it
    return road


def _crosswalk(objects: Element, number: int, k: int, s: float, street: RoadSpec) -> None:
    half = street.lanes * street.width + street.shoulder
    name = {"id": str(100 * number + k), "name": "crosswalk", "type": "crosswalk", "orientation": "none"}
    place = {"s": decimal(s), "t": "0", "zOffset": "0", "hdg": "0"}
    item = SubElement(objects, "object", name | place, length=decimal(CROSSWALK), width=decimal(2 * half))
    outline = SubElement(item, "outline")
    u, v = 0.5 * CROSSWALK, half
    for a, b in ((-u, -v), (u, -v), (u, v), (-u, v), (-u, -v)):
        SubElement(outline, "cornerLocal", u=decimal(a), v=decimal(b), z="0", height="0")


def _connect(roads: list[Element], root: Element, junction: Junction) -> None:
    """Connecting roads for every movement through a junction."""
    element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
    number = junction.id
    for start in junction.arms:
        for end in junction.arms:
            if start is end or not (start.leads_in and end.leads_out):
                continue
            turn = wrap(end.heading - start.heading - math.pi)
            for pairs in _movements(junction, start, end, turn):
                number += 1
                road = _way(number, (junction, junction), (start, end), pairs=pairs)
                _add_way(roads, element, road, start, pairs)


def _add_way(roads: list[Element], element: Element, road: Element, start: Arm, pairs: list[tuple[int, int]]) -> None:
    """Enter a connecting road into the list of roads and into its junction."""
    roads.append(road)
    number = road.get("id", "")
    place = int(number) - int(element.get("id", "0")) - 1
    attributes = {"id": str(place), "incomingRoad": str(start.road)}
    joint = SubElement(element, "connection", attributes, connectingRoad=number, contactPoint="start")
    for k, (one, _) in enumerate(pairs):
        SubElement(joint, "laneLink", {"from": str(start.inward(one)), "to": str(-k - 1)})


def _interchange(roads: list[Element], root: Element, junction: Junction, ramps: tuple[Junction, Junction]) -> None:
    """Ways through an interchange: straight on, from the ramp `on` to the wider part, from there to the ramp `off`."""
    element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
    narrow, wide = sorted(junction.arms, key=lambda arm: arm.street.lanes)
    on, off = ramps
    lanes = [(k, k) for k in range(1, narrow.street.lanes + 1)]
    last = wide.street.lanes
    for k, (places, arms, pairs) in enumerate(
        (
            ((junction, junction), (narrow, wide), lanes),
            ((junction, junction), (wide, narrow), lanes),
            ((on, junction), (on.arms[0], wide), [(1, last)]),
            ((junction, off), (wide, off.arms[0]), [(last, 1)]),
        )
    ):
        _add_way(roads, element, _way(junction.id + 1 + k, places, arms, pairs=pairs), arms[0], pairs)


def _ring(roads: list[Element], root: Element, ring: Roundabout, entries: list[Junction]) -> None:
    """The roads of a ring between its arms, and at each arm the ways on, in and out."""
    entries = sorted(entries, key=lambda junction: wrap(junction.arms[0].heading))
    street = entries[0].arms[0].street
    spec = RoadSpec((), 1, ring.width, street.shoulder, street.sidewalk, ring.limit, one_way=True)
    number = {junction.id: junction.id + 400 for junction in entries}
    for junction, after in zip(entries, entries[1:] + entries[:1], strict=True):
        begin = junction.arms[0].heading + ring.spread
        turn = (after.arms[0].heading - junction.arms[0].heading) % math.tau - 2.0 * ring.spread
        pieces = [_arc(ring, begin, turn)]
        roads.append(_street(number[junction.id], spec, pieces, (junction, after)))
    for before, junction in zip(entries[-1:] + entries[:-1], entries, strict=True):
        element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
        arm, turn = junction.arms[0], 0.5 * math.pi - ring.spread
        comes, goes = Arm(number[before.id], spec, 0.0, True), Arm(number[junction.id], spec, 0.0, False)
        low, high = arm.heading - ring.spread, arm.heading + ring.spread
        end = ahead(ring.place, arm.heading, ring.setback)
        inner = [ahead(ring.place, angle, ring.island) for angle in (low, high)]
        ways = (
            (comes, goes, [_arc(ring, low, 2.0 * ring.spread)]),
            (arm, goes, turn_pieces(end, arm.heading + math.pi, inner[1], -turn)),
            (comes, arm, turn_pieces(inner[0], low + 0.5 * math.pi, end, -turn)),
        )
        for k, (start, to, pieces) in enumerate(ways, start=1):
            road = _way_road(junction.id + k, junction.id, (start, to), pieces)
            fill_way(road, start, to, [(1, 1)], kerb=k > 1, eased=True)
            _add_way(roads, element, road, start, [(1, 1)])


def _arc(ring: Roundabout, angle: float, turn: float) -> Piece:
    """The edge of the island from an angle on, as far as `turn`."""
    x, y = ahead(ring.place, angle, ring.island)
    return Piece(x, y, angle + 0.5 * math.pi, ring.island * turn, 1.0 / ring.island)


def _movements(junction: Junction, start: Arm, end: Arm, turn: float) -> list[list[tuple[int, int]]]:
    """Lane pairs (from, to; 1 the innermost) of each connecting road from one arm to another.

    Straight on keeps the lane. Turns join outermost to outermost, or innermost to innermost; where three arms
    meet they may also enter the lane beside, so that lanes are not separate circuits.
    """
    n, m = start.street.lanes, end.street.lanes
    if abs(turn) < 0.1:
        return [[(k, k) for k in range(1, min(n, m) + 1)]]
    one, main, other = (n, m, 1) if turn < 0.0 else (1, 1, m)
    return [[(one, main)], [(one, other)]] if m > 1 and len(junction.arms) == 3 else [[(one, main)]]


def _way(
    number: int, places: tuple[Junction, Junction], arms: tuple[Arm, Arm], *, pairs: list[tuple[int, int]]
) -> Element:
    """One connecting road between arms at two places; its reference line runs on the left edge of its leftmost lane."""
    start, end = arms
    turn = wrap(end.heading - start.heading - math.pi)
    heading = start.heading + math.pi
    a = _edge(places[0], start, -start.offset(pairs[0][0]), inward=True)
    b = _edge(places[1], end, -end.offset(pairs[0][1]), inward=False)
    road = _way_road(number, places[0].id, arms, turn_pieces(a, heading, b, turn))
    # a kerb lies to the right of a right turn, and of a way straight on where no arm leaves to the right
    right = wrap(heading - math.pi / 2.0)
    open_right = any(abs(wrap(arm.heading - right)) < 0.1 for arm in places[0].arms)
    outermost = pairs[-1] == (start.street.lanes, end.street.lanes)
    kerb = outermost and (turn < -0.1 or (abs(turn) <= 0.1 and not open_right))
    fill_way(road, start, end, pairs, kerb=kerb)
    return road


def _way_road(number: int, junction: int, arms: tuple[Arm, Arm], pieces: list[Piece]) -> Element:
    """A connecting road without lanes."""
    road = road_element(f"way {number}", number, junction, pieces)
    for name, arm in zip(("predecessor", "successor"), arms, strict=True):
        contact = "end" if arm.at_end else "start"
        SubElement(road[0], name, elementType="road", elementId=str(arm.road), contactPoint=contact)
    return road


def _signals(root: Element, roads: list[Element], junction: Junction, lengths: dict[int, float]) -> None:
    """A light for every arm, and two controllers: arms along x, then arms along y."""
    element = next(e for e in root.findall("junction") if e.get("id") == str(junction.id))
    groups: dict[int, list[str]] = {}
    for k, arm in enumerate(junction.arms):
        if not arm.leads_in:
            continue
        number = str(junction.id + 500 + k)
        phase = 0 if abs(math.cos(arm.heading)) > 0.5 else 1
        groups.setdefault(phase, []).append(number)
        half = arm.offset(arm.street.lanes + 1) + arm.street.shoulder + 0.5
        s = lengths[arm.road] - 0.1 if arm.at_end else 0.1
        # orientation "+": it faces traffic that drives along the road's own direction
        light = SubElement(
            roads[arm.road - 1][-1],
            "signal",
            name="Signal_3Light_Post01",
            id=number,
            s=decimal(s),
            t=decimal(-half if arm.at_end else half),
            zOffset="0",
            hOffset="0",
            roll="0",
            pitch="0",
            orientation="+" if arm.at_end else "-",
            dynamic="yes",
            country="OpenDRIVE",
            type="1000001",
            subtype="-1",
            value="-1",
            text="",
            height="1.2",
            width="0.5",
        )
        low, high = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(light, "validity", fromLane=str(low), toLane=str(high))
    for phase, numbers in sorted(groups.items()):
        number = str(junction.id + 900 + phase)
        SubElement(element, "controller", id=number, type="0", sequence=str(phase))
        controller = Element("controller", name=f"controller {number}", id=number, sequence=str(phase))
        for name in numbers:
            SubElement(controller, "control", signalId=name, type="0")
        root.insert(list(root).index(element), controller)


def _ruled(junction: Junction) -> list[Arm]:
    """Arms of a junction without lights that get a sign: all of a crossroads, the stem of a T-junction."""
    if len(junction.arms) < 3:
        return []
    arms = [arm for arm in junction.arms if arm.leads_in]
    facing = [any(math.cos(a.heading - b.heading) < -0.9 for b in junction.arms) for a in arms]
    return [arm for arm, faced in zip(arms, facing, strict=True) if all(facing) or not faced]


def _signs(
    roads: list[Element], junction: Junction, ruled: list[Arm], lengths: dict[int, float], *, stop: bool
) -> None:
    """A stop or yield sign for each of the arms, beside the line where it is waited."""
    name, kind = ("Sign_Stop", "206") if stop else ("Sign_Yield", "205")
    for k, arm in enumerate(ruled):
        aside = arm.offset(arm.street.lanes + 1) + arm.street.shoulder + SIGN_ASIDE
        back = STOP_LINE if arm.street.sidewalk and not junction.ring else 0.1
        post = SubElement(
            roads[arm.road - 1][-1],
            "signal",
            name=name,
            id=str(junction.id + 700 + k),
            s=decimal(lengths[arm.road] - back if arm.at_end else back),
            t=decimal(-aside if arm.at_end else aside),
            zOffset="0",
            hOffset="0",
            roll="0",
            pitch="0",
            orientation="+" if arm.at_end else "-",
            dynamic="no",
            country="OpenDRIVE",
            type=kind,
            subtype="-1",
            value="-1",
            text="",
            height="0.76",
            width="0.76",
        )
        low, high = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(post, "validity", fromLane=str(low), toLane=str(high))


def _edge(junction: Junction, arm: Arm, offset: float, *, inward: bool) -> Point:
    """Point at the end of an arm, `offset` m left of the street's middle as seen by traffic in or out."""
    x, y = ahead(junction.place, arm.heading, junction.setback)
    return ahead((x, y), arm.heading + (math.pi if inward else 0.0) + math.pi / 2.0, offset)
