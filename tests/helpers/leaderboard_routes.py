"""A route for each scenario type of Bench2Drive on the towns that ship with SSAD, as a leaderboard's file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

Point = tuple[float, float]


class Route(NamedTuple):
    """Where a type is driven: town, places (m, x east, y north), metres to the trigger, other children."""

    town: str
    points: tuple[Point, ...]
    children: str = ""
    trigger: float = 10.0


def place(tag: str, x: float, y: float) -> str:
    """A child that names a place."""
    return f'<{tag} x="{x}" y="{-y}" z="0"/>'


def flow(start: Point, end: Point, speed: float = 10.0, gaps: Point = (20.0, 35.0)) -> str:
    """The children of a flow."""
    return (
        place("start_actor_flow", *start)
        + place("end_actor_flow", *end)
        + f'<flow_speed value="{speed}"/><source_dist_interval from="{gaps[0]}" to="{gaps[1]}"/>'
    )


GAPS = '<flow_speed value="8"/><source_dist_interval from="20" to="28"/>'
FAR = '<distance value="42"/><direction value="right"/>'
OPPOSITE = '<frequency from="40" to="120"/>'
AHEAD = ((217.0, -5.25), (370.0, -5.25))  # 2 + 2 lanes, in the right one
INNER = ((217.0, -1.75), (370.0, -1.75))  # in the left one
COUNTRY = ((615.0, 198.25), (780.0, 198.25))  # 1 + 1 lanes
LEFT = ((150.0, 198.25), (201.75, 245.0))  # at a signalled crossroads
RIGHT = ((150.0, 194.75), (194.75, 155.0))
ACROSS = ((155.0, 194.75), (245.0, 194.75))
PLAIN_LEFT = ((350.0, -1.75), (401.75, 45.0))  # at a T without signals
PLAIN_RIGHT = ((394.75, 45.0), (355.0, 5.25))
PLAIN_OUT = ((398.25, 45.0), (445.0, -1.75))
MOTORWAY = ((180.0, -7.625), (500.0, -7.5))
RAMP = ((200.0, -37.0), (480.0, -9.4))
EXIT = ((470.0, 9.4), (170.0, 45.0))
GROUND = "ProvingGround"

ROUTES: dict[str, Route] = {
    "Accident": Route(GROUND, AHEAD, FAR + '<speed value="55"/>'),
    "AccidentTwoWays": Route(GROUND, COUNTRY, '<distance value="43"/>' + OPPOSITE),
    "BlockedIntersection": Route(GROUND, RIGHT),
    "ConstructionObstacle": Route(GROUND, AHEAD, FAR),
    "ConstructionObstacleTwoWays": Route(GROUND, COUNTRY, '<distance value="43"/>' + OPPOSITE),
    "CrossingBicycleFlow": Route(GROUND, ACROSS, flow((194.75, 245.0), (194.75, 155.0), 10.0, (14.0, 29.0))),
    "DynamicObjectCrossing": Route(GROUND, AHEAD, FAR + '<crossing_angle value="8"/>'),
    "EnterActorFlow": Route(GROUND, PLAIN_RIGHT, flow((440.0, 5.25), (340.0, 5.25), 12.0)),
    "HardBreakRoute": Route(GROUND, AHEAD, trigger=20.0),
    "HazardAtSideLane": Route(
        GROUND, AHEAD, '<distance value="44"/><bicycle_drive_distance value="60"/><bicycle_speed value="11"/>'
    ),
    "HazardAtSideLaneTwoWays": Route(
        GROUND,
        COUNTRY,
        '<distance value="44"/><bicycle_drive_distance value="80"/><bicycle_speed value="9"/><frequency value="85"/>',
    ),
    "HighwayCutIn": Route("Longreach", MOTORWAY, place("other_actor_location", 200.0, -34.0), 4.0),
    "HighwayExit": Route("Longreach", EXIT, flow((600.0, 9.4), (220.0, 7.625), 11.0), 4.0),
    "InterurbanActorFlow": Route(GROUND, PLAIN_LEFT, flow((460.0, 1.75), (345.0, 1.75), 12.0, (40.0, 80.0))),
    "InterurbanAdvancedActorFlow": Route(GROUND, PLAIN_OUT, flow((460.0, 1.75), (345.0, 1.75), 12.0, (40.0, 80.0))),
    "InvadingTurn": Route(GROUND, COUNTRY, '<distance value="60"/><offset value="0.25"/>'),
    "MergerIntoSlowTraffic": Route("Longreach", RAMP, flow((240.0, -7.625), (520.0, -9.4), 9.0), 6.0),
    "MergerIntoSlowTrafficV2": Route("Longreach", RAMP, flow((240.0, -7.625), (520.0, -9.4), 9.0), 6.0),
    "NonSignalizedJunctionLeftTurn": Route(GROUND, PLAIN_LEFT, GAPS),
    "NonSignalizedJunctionLeftTurnEnterFlow": Route(GROUND, PLAIN_LEFT, GAPS),
    "NonSignalizedJunctionRightTurn": Route(GROUND, PLAIN_RIGHT, GAPS),
    "OppositeVehicleRunningRedLight": Route(GROUND, ACROSS, '<direction value="left"/>'),
    "OppositeVehicleTakingPriority": Route(GROUND, PLAIN_OUT, '<direction value="right"/>'),
    "ParkedObstacle": Route(GROUND, AHEAD, FAR),
    "ParkedObstacleTwoWays": Route(GROUND, COUNTRY, '<distance value="43"/>' + OPPOSITE),
    "ParkingCrossingPedestrian": Route(GROUND, AHEAD, FAR + '<crossing_angle value="2"/>'),
    "ParkingCutIn": Route(GROUND, AHEAD, '<direction value="right"/>'),
    "PedestrianCrossing": Route(GROUND, ACROSS),
    "SequentialLaneChange": Route(GROUND, ((217.0, -5.25), (290.0, -1.75), (370.0, -5.25))),
    "SignalizedJunctionLeftTurn": Route(GROUND, LEFT, GAPS),
    "SignalizedJunctionLeftTurnEnterFlow": Route(GROUND, LEFT, GAPS),
    "SignalizedJunctionRightTurn": Route(GROUND, RIGHT, GAPS),
    "StaticCutIn": Route(GROUND, INNER, FAR),
    "T_Junction": Route(GROUND, PLAIN_LEFT),
    "VanillaNonSignalizedTurn": Route(GROUND, PLAIN_LEFT),
    "VanillaNonSignalizedTurnEncounterStopsign": Route(
        "Oldmarket", ((74.57, 42.96), (78.38, 13.25), (93.25, -1.63), (120.77, -6.33))
    ),
    "VanillaSignalizedTurnEncounterGreenLight": Route(GROUND, LEFT),
    "VanillaSignalizedTurnEncounterRedLight": Route(GROUND, LEFT),
    "VehicleTurningRoute": Route(GROUND, RIGHT),
    "VehicleTurningRoutePedestrian": Route(GROUND, RIGHT),
    "YieldToEmergencyVehicle": Route(GROUND, ((250.0, -1.75), (370.0, -1.75)), '<distance value="27"/>'),
}
"""Type -> its route. Of Bench2Drive's 44, those that are played."""


