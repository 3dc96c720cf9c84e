"""Bench2Drive's types: who takes part, what sets them off, in which order; each driven on a town that ships."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.leaderboard_routes import ROUTES, Route, flow, write_routes

from ssad.core.errors import FormatError
from ssad.core.import_report import ImportReport
from ssad.core.types import F64, Controller, EpisodeTrace, Scenario, SignalPlan
from ssad.drivers import make_system
from ssad.interchange.leaderboard import read_leaderboard
from ssad.interchange.leaderboard_types import TYPES, UNPLAYED
from ssad.scenarios.dynamic import build_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

BENCH2DRIVE = 44
FLOWS = (
    "CrossingBicycleFlow",
    "EnterActorFlow",
    "HighwayExit",
    "InterurbanActorFlow",
    "InterurbanAdvancedActorFlow",
    "InvadingTurn",
    "MergerIntoSlowTraffic",
    "MergerIntoSlowTrafficV2",
    "NonSignalizedJunctionLeftTurn",
    "NonSignalizedJunctionLeftTurnEnterFlow",
    "NonSignalizedJunctionRightTurn",
    "SignalizedJunctionLeftTurn",
    "SignalizedJunctionLeftTurnEnterFlow",
    "SignalizedJunctionRightTurn",
)
ALONE = ("SequentialLaneChange", "T_Junction", *(kind for kind in ROUTES if kind.startswith("Vanilla")))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Scenario, EpisodeTrace]]:
    """Type -> its scenario, and how the blind follower drives it when contacts are only counted."""
    report = ImportReport("routes")
    found = read_leaderboard(write_routes(tmp_path_factory.mktemp("types") / "routes.xml"), report=report)
    assert list(report.omissions) == ["speed of Accident"]
    assert not report.doubts
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in found]
    world = World(episodes, {e.town: load_town(e.town) for e in episodes})
    traces = rollout(world, make_system("blind"), policies=make_system)
    return {s.group: (s, trace) for s, trace in zip(found, traces, strict=True)}


def test_all_types_are_played_or_named(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    assert len(TYPES) + len(UNPLAYED) == BENCH2DRIVE
    assert not set(TYPES) & set(UNPLAYED)
    assert set(played) == set(TYPES) == set(ROUTES)
    for kind, (_, trace) in played.items():
        assert trace.driven[-1] > 15.0, kind


@pytest.mark.parametrize(
    ("kind", "bodies"),
    [
        ("Accident", "cone car compact compact"),
        ("BlockedIntersection", "*"),
        ("DynamicObjectCrossing", "walker vending_machine"),
        ("ConstructionObstacle", "cone barrier" + " cone" * 8),
        ("HardBreakRoute", "*"),
        ("HazardAtSideLane", "bicycle bicycle"),
        ("HighwayCutIn", "*"),
        ("OppositeVehicleRunningRedLight", "*"),
        ("OppositeVehicleTakingPriority", "*"),
        ("ParkedObstacle", "cone *"),
        ("ParkingCrossingPedestrian", "walker compact"),
        ("ParkingCutIn", "compact compact"),
        ("PedestrianCrossing", "walker walker walker"),
        ("StaticCutIn", "compact compact compact compact compact compact"),
        ("VehicleTurningRoute", "bicycle"),
        ("VehicleTurningRoutePedestrian", "walker"),
        ("YieldToEmergencyVehicle", "*"),
        *((kind, "") for kind in ALONE),
    ],
)
def test_who_takes_part(kind: str, bodies: str, played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """Models in order; * is any car."""
    told = [actor.model for actor in played[kind][0].actors]
    wanted = bodies.split()
    assert len(told) == len(wanted)
    assert all(
        a == b or (b == "*" and a in {"car", "compact", "coupe", "suv"}) for a, b in zip(told, wanted, strict=True)
    )


def begins(trace: EpisodeTrace, name: str) -> float:
    """Metres that the ego has driven when an actor begins to move; inf if it never does."""
    j = trace.names.index(name)
    moved = np.flatnonzero(np.hypot(trace.x[:, j] - trace.x[0, j], trace.y[:, j] - trace.y[0, j]) > 0.05)
    return float(trace.driven[moved[0]]) if len(moved) else np.inf


# where the ego is, m on its route, when somebody sets out: the place that they meet at less seconds times 8 m/s
@pytest.mark.parametrize(
    ("kind", "name", "metres"),
    [
        ("DynamicObjectCrossing", "walker", 10 + 43 - 8 * 2.2),
        ("ParkingCrossingPedestrian", "walker", 10 + 45 - 8 * 2.15),
        ("HazardAtSideLane", "cyclist 0", 10),
        ("HazardAtSideLane", "cyclist 1", 10),
        ("HazardAtSideLaneTwoWays", "cyclist 0", 10),
        ("ParkingCutIn", "adversary", 10 + 35 - 8 * 2.35),
        ("StaticCutIn", "adversary", 10 + 42 + 22 - 8 * 2.7),
        ("HardBreakRoute", "car ahead", 0),
    ],
)
def test_what_sets_them_off(
    kind: str, name: str, metres: float, played: dict[str, tuple[Scenario, EpisodeTrace]]
) -> None:
    assert begins(played[kind][1], name) == pytest.approx(metres, abs=4.0)


@pytest.mark.parametrize("kind", ["OppositeVehicleRunningRedLight", "OppositeVehicleTakingPriority"])
def test_a_car_comes_as_the_ego_does(kind: str, played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    scenario, trace = played[kind]
    assert 5.0 < begins(trace, "emergency car") < 40.0
    assert trace.end == "collision"
    assert scenario.signals == (SignalPlan("green", "red") if "Red" in kind else SignalPlan("off", "off"))


def test_a_car_is_braked_hard_and_goes_on(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """Only once the ego has come to the trigger, 20 m along."""
    trace = played["HardBreakRoute"][1]
    speed = trace.speed[:, 1]
    stops = int(np.flatnonzero(speed[4:] < speed[:-4] - 2.0)[0])  # in 0.4 s
    assert trace.driven[stops] == pytest.approx(20.0, abs=6.0)
    assert trace.end == "collision"


@pytest.mark.parametrize("speed", [3.0, 5.0])
def test_waits_begin_with_what_they_wait_for(speed: float, tmp_path: Path) -> None:
    """However late the ego comes: 10 s in which a car stands, and up to 1.5 s between walkers who wait for the ego."""
    kinds = ("BlockedIntersection", "HardBreakRoute", "PedestrianCrossing")
    found = read_leaderboard(write_routes(tmp_path / "routes.xml", kinds))
    free = [replace(s, target_speed=speed, limits=replace(s.limits, contact="count", max_steps=600)) for s in found]
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in free]
    world = World(episodes, {e.town: load_town(e.town) for e in episodes})
    take = np.arange(world.agents) == 0
    world.take(np.tile(take, (world.batch, 1)), Controller.FOLLOW, target_speed=speed)
    begun: list[dict[tuple[int, int], int]] = [{} for _ in found]
    for step in range(600):
        world.step()
        for b, row in enumerate(world.array("phase")):
            for agent, count in enumerate(row.tolist()):
                for phase in range(count):
                    begun[b].setdefault((agent, phase), step)
    blocked, ahead, people = begun
    assert blocked[1, 1] - blocked[1, 0] == 100
    assert ahead[1, 2] - ahead[1, 1] == 100
    first = {people[agent, 0] for agent in (1, 2, 3)}
    assert max(first) - min(first) <= 2
    idle = [phase.when.value for actor in found[2].actors for phase in actor.phases if phase.when.kind == "after"]
    assert len(idle) == 3
    assert max(idle) - min(idle) > 0.2
    for agent, wait in enumerate(idle, 1):
        assert 0.1 * (people[agent, 1] - people[agent, 0]) == pytest.approx(wait, abs=0.1)


def test_the_queue_stands(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """Of the six cars only the adversary moves, and into the ego's lane; of the parked ones as well."""
    for kind, stays in (("StaticCutIn", (0, 1, 3, 4, 5)), ("ParkingCutIn", (0,))):
        scenario, trace = played[kind]
        for number in stays:
            assert begins(trace, scenario.actors[number].name) == np.inf
        j = trace.names.index("adversary")
        lane = trace.route[0, 1]
        assert abs(trace.y[0, j] - lane) > 2.5
        assert abs(trace.y[-1, j] - lane) < (1.5 if trace.end == "collision" else 0.3)


