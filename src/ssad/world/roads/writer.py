"""Writer of streets and junctions as OpenDRIVE 1.4, for towns that are made of straight arms and arcs."""

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

STOP_LINE = CROSSWALK_END + CROSSWALK + 1.0  # m from the end of a street with a crosswalk to the waiting line
PARTING = 0.25  # m from the middle of an interchange to the ends of its arms
SIGN_ASIDE = 0.75  # m from the kerb to the post of a sign
YIELDS = 3  # at every third T-junction without lights the stem yields, elsewhere it stops


def write_town(town: Town) -> str:
    """Return the town as OpenDRIVE text; deterministic."""
    junction_by_end = _ends(town)
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
        start_junction, end_junction = junction_by_end[number, False], junction_by_end[number, True]
        pieces = plan_pieces(street, start_junction.setback, end_junction.setback)
        lengths[number] = sum(piece.length for piece in pieces)
        roads.append(_street(number, street, pieces, (start_junction, end_junction)))
    ramps_by_place = {interchange.place: (interchange.on, interchange.off) for interchange in town.interchanges}
    special_places = {
        *(ramp_place for ramp_places in ramps_by_place.values() for ramp_place in ramp_places),
        *(roundabout.place for roundabout in town.roundabouts),
    }
    junctions = list({id(junction): junction for junction in junction_by_end.values()}.values())
    by_place = {junction.place: junction for junction in junctions}
    plain_junctions = [junction for junction in junctions if junction.place not in special_places]
    for junction in plain_junctions:
        if junction.place in ramps_by_place:
            entry_ramp, exit_ramp = (by_place[ramp_place] for ramp_place in ramps_by_place[junction.place])
            _write_interchange(roads, root, junction, (entry_ramp, exit_ramp))
        else:
            _write_connecting_roads(roads, root, junction)
    signalled_places = set(town.signalled)
    stem_count = 0
    for junction in plain_junctions:
        if junction.place in signalled_places:
            _write_signals(root, roads, junction, lengths)
            continue
        if junction.place in ramps_by_place:
            continue
        signed_arms = _signed_arms(junction)
        stem_count += len(signed_arms) == 1
        _write_signs(roads, junction, signed_arms, lengths, stop=len(signed_arms) > 1 or stem_count % YIELDS > 0)
    for roundabout in town.roundabouts:
        entries = [junction for junction in junctions if junction.place == roundabout.place]
        _write_ring(roads, root, roundabout, entries)
        for junction in entries:
            _write_signs(roads, junction, junction.arms, lengths, stop=False)
    tag_order = {"header": 0, "controller": 2, "junction": 3}  # as the format asks for it, between them the roads
    # `sorted` is stable, so roads and junctions keep the order in which they were made.
    root[:] = sorted([*root, *roads], key=lambda element: tag_order.get(element.tag, 1))
    indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _ends(town: Town) -> dict[tuple[int, bool], Junction]:
    """Return the junction at each (street number, at its last end); every arm of a roundabout has one of its own."""
    ring_by_place = {roundabout.place: roundabout for roundabout in town.roundabouts}
    place_of_ramp = {
        ramp_place: position.place for position in town.interchanges for ramp_place in (position.on, position.off)
    }
    junctions: dict[object, Junction] = {}
    junction_by_end: dict[tuple[int, bool], Junction] = {}
    for number, street in enumerate(town.streets, start=1):
        for position, next_point, at_end in (
            (street.points[0], street.points[1], False),
            (street.points[-1], street.points[-2], True),
        ):
            # Streets that share a place share its junction, except at a ring.
            junction_key: object = (position, number, at_end) if position in ring_by_place else position
            junction = junctions.setdefault(junction_key, Junction(1000 * (len(junctions) + 1), position))
            heading = math.atan2(next_point[1] - position[1], next_point[0] - position[0])
            junction.arms.append(Arm(number, street, heading, at_end))
            junction.ring = ring_by_place.get(position)
            if junction.ring:
                junction.arm_distance = junction.ring.setback
            junction_by_end[number, at_end] = junction
    for interchange in town.interchanges:
        junctions[interchange.place].arm_distance = PARTING
    # The ramps' connecting roads belong to the junction of the interchange.
    for ramp_place, position in place_of_ramp.items():
        junctions[ramp_place].id, junctions[ramp_place].arm_distance = junctions[position].id, 0.0
    return junction_by_end