def write_routes(path: Path, types: Iterable[str] | None = None, routes: dict[str, Route] | None = None) -> Path:
    """Write the routes of some types, or of all, as a file of leaderboard 2.0."""
    known = routes or ROUTES
    parts = []
    for k, kind in enumerate(types or known):
        route = known[kind]
        (x0, y0), (x1, y1) = route.points[0], route.points[1]
        length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
        straight = x0 == x1 or y0 == y1
        heading = (1.0 if x1 > x0 else -1.0, 0.0) if abs(x1 - x0) > abs(y1 - y0) else (0.0, 1.0 if y1 > y0 else -1.0)
        if straight:
            heading = ((x1 - x0) / length, (y1 - y0) / length)
        trigger = x0 + heading[0] * route.trigger, y0 + heading[1] * route.trigger
        points = "".join(place("position", *point) for point in route.points)
        parts.append(
            f'<route id="{k}" town="{route.town}"><waypoints>{points}</waypoints><scenarios>'
            f'<scenario name="{kind}" type="{kind}"><trigger_point x="{trigger[0]}" y="{-trigger[1]}" z="0" yaw="0"/>'
            f"{route.children}</scenario></scenarios></route>"
        )
    path.write_text(f"<routes>{''.join(parts)}</routes>")
    return path
