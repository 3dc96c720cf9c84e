"""OpenSCENARIO documents for tests: one straight road, an ego and a target, and parts that each test states."""

from __future__ import annotations

from pathlib import Path

LENGTH, WIDTH = 1000.0, 3.5  # m of the road and of its lanes
VEHICLE = """<Vehicle name="{name}" vehicleCategory="car"><BoundingBox><Center x="1.4" y="0" z="0.9"/>
<Dimensions width="1.9" length="4.4" height="1.5"/></BoundingBox>
<Performance maxSpeed="70" maxAcceleration="9" maxDeceleration="9"/>
<Axles><FrontAxle maxSteering="0.5" wheelDiameter="0.6" trackWidth="1.7" positionX="2.6" positionZ="0.3"/>
<RearAxle maxSteering="0" wheelDiameter="0.6" trackWidth="1.7" positionX="0" positionZ="0.3"/></Axles>
<Properties/></Vehicle>"""


def road(lanes: int = 2, *, length: float = LENGTH) -> str:
    """Return an OpenDRIVE map: a straight motorway from (0, 0) along x, with lanes -1, -2, ... on its right."""
    rows = "".join(
        f'<lane id="-{number}" type="driving"><width sOffset="0" a="{WIDTH}" b="0" c="0" d="0"/></lane>'
        for number in range(1, lanes + 1)
    )
    return (
        '<OpenDRIVE><header revMajor="1" revMinor="6"/>'
        f'<road id="1" length="{length}" junction="-1"><type s="0" type="motorway"/><planView>'
        f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry></planView><lanes>'
        f'<laneSection s="0"><center><lane id="0" type="none"/></center><right>{rows}</right></laneSection></lanes>'
        "</road></OpenDRIVE>"
    )


def lane_position(lane: str | int, s: str | float, offset: str | float = 0) -> str:
    """Return a position on the road."""
    return f'<Position><LanePosition roadId="1" laneId="{lane}" s="{s}" offset="{offset}"/></Position>'


def start(entity: str, position: str, speed: str | float, more: str = "") -> str:
    """Return the actions of an entity at the start."""
    return (
        f'<Private entityRef="{entity}"><PrivateAction><TeleportAction>{position}</TeleportAction></PrivateAction>'
        f"<PrivateAction>{speed_action(speed, 'step', 'time', 0)}</PrivateAction>{more}</Private>"
    )


def speed_action(speed: str | float, shape: str, dimension: str, value: str | float) -> str:
    """Return a LongitudinalAction that changes a speed."""
    return (
        f'<LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="{shape}" value="{value}"'
        f' dynamicsDimension="{dimension}"/><SpeedActionTarget><AbsoluteTargetSpeed value="{speed}"/>'
        "</SpeedActionTarget></SpeedAction></LongitudinalAction>"
    )


def event(name: str, action: str, *groups: str, count: int = 1) -> str:
    """Return an event with a private action; each group holds conditions, and without groups it begins at once."""
    trigger = "".join(f"<ConditionGroup>{group}</ConditionGroup>" for group in groups)
    return (
        f'<Event name="{name}" priority="parallel" maximumExecutionCount="{count}"><Action name="{name} action">'
        f"<PrivateAction>{action}</PrivateAction></Action>"
        f"{f'<StartTrigger>{trigger}</StartTrigger>' if groups else ''}</Event>"
    )


def by_time(value: str | float, *, rule: str = "greaterOrEqual", delay: float = 0.0) -> str:
    """Return a condition on the time."""
    return (
        f'<Condition name="time" delay="{delay}" conditionEdge="none"><ByValueCondition>'
        f'<SimulationTimeCondition value="{value}" rule="{rule}"/></ByValueCondition></Condition>'
    )


def by_entity(entity: str, condition: str, *, delay: float = 0.0, edge: str = "none") -> str:
    """Return a condition on an entity."""
    return (
        f'<Condition name="entity" delay="{delay}" conditionEdge="{edge}"><ByEntityCondition>'
        f'<TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="{entity}"/></TriggeringEntities>'
        f"<EntityCondition>{condition}</EntityCondition></ByEntityCondition></Condition>"
    )


def document(
    starts: str,
    events: str = "",
    *,
    parameters: str = "",
    catalogues: str = "",
    bodies: str = "",
    stop: str = "",
    map_file: str = "road.xodr",
) -> str:
    """Return a document with the entities Ego and Target; `events` are those of Target."""
    entities = bodies or "".join(
        f'<ScenarioObject name="{name}">{VEHICLE.format(name=name.lower())}</ScenarioObject>'
        for name in ("Ego", "Target")
    )
    maneuver = f'<Maneuver name="maneuver">{events}</Maneuver>' if events else ""
    return f"""<?xml version="1.0"?>
<OpenSCENARIO><FileHeader revMajor="1" revMinor="3" date="2026-01-01T00:00:00" description="test" author="SSAD"/>
<ParameterDeclarations>{parameters}</ParameterDeclarations><CatalogLocations>{catalogues}</CatalogLocations>
<RoadNetwork><LogicFile filepath="{map_file}"/></RoadNetwork>
<Entities>{entities}</Entities>
<Storyboard><Init><Actions>{starts}</Actions></Init><Story name="story"><Act name="act">
<ManeuverGroup name="group" maximumExecutionCount="1"><Actors selectTriggeringEntities="false">
<EntityRef entityRef="Target"/></Actors>{maneuver}</ManeuverGroup>
<StartTrigger><ConditionGroup>{by_time(0)}</ConditionGroup></StartTrigger></Act></Story>
<StopTrigger>{f"<ConditionGroup>{stop}</ConditionGroup>" if stop else ""}</StopTrigger></Storyboard></OpenSCENARIO>
"""


def write(folder: Path, text: str, *, name: str = "test.xosc", lanes: int = 2) -> Path:
    """Write a document with the road beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "road.xodr").write_text(road(lanes))
    path = folder / name
    path.write_text(text)
    return path