def _street(number: int, street: RoadSpec, pieces: list[Piece], ends: tuple[Junction, Junction]) -> Element:
    road = road_element(f"street {number}", number, -1, pieces)
    for name, junction in zip(("predecessor", "successor"), ends, strict=True):
        SubElement(road[0], name, elementType="junction", elementId=str(junction.id))
    road_type = Element("type", s="0", type="rural" if not street.sidewalk else "town")
    SubElement(road_type, "speed", max=f"{street.limit:g}", unit="mph")
    road.insert(1, road_type)
    lanes = lane_section(road)
    centre_mark = ("broken", "yellow") if street.lanes == 1 else ("solid solid", "yellow")
    if street.one_way or street.median:
        centre_mark = ("solid", "white") if street.one_way else ("none", "white")
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        if street.one_way and sign > 0:
            continue
        group = SubElement(lanes, side)
        if not sign:
            mark_lane(SubElement(group, "lane", id="0", type="none", level="false"), *centre_mark)
            continue
        lane_specs = [("median", 0.5 * street.median, ("solid", "white"))] if street.median else []
        lane_specs += [
            ("driving", street.width, ("broken", "white") if index < street.lanes else ("solid", "white"))
            for index in range(1, street.lanes + 1)
        ]
        if street.shoulder:
            lane_specs.append(("shoulder", street.shoulder, ("curb" if street.sidewalk else "none", "white")))
        if street.sidewalk:
            lane_specs.append(("sidewalk", street.sidewalk, ("none", "white")))
        numbered_lanes = [(sign * (index + 1), lane_spec) for index, lane_spec in enumerate(lane_specs)]
        for lane, (lane_kind, lane_width, marking) in sorted(
            numbered_lanes, key=lambda numbered_lane: -numbered_lane[0]
        ):
            lane_element(group, lane, lane_kind, (lane_width, 0.0, 0.0, 0.0), mark=marking)
    objects = SubElement(road, "objects")
    length = sum(piece.length for piece in pieces)
    for index, junction in enumerate(ends):
        crosswalk_offset = junction.crosswalk
        if crosswalk_offset and street.sidewalk and not street.one_way:
            _crosswalk(objects, number, index, length - crosswalk_offset if index else crosswalk_offset, street)
    SubElement(road, "signals")  # the last child: `_signals` fills it
    return road


def _crosswalk(objects: Element, number: int, index: int, arc_length: float, street: RoadSpec) -> None:
    half_width = street.lanes * street.width + street.shoulder
    attributes = {"id": str(100 * number + index), "name": "crosswalk", "type": "crosswalk", "orientation": "none"}
    position = {"s": decimal(arc_length), "t": "0", "zOffset": "0", "hdg": "0"}
    crosswalk = SubElement(
        objects, "object", attributes | position, length=decimal(CROSSWALK), width=decimal(2 * half_width)
    )
    outline = SubElement(crosswalk, "outline")
    u, v = 0.5 * CROSSWALK, half_width
    for corner_u, corner_v in ((-u, -v), (u, -v), (u, v), (-u, v), (-u, -v)):
        SubElement(outline, "cornerLocal", u=decimal(corner_u), v=decimal(corner_v), z="0", height="0")


def _write_connecting_roads(roads: list[Element], root: Element, junction: Junction) -> None:
    """Write the connecting roads of every movement through a junction."""
    element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
    number = junction.id
    for start_arm in junction.arms:
        for end_arm in junction.arms:
            if start_arm is end_arm or not (start_arm.leads_in and end_arm.leads_out):
                continue
            turn_angle = wrap(end_arm.heading - start_arm.heading - math.pi)
            for lane_pairs in _movements(junction, start_arm, end_arm, turn_angle):
                number += 1
                road = _connecting_road(number, (junction, junction), (start_arm, end_arm), pairs=lane_pairs)
                _add_connecting_road(roads, element, road, start_arm, lane_pairs)


def _add_connecting_road(
    roads: list[Element], element: Element, road: Element, start: Arm, pairs: list[tuple[int, int]]
) -> None:
    """Enter a connecting road into the list of roads and into its junction."""
    roads.append(road)
    number = road.get("id", "")
    position = int(number) - int(element.get("id", "0")) - 1
    attributes = {"id": str(position), "incomingRoad": str(start.road)}
    connection = SubElement(element, "connection", attributes, connectingRoad=number, contactPoint="start")
    for index, (incoming_lane, _) in enumerate(pairs):
        SubElement(connection, "laneLink", {"from": str(start.inward(incoming_lane)), "to": str(-index - 1)})