def test_walkers_cross_before_the_junction(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """All three set out within 1.5 s, and walk to the other side."""
    _, trace = played["PedestrianCrossing"]
    at = [begins(trace, f"walker {k}") for k in range(3)]
    assert max(at) - min(at) <= 1.5 * 10.0 + 1.0
    assert trace.end == "collision"


@pytest.mark.parametrize("kind", FLOWS)
def test_flows(kind: str, played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """They come one after another at the gaps and the speed of the file, are there at the start, and leave."""
    scenario, _ = played[kind]
    told = ROUTES[kind].children
    speed = float(told.split('flow_speed value="')[1].split('"')[0]) if "flow_speed" in told else 8.0
    low, high = (
        (40.0, 40.0)
        if kind == "InvadingTurn"
        else [float(told.split(f'{key}="')[-1].split('"')[0]) for key in ("from", "to")]
    )
    flows: dict[tuple[float, float], list[F64]] = {}
    for actor in scenario.actors:
        if actor.trajectory:
            flows.setdefault((actor.pose.x, actor.pose.y), []).append(np.array(actor.trajectory))
    assert flows
    assert len(flows) == {"InterurbanAdvancedActorFlow": 2, "EnterActorFlow": 2}.get(kind, 1)
    for rows in flows.values():
        gaps = np.diff([row[0, 0] for row in rows]) * speed
        assert gaps.min() >= low - 0.1
        assert gaps.max() <= high + 0.1
        assert rows[0][0, 0] < 0.0 < rows[0][-1, 0]
        driven = np.hypot(*np.diff(rows[0][:, 1:3], axis=0).T) / np.diff(rows[0][:, 0])
        assert driven == pytest.approx(speed, rel=0.06)


def test_a_flow_is_in_the_ego_s_way(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """The way of each flow crosses the ego's, or joins it."""
    for kind in FLOWS:
        scenario, trace = played[kind]
        near = min(
            float(np.hypot(*(np.array(a.trajectory)[:, None, 1:3] - trace.route[None]).transpose(2, 0, 1)).min())
            for a in scenario.actors
            if a.trajectory
        )
        assert near < (4.0 if kind == "InvadingTurn" else 10.5), kind  # rows lie up to 20 m apart


def test_cars_invade_the_ego_s_lane(played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """By the offset of the file: a lane is 3.5 m wide, half a car is taken as 0.7 m."""
    scenario, trace = played["InvadingTurn"]
    y = np.concatenate([np.array(a.trajectory)[:, 2] for a in scenario.actors if a.trajectory])
    assert np.median(y - trace.route[0, 1]) == pytest.approx(1.75 + 0.7 - 0.25, abs=0.05)
    assert sum(a.model == "cone" for a in scenario.actors) == 7


@pytest.mark.parametrize("kind", ["AccidentTwoWays", "ConstructionObstacleTwoWays", "ParkedObstacleTwoWays"])
def test_oncoming_cars_come_after_the_ego(kind: str, played: dict[str, tuple[Scenario, EpisodeTrace]]) -> None:
    """They drive towards the ego in the lane that it needs, see it, and the first is not past it when it comes."""
    scenario, trace = played[kind]
    cars = [a for a in scenario.actors if a.policy]
    assert len(cars) >= 2
    assert all(a.policy == "autopilot" for a in cars)
    j = trace.names.index(cars[0].name)
    assert trace.x[-1, j] > trace.x[-1, 0]
    assert trace.x[-1, j] < trace.x[0, j] - 10.0
    gap = np.hypot(cars[0].pose.x - cars[1].pose.x, cars[0].pose.y - cars[1].pose.y)
    assert gap > 8.0


def test_polite_drivers_get_by(tmp_path: Path) -> None:
    """The stopped car goes on after the ego has come and waited; the emergency car presses from behind."""
    kinds = ("BlockedIntersection", "YieldToEmergencyVehicle", "HighwayCutIn", "VehicleTurningRoutePedestrian")
    found = read_leaderboard(write_routes(tmp_path / "routes.xml", kinds))
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in found]
    world = World(episodes, {e.town: load_town(e.town) for e in episodes})
    blocked, pressed, cut, walker = rollout(world, make_system("autopilot"), policies=make_system)
    assert [t.end for t in (blocked, pressed, cut, walker)] == ["complete"] * 4
    goes = int(np.argmax(np.hypot(blocked.x[:, 1] - blocked.x[0, 1], blocked.y[:, 1] - blocked.y[0, 1]) > 0.1))
    assert blocked.speed[goes, 0] < 0.1
    assert blocked.driven[goes] > 10.0
    behind = np.hypot(pressed.x[:, 0] - pressed.x[:, 1], pressed.y[:, 0] - pressed.y[:, 1])
    assert behind[0] == pytest.approx(27.0, abs=0.1)
    assert pressed.speed[:, 1].max() > pressed.speed[:, 0].max() + 1.0
    ahead = cut.x[:, 1] - cut.x[:, 0]
    together = np.abs(cut.y[:, 1] - cut.y[:, 0]) < 1.0
    assert together.any()
    assert 5.0 < ahead[int(np.argmax(together))] < 20.0
    assert walker.speed[30:, 0].min() < 1.0


@pytest.mark.parametrize(
    ("kind", "route", "message"),
    [
        ("AccidentTwoWays", Route("ProvingGround", ROUTES["Accident"].points), "needs an oncoming lane"),
        ("BlockedIntersection", ROUTES["Accident"], "passes no junction"),
        (
            "ParkedObstacle",
            Route("ProvingGround", ROUTES["Accident"].points, '<distance value="400"/>'),
            "the route ends",
        ),
        ("HighwayExit", Route("Longreach", ROUTES["HighwayExit"].points, ""), "has no start_actor_flow"),
        ("HighwayExit", ROUTES["HighwayExit"]._replace(children=flow((600.0, -9.4), (220.0, 7.625))), "its flow has"),
        ("T_Junction", Route("ProvingGround", ((217.0, -1.75), (219.0, 1.75))), "the lanes that join them"),
        ("SignalizedJunctionRightTurn", ROUTES["NonSignalizedJunctionLeftTurn"], "no lane comes into junction"),
    ],
)
def test_a_place_that_does_not_fit_is_named(kind: str, route: Route, message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=message):
        read_leaderboard(write_routes(tmp_path / "routes.xml", [kind], {kind: route}))