def _write_interchange(
    roads: list[Element], root: Element, junction: Junction, ramps: tuple[Junction, Junction]
) -> None:
    """Ways through an interchange: straight on, from the ramp `on` to the wider part, from there to the ramp `off`."""
    element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
    narrow_arm, wide_arm = sorted(junction.arms, key=lambda arm: arm.street.lanes)
    entry_ramp, exit_ramp = ramps
    lanes = [(lane, lane) for lane in range(1, narrow_arm.street.lanes + 1)]
    outermost = wide_arm.street.lanes
    for lane, (place_pair, arm_pair, lane_pairs) in enumerate(
        (
            ((junction, junction), (narrow_arm, wide_arm), lanes),
            ((junction, junction), (wide_arm, narrow_arm), lanes),
            ((entry_ramp, junction), (entry_ramp.arms[0], wide_arm), [(1, outermost)]),
            ((junction, exit_ramp), (wide_arm, exit_ramp.arms[0]), [(outermost, 1)]),
        )
    ):
        _add_connecting_road(
            roads,
            element,
            _connecting_road(junction.id + 1 + lane, place_pair, arm_pair, pairs=lane_pairs),
            arm_pair[0],
            lane_pairs,
        )


def _write_ring(roads: list[Element], root: Element, ring: Roundabout, entries: list[Junction]) -> None:
    """The roads of a ring between its arms, and at each arm the ways on, in and out."""
    entries = sorted(entries, key=lambda junction: wrap(junction.arms[0].heading))
    street = entries[0].arms[0].street
    ring_spec = RoadSpec((), 1, ring.width, street.shoulder, street.sidewalk, ring.limit, one_way=True)
    ring_numbers = {junction.id: junction.id + 400 for junction in entries}
    for junction, next_entry in zip(entries, entries[1:] + entries[:1], strict=True):
        start_angle = junction.arms[0].heading + ring.spread
        turn_angle = (next_entry.arms[0].heading - junction.arms[0].heading) % math.tau - 2.0 * ring.spread
        pieces = [_arc(ring, start_angle, turn_angle)]
        roads.append(_street(ring_numbers[junction.id], ring_spec, pieces, (junction, next_entry)))
    for previous_entry, junction in zip(entries[-1:] + entries[:-1], entries, strict=True):
        element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
        arm, turn_angle = junction.arms[0], 0.5 * math.pi - ring.spread
        ring_in, ring_out = (
            Arm(ring_numbers[previous_entry.id], ring_spec, 0.0, True),
            Arm(ring_numbers[junction.id], ring_spec, 0.0, False),
        )
        low_angle, high_angle = arm.heading - ring.spread, arm.heading + ring.spread
        arm_end = ahead(ring.place, arm.heading, ring.setback)
        island_points = [ahead(ring.place, angle, ring.island) for angle in (low_angle, high_angle)]
        movements = (
            (ring_in, ring_out, [_arc(ring, low_angle, 2.0 * ring.spread)]),
            (arm, ring_out, turn_pieces(arm_end, arm.heading + math.pi, island_points[1], -turn_angle)),
            (ring_in, arm, turn_pieces(island_points[0], low_angle + 0.5 * math.pi, arm_end, -turn_angle)),
        )
        for index, (start_arm, target, pieces) in enumerate(movements, start=1):
            road = _empty_connecting_road(junction.id + index, junction.id, (start_arm, target), pieces)
            fill_way(road, start_arm, target, [(1, 1)], kerb=index > 1, eased=True)
            _add_connecting_road(roads, element, road, start_arm, [(1, 1)])


def _arc(ring: Roundabout, angle: float, turn: float) -> Piece:
    """The edge of the island from an angle on, as far as `turn`."""
    x, y = ahead(ring.place, angle, ring.island)
    return Piece(x, y, angle + 0.5 * math.pi, ring.island * turn, 1.0 / ring.island)


def _movements(junction: Junction, start: Arm, end: Arm, turn: float) -> list[list[tuple[int, int]]]:
    """Lane pairs (from, to; 1 the innermost) of each connecting road from one arm to another.

    Straight on keeps the lane. Turns join outermost to outermost, or innermost to innermost; where three arms
    meet they may also enter the lane beside, so that lanes are not separate circuits.
    """
    incoming_lanes, outgoing_lanes = start.street.lanes, end.street.lanes
    if abs(turn) < 0.1:
        return [[(lane, lane) for lane in range(1, min(incoming_lanes, outgoing_lanes) + 1)]]
    from_lane, main_lane, other_lane = (incoming_lanes, outgoing_lanes, 1) if turn < 0.0 else (1, 1, outgoing_lanes)
    return (
        [[(from_lane, main_lane)], [(from_lane, other_lane)]]
        if outgoing_lanes > 1 and len(junction.arms) == 3
        else [[(from_lane, main_lane)]]
    )


def _connecting_road(
    number: int, places: tuple[Junction, Junction], arms: tuple[Arm, Arm], *, pairs: list[tuple[int, int]]
) -> Element:
    """Write a connecting road; its reference line runs on the left edge of its leftmost lane."""
    start_arm, end_arm = arms
    turn_angle = wrap(end_arm.heading - start_arm.heading - math.pi)
    heading = start_arm.heading + math.pi
    start_point = _arm_edge_point(places[0], start_arm, -start_arm.offset(pairs[0][0]), inward=True)
    end_point = _arm_edge_point(places[1], end_arm, -end_arm.offset(pairs[0][1]), inward=False)
    road = _empty_connecting_road(number, places[0].id, arms, turn_pieces(start_point, heading, end_point, turn_angle))
    # a kerb lies to the right of a right turn, and of a way straight on where no arm leaves to the right
    right_heading = wrap(heading - math.pi / 2.0)
    open_right = any(abs(wrap(arm.heading - right_heading)) < 0.1 for arm in places[0].arms)
    outermost = pairs[-1] == (start_arm.street.lanes, end_arm.street.lanes)
    along_kerb = outermost and (turn_angle < -0.1 or (abs(turn_angle) <= 0.1 and not open_right))
    fill_way(road, start_arm, end_arm, pairs, kerb=along_kerb)
    return road


def _empty_connecting_road(number: int, junction: int, arms: tuple[Arm, Arm], pieces: list[Piece]) -> Element:
    """Write a connecting road without lanes."""
    road = road_element(f"way {number}", number, junction, pieces)
    for name, arm in zip(("predecessor", "successor"), arms, strict=True):
        contact = "end" if arm.at_end else "start"
        SubElement(road[0], name, elementType="road", elementId=str(arm.road), contactPoint=contact)
    return road


def _write_signals(root: Element, roads: list[Element], junction: Junction, lengths: dict[int, float]) -> None:
    """Write a light for every arm, and two controllers: arms along x, then arms along y."""
    element = next(candidate for candidate in root.findall("junction") if candidate.get("id") == str(junction.id))
    groups: dict[int, list[str]] = {}
    for index, arm in enumerate(junction.arms):
        if not arm.leads_in:
            continue
        number = str(junction.id + 500 + index)
        phase = 0 if abs(math.cos(arm.heading)) > 0.5 else 1
        groups.setdefault(phase, []).append(number)
        offset = arm.offset(arm.street.lanes + 1) + arm.street.shoulder + 0.5
        s = lengths[arm.road] - 0.1 if arm.at_end else 0.1
        # orientation "+": it faces traffic that drives along the road's own direction
        light = SubElement(
            roads[arm.road - 1][-1],
            "signal",
            name="Signal_3Light_Post01",
            id=number,
            s=decimal(s),
            t=decimal(-offset if arm.at_end else offset),
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
        low_lane, high_lane = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(light, "validity", fromLane=str(low_lane), toLane=str(high_lane))
    for phase, numbers in sorted(groups.items()):
        number = str(junction.id + 900 + phase)
        SubElement(element, "controller", id=number, type="0", sequence=str(phase))
        controller = Element("controller", name=f"controller {number}", id=number, sequence=str(phase))
        for light_id in numbers:
            SubElement(controller, "control", signalId=light_id, type="0")
        root.insert(list(root).index(element), controller)


def _signed_arms(junction: Junction) -> list[Arm]:
    """Return the arms of a junction without lights that get a sign: all of a crossroads, the stem of a T-junction."""
    if len(junction.arms) < 3:
        return []
    arms = [arm for arm in junction.arms if arm.leads_in]
    opposites = [any(math.cos(incoming.heading - other.heading) < -0.9 for other in junction.arms) for incoming in arms]
    return [arm for arm, has_opposite in zip(arms, opposites, strict=True) if all(opposites) or not has_opposite]


def _write_signs(
    roads: list[Element], junction: Junction, ruled: list[Arm], lengths: dict[int, float], *, stop: bool
) -> None:
    """A stop or yield sign for each of the arms, beside the line where it is waited."""
    name, kind = ("Sign_Stop", "206") if stop else ("Sign_Yield", "205")
    for index, arm in enumerate(ruled):
        lateral = arm.offset(arm.street.lanes + 1) + arm.street.shoulder + SIGN_ASIDE
        setback = STOP_LINE if arm.street.sidewalk and not junction.ring else 0.1
        post = SubElement(
            roads[arm.road - 1][-1],
            "signal",
            name=name,
            id=str(junction.id + 700 + index),
            s=decimal(lengths[arm.road] - setback if arm.at_end else setback),
            t=decimal(-lateral if arm.at_end else lateral),
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
        low_lane, high_lane = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(post, "validity", fromLane=str(low_lane), toLane=str(high_lane))


def _arm_edge_point(junction: Junction, arm: Arm, offset: float, *, inward: bool) -> Point:
    """Return the point at the end of an arm, `offset` m left of the street's middle as seen by traffic in or out."""
    arm_x, arm_y = ahead(junction.place, arm.heading, junction.setback)
    return ahead((arm_x, arm_y), arm.heading + (math.pi if inward else 0.0) + math.pi / 2.0, offset)
