"""The Autopilot over a belief: the truth through its door, what is hidden, missed or late, and what is made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssad.core.driving import Belief, BeliefSimulator, Believer
from ssad.core.errors import ConfigError
from ssad.core.traces import trace_hash
from ssad.core.types import ENDS, AgentKind, Controller, EpisodeAgent, Pose, SignalState
from ssad.drivers import make_system
from ssad.drivers.belief import DegradedBelief, LineOfSight
from ssad.drivers.builtin import Autopilot, Blind
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.belief import Lanes, rest_times
from ssad.world.roads import load_town
from ssad.world.rollout import Loop, rollout
from ssad.world.sensors import SENSORS
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


class Truth(Autopilot):
    """Hands in the truth."""

    sensors = ("truth",)

    def believe(self, view):
        return view.readings["truth"]


class Nothing(Autopilot):
    """Believes that nobody is there."""

    sensors = ("truth",)

    def believe(self, view):
        truth = view.readings["truth"]
        return truth.keep(np.zeros(truth.kind.shape, bool))


def natural(name: str = "natural", every: int = 1):
    """Episodes without walkers of natural traffic: what these are about to do, no belief says."""
    scenarios = load_scenarios(name)[::every]
    scenarios = [s if s.traffic is None else replace(s, traffic=replace(s.traffic, walkers=0)) for s in scenarios]
    graphs = {s.town: load_town(s.town) for s in scenarios}
    return [build_episode(s, graphs[s.town], seed=3) for s in scenarios], graphs


def hashes(episodes, graphs, driver, **more) -> list[str]:
    return [trace_hash(trace) for trace in rollout(World(episodes, graphs, **more), driver)]


def standing(x: float, *, y: float = 0.0, model: str = "car") -> EpisodeAgent:
    return EpisodeAgent(f"{model} at {x}", model, Controller.NONE, Pose(x, y, 0.0))


def alone(x: float = 10.0, speed: float = 8.0):
    return ego(x, speed, Controller.AUTOPILOT)


def _same_bits(every: int, sets: tuple[str, ...]) -> None:
    for name in sets:
        episodes, graphs = natural(name, every)
        told = hashes(episodes, graphs, Autopilot())
        assert hashes(episodes, graphs, Truth()) == told
        blind = hashes(episodes, graphs, Nothing())
        assert sum(a != b for a, b in zip(told, blind, strict=True)) > len(told) / 4  # the door is not painted on


def test_the_truth_handed_in_gives_the_same_bits() -> None:
    _same_bits(5, ("precrash", "natural"))


@pytest.mark.slow
def test_the_truth_handed_in_gives_the_same_bits_in_all_182_episodes() -> None:
    _same_bits(1, ("precrash", "natural"))


def test_the_truth_handed_in_fills_rows_with_the_truth() -> None:
    episodes, graphs = natural("precrash", 4)
    world = World(episodes, graphs, ego=Controller.AUTOPILOT)
    for _ in range(30):
        world.step()
    truth = world.truth()
    world.believe(truth)
    world.truth()  # looks anew
    used = truth.kind > 0
    assert used.sum() > 10
    assert (truth.standing_time[used] > 0.0).any()
    for name in ("kind", "pose", "speed", "half", "forecast", "span", "way", "signal", "waited", "gives_way"):
        rows = world.array(f"seen.{name}")
        believed = rows[:, world.agents : 2 * world.agents]
        assert np.array_equal(believed[used], rows[:, : world.agents][used]), name


def test_beliefs_do_not_depend_on_batch_or_order() -> None:
    episodes, graphs = natural("precrash", 4)
    count = len(episodes)

    def driver():
        return DegradedBelief(0.4, burst=8.0, noise=0.3, delay=2, believer=LineOfSight())

    told = hashes(episodes, graphs, driver())
    assert told != hashes(episodes, graphs, Autopilot())
    assert hashes(episodes, graphs, driver(), assign=np.arange(count)[::-1]) == told[::-1]
    assert hashes(episodes, graphs, driver(), assign=np.arange(3 * count) % count) == told * 3
    for k in (0, count - 1):
        # alone, and beside a wider scene that brings more slots
        assert hashes([episodes[k]], graphs, driver()) == [told[k]]


def test_line_of_sight_drives_as_if_what_is_hidden_were_not_there() -> None:
    """A parked bus hides a walker who steps out: the planner gets no row for it until it comes out."""
    bus = standing(30.0, y=-3.2, model="bus")
    walker = standing(37.0, y=-3.2, model="walker")
    world = World([episode(alone(), bus, walker)], GRAPHS)
    loop = Loop(world, {0: LineOfSight()})
    loop.reset()
    seen = []
    for _ in range(60):
        loop.step()
        kind = world.array("seen.kind")[0, world.agents :]
        seen.append((kind[1] != 0, kind[2] != 0, float(world.array("pose")[0, 0, 0])))
    assert all(there for there, _, _ in seen)
    hidden = [x for _, walks, x in seen if not walks]
    visible = [x for _, walks, x in seen if walks]
    assert hidden
    assert visible
    # eye at y = 0; the bus's near side at y = -1.95 ends at x = 35.1; the walker's nearest corner at y = -2.95
    comes_out = 35.135 - (36.75 - 35.135) / (2.95 - 1.95) * 1.95
    assert max(hidden) < comes_out + 1.6
    assert min(visible) > comes_out - 1.6


def test_who_misses_everything_drives_as_if_alone() -> None:
    crowd = [standing(60.0), standing(90.0, model="bus")]
    world_alone = World([episode(alone())], GRAPHS)
    reference = rollout(world_alone, Autopilot())[0]
    for driver in (DegradedBelief(1.0), Nothing()):
        trace = rollout(World([episode(alone(), *crowd)], GRAPHS), driver)[0]
        n = len(trace.x)
        assert trace.end == "collision"
        for name in ("x", "y", "yaw", "speed"):
            assert np.array_equal(getattr(trace, name)[:-1, 0], getattr(reference, name)[: n - 1, 0])
    assert rollout(World([episode(alone(), *crowd)], GRAPHS), DegradedBelief(0.0))[0].end != "collision"


def test_missed_objects_come_in_bursts_of_the_length_asked_for() -> None:
    driver = DegradedBelief(0.3, burst=6.0)
    scene = episode(alone(), *[standing(60.0 + 8 * k, y=40.0) for k in range(30)])
    world = World([scene], GRAPHS, ego=Controller.AUTOPILOT)
    truth = world.truth()
    driver.reset([scene])

    view = SimpleNamespace(scene=np.zeros(1, np.int32), readings={"truth": truth})
    missed = np.stack([driver.believe(view).kind[0, 1:] == 0 for _ in range(1500)])
    assert 0.27 < missed.mean() < 0.33
    begins = (missed[1:] & ~missed[:-1]).sum()
    assert 5.4 < missed.sum() / begins < 6.6


def test_a_delay_hands_in_what_was_true_then() -> None:
    lead = EpisodeAgent("lead", "car", Controller.FOLLOW, Pose(60.0, 0.0, 0.0), 5.0, 5.0, route=line_route(60.0, 300.0))
    world = World([episode(alone(), lead)], GRAPHS)
    loop = Loop(world, {0: DegradedBelief(0.0, delay=4)})
    loop.reset()
    true, told = [], []
    for _ in range(20):
        true.append(world.truth().pose[0, 1].copy())
        loop.step()
        told.append(world.array("seen.pose")[0, world.agents + 1].copy())
    assert np.array_equal(told[4:], true[:-4])
    assert np.array_equal(told[:4], [true[0]] * 4)
    assert not np.array_equal(told[10], true[10])


def test_noise_moves_an_object_and_its_forecast() -> None:
    scene = episode(alone(), standing(60.0))
    world = World([scene], GRAPHS)
    loop = Loop(world, {0: DegradedBelief(0.0, noise=0.5)})
    loop.reset()
    places = []
    for _ in range(100):
        loop.step()
        rows = world.agents + 1
        places.append(world.array("seen.pose")[0, rows, :2].copy())
        off = world.array("seen.forecast")[0, rows, :, :2] - places[-1]
        assert np.abs(off).max() < 1e-4  # it stands: its forecast stays with it
    assert 0.4 < np.std(np.array(places)[:, 1]) < 0.6


def test_a_snapshot_in_the_middle_goes_on_to_the_bit() -> None:
    episodes, graphs = natural("precrash", 8)
    world = World(episodes, graphs, ego=Controller.AUTOPILOT)
    for _ in range(10):
        world.step()
    ghost = world.truth()
    pose = ghost.pose.copy()
    pose[:, 1, :2] = world.array("pose")[:, 0, :2] + 12.0 * np.stack(
        [np.cos(world.array("pose")[:, 0, 2]), np.sin(world.array("pose")[:, 0, 2])], -1
    )
    world.believe(replace(ghost, pose=pose))
    kept, told = world.snapshot(), world.hashes()
    for _ in range(20):
        world.step()
    after = world.hashes()
    world.believe(None)
    other = World(episodes, graphs, ego=Controller.AUTOPILOT)
    for again in (world, other):
        again.restore(kept)
        assert again.hashes() == told
        for _ in range(20):
            again.step()
        assert again.hashes() == after
    # what is believed counts as state, and does something
    world.restore(kept)
    world.believe(None)
    assert world.hashes() != told
    for _ in range(20):
        world.step()
    assert world.hashes() != after
    world.restore(kept)
    world.reset()
    assert world.array("seen.believes").sum() == 0


def test_background_traffic_does_not_believe_what_the_ego_believes() -> None:
    follower = EpisodeAgent(
        "b", "car", Controller.AUTOPILOT, Pose(10.0, 0.0, 0.0), 8.0, 8.0, route=line_route(10.0, 300.0)
    )
    slow = replace(alone(40.0, 2.0), target_speed=2.0)
    world = World([episode(slow, follower, standing(80.0))], GRAPHS)
    world.believe(world.truth().keep(np.zeros((1, 3), bool)))
    for _ in range(250):
        world.step()
    assert world.ended()[0] == 1  # the ego drives into what it does not know of
    assert int(world.array("touch")[0, 1]) == 0  # who follows it brakes
    assert world.array("pose")[0, 1, 0] > 50.0


def test_a_believed_signal_holds_for_the_ego_alone() -> None:
    episodes, graphs = natural("natural", 10)
    count = max(len(g.signal_phase) for g in graphs.values())
    speed = {}
    for state in (SignalState.RED, SignalState.GREEN):
        world = World(episodes, graphs, ego=Controller.AUTOPILOT)
        for _ in range(100):
            lit = np.full((world.batch, count), state, np.int8)
            lit[[len(graphs[e.town].signal_phase) == 0 for e in episodes]] = -1
            world.believe(replace(world.truth(), signal=lit))
            world.step()
        speed[state] = world.array("travelled")[:, 0].sum()
    assert speed[SignalState.RED] < 0.9 * speed[SignalState.GREEN]


def bare(truth: Belief) -> Belief:
    return replace(truth, forecast=None, way=None, line_signal=None, standing_time=None, gives_way=None)


def test_what_is_left_open_is_made_up_from_the_lanes() -> None:
    """On the lane it follows it; who crosses, walks or stands off the road goes straight on."""
    agents = [
        replace(standing(60.0, y=0.5), speed=5.0),
        EpisodeAgent("across", "car", Controller.NONE, Pose(90.0, 0.0, 1.2), 5.0),
        EpisodeAgent("walker", "walker", Controller.NONE, Pose(120.0, 0.2, 0.3), 1.5),
        EpisodeAgent("oncoming", "car", Controller.NONE, Pose(150.0, 3.5, 3.0), 4.0),
    ]
    world = World([episode(alone(), *agents)], GRAPHS)
    world.believe(bare(world.truth()))
    forecast = world.array("seen.forecast")[0, world.agents :]
    ahead = 0.5 * np.arange(1, 9)
    assert np.allclose(forecast[1, :, 0], 60.0 + 5.0 * ahead, atol=1e-3)
    assert np.allclose(forecast[1, :, 1:], [0.5, 0.0], atol=1e-3)
    assert np.allclose(forecast[2, :, 0], 90.0 + 5.0 * ahead * np.cos(1.2), atol=1e-3)
    assert np.allclose(forecast[2, :, 2], 1.2, atol=1e-3)
    assert np.allclose(forecast[3, :, 1], 0.2 + 1.5 * ahead * np.sin(0.3), atol=1e-3)
    assert np.allclose(forecast[4, :, 0], 150.0 - 4.0 * ahead, atol=1e-3)
    assert np.allclose(forecast[4, :, 1], 3.5, atol=1e-3)
    assert np.allclose(np.cos(forecast[4, :, 2]), -1.0, atol=1e-3)
    assert world.array("seen.gives_way")[0, world.agents + 1 : world.agents + 5].tolist() == [1, 1, 0, 1]


class Bare(Autopilot):
    """The Autopilot over pose, speed, size and kind alone."""

    sensors = ("truth",)

    def believe(self, view):
        return bare(view.readings["truth"])


def test_how_long_somebody_has_stood_is_remembered_from_earlier_beliefs() -> None:
    """So that it is passed as early as by who is told."""
    parked = standing(80.0, model="compact")
    scene = episode(ego(speed=8.0, controller=Controller.AUTOPILOT), parked)
    ways = [rollout(World([scene], GRAPHS), driver)[0] for driver in (Autopilot(), Bare())]
    assert ways[0].end == ways[1].end == "complete"
    assert abs(len(ways[0].speed) - len(ways[1].speed)) <= 10  # steps of 0.1 s
    moved = {"pose": np.array([[[0.0, 0, 0], [5, 0, 0], [9, 0, 0]]]), "speed": np.array([[0.1, 0.0, 4.0]])}
    now = moved | {"kind": np.array([[1, 1, 1]])}
    before = now | {"pose": now["pose"] + [0.5, 0, 0], "waited": np.array([[2.0, 3.0, 4.0]])}
    before["kind"] = np.array([[1, 0, 1]])  # nobody was known of where the second is
    assert rest_times(now, before, np.array([0.5]))[0] == pytest.approx([2.5, 0.0, 0.0])


@pytest.mark.parametrize("driver", [Autopilot(), Bare()])
@pytest.mark.parametrize("height", [0.0, 6.0])
def test_who_is_on_a_bridge_is_neither_met_nor_touched(height: float, driver) -> None:
    road = GRAPHS["Straight"]
    xy, z, yaw, points = road.xy.copy(), road.z.copy(), road.yaw.copy(), road.points(1)
    xy[points] = np.stack([np.full(201, 100.0), np.arange(-100.0, 301.0, 2.0)], 1)
    z[points], yaw[points] = height, np.pi / 2
    north = replace(
        line_route(-60.0, 200.0),
        lane=np.ones(261, np.int32),
        yaw=np.full(261, np.pi / 2, np.float32),
        xy=np.stack([np.full(261, 100.0), np.arange(-60.0, 201.0)], 1).astype(np.float32),
    )
    other = ego(speed=8.0, controller=Controller.FOLLOW, name="other", pose=Pose(100.0, -60.0, np.pi / 2), route=north)
    world = World(
        [episode(ego(x=40.0, speed=8.0, controller=Controller.AUTOPILOT), other)],
        {"Straight": replace(road, xy=xy, z=z, yaw=yaw)},
    )
    speed = rollout(world, driver)[0].speed[:, 0]
    assert (speed[5:100].min() > 7.5) == (height > 0.0)
    assert world.ended()[0] == ENDS.index("complete")


def test_made_up_ways_are_those_of_the_routes_before_a_junction() -> None:
    """Wherever a route goes straight on, distances to line and junction match what the world knows.

    Drivers of the population are foreseen to gain speed where they start, which bare poses and speeds do not show.
    """
    episodes, graphs = natural("natural-uniform", 3)
    world = World(episodes, graphs, ego=Controller.AUTOPILOT)
    for _ in range(20):
        world.step()
    truth = world.truth()
    world.believe(bare(truth))
    used = truth.kind > 0
    made = world.array("seen.way")[:, world.agents : world.agents + truth.kind.shape[1]]
    near = used & (truth.way[..., 1] < 60.0) & (truth.way[..., 1] > 2.0)
    assert near.sum() > 50
    close = np.abs(made - truth.way)[near][:, :2] < 1.6
    assert close.all(1).mean() > 0.9
    straight = near & (truth.way[..., 2] % 3 == 0)
    off = np.abs(world.array("seen.forecast")[:, world.agents :][:, : used.shape[1]] - truth.forecast)[straight]
    assert np.quantile(off[..., :2].max((1, 2)), 0.7) < 1.5


def test_lanes_are_found_under_the_middle_of_a_lane() -> None:
    graph = load_town("Twinford")
    lanes = Lanes(graph)
    pick = [
        k for k in range(graph.lane_count) if graph.kind[k] == 1 and graph.junction[k] < 0 and graph.length[k] > 20
    ][:60]
    places = np.array([graph.at(k, float(graph.length[k]) / 2)[:3] for k in pick], np.float64)
    lane, s, left = lanes.match(places)
    assert lane.tolist() == pick
    assert np.allclose(s, graph.length[pick] / 2, atol=0.5)
    assert np.abs(left).max() < 0.3
    aside = places.copy()
    aside[:, :2] += 0.8 * np.stack([-np.sin(places[:, 2]), np.cos(places[:, 2])], 1)
    found = lanes.match(aside)
    assert np.allclose(found[2], 0.8, atol=0.3)
    near = lanes.follow(aside, np.full(len(pick), 0.2), *found)[:, 0]  # 0.1 m further on, as far aside as now
    assert np.abs(near[:, :2] - aside[:, :2]).max() < 0.3
    places[:, 2] += np.pi
    assert (lanes.match(places)[0] != np.array(pick)).all()  # not against its direction


def test_forecasts_show_no_more_than_can_be_seen() -> None:
    """Who keeps to its route is seen to follow it; who has left it turns on as it turns, wherever its route goes."""
    bent = line_route(60.0, 300.0)
    agents = [
        EpisodeAgent("on", "car", Controller.FOLLOW, Pose(60.0, 0.0, 0.1), 5.0, 5.0, route=bent),
        EpisodeAgent("off", "car", Controller.EXTERNAL, Pose(60.0, 30.0, 0.4), 5.0, 5.0, route=bent),
    ]
    world = World([episode(alone(), *agents)], GRAPHS)
    on, off = world.truth().forecast[0, 1:3]
    assert np.allclose(on[:, 1], 0.0, atol=1e-4)
    ahead = 2.5 * np.arange(1, 9)
    assert np.allclose(off[:, :2], np.stack([60.0 + ahead * np.cos(0.4), 30.0 + ahead * np.sin(0.4)], 1), atol=1e-3)
    controls = np.zeros((1, 3, 3), np.float32)
    controls[0, 2] = 0.05, 0.0, 0.1
    for _ in range(10):
        world.step(controls)
    turned = world.truth().forecast[0, 2, :, 2] - world.array("pose")[0, 2, 2]
    rate = (world.array("pose")[0, 2, 2] - world.array("previous")[0, 2, 2]) / 0.1
    assert rate > 0.05
    assert np.allclose(turned, np.minimum(rate * 0.5 * np.arange(1, 9), 1.57), rtol=0.02)


def test_bad_beliefs_are_refused_in_one_line() -> None:
    world = World([episode(alone(), standing(60.0))] * 2, GRAPHS)
    good = world.truth()
    pose = good.pose.copy()
    pose[1, 1, 0] = np.nan
    size = good.size.copy()
    size[0, 1] = 0.0
    cases = [
        (replace(good, kind=good.kind[:1]), "belief: kind has shape (1, 2); expected (2, K)"),
        (replace(good, speed=good.speed[:, :1]), "belief: speed has shape (2, 1); expected (2, 2)"),
        (replace(good, forecast=good.forecast[:, :, :4]), "belief: forecast has shape"),
        (replace(good, pose=pose), "belief: pose holds a number that is not finite"),
        (replace(good, size=size), "belief: size must be above 0 m"),
        (replace(good, kind=good.kind + 9), "belief: kind must be an AgentKind, 0 to 7"),
        (replace(good, signal=np.zeros((2, 5), np.int8)), "belief: signal has shape"),
        (replace(good, line_signal=good.line_signal + 99), "belief: line_signal must lie between"),
        (replace(good, stop_sign=np.array([1, 2], np.uint8)), "belief: stop_sign must be 1 (known) or 0"),
        (replace(good, stop_sign=np.array([1.0, np.nan])), "belief: stop_sign must be 1 (known) or 0"),
    ]
    for belief, message in cases:
        with pytest.raises(ConfigError) as error:
            world.believe(belief)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
    world.believe(replace(good, pose=pose), np.array([True, False]))  # rows of other scenes do not count
    assert world.array("seen.believes").tolist() == [1, 0]
    with pytest.raises(ConfigError, match="mask of scenes"):
        world.believe(good, np.ones(3, bool))
    with pytest.raises(ConfigError, match="missed in"):
        DegradedBelief(1.5)


def test_a_believer_drives_egos_alone_and_is_named_when_it_errs() -> None:
    class Wrong(Truth):
        name = "wrong"

        def believe(self, view):
            return replace(super().believe(view), speed=np.zeros(3, np.float32))

    class Outside(Truth):
        name = "outside"
        controller = Controller.EXTERNAL

    scene = episode(alone(), standing(60.0))
    assert isinstance(World([scene], GRAPHS), BeliefSimulator)
    with pytest.raises(ConfigError, match=r"system wrong: belief: speed has shape \(3,\)"):
        rollout(World([scene], GRAPHS), Wrong())
    with pytest.raises(ConfigError, match="outside has a belief, so its controller must be AUTOPILOT"):
        rollout(World([scene], GRAPHS), Outside())
    with pytest.raises(ConfigError, match="egos alone"):
        rollout(World([scene], GRAPHS), {1: Truth()})
    two = World([scene, scene], GRAPHS)
    assert SENSORS["truth"](two, np.array([[1, 0]], np.int32)).kind.tolist() == [[AgentKind.NONE, AgentKind.CAR]]
    with pytest.raises(ConfigError, match="is for egos"):
        SENSORS["truth"](two, np.array([[0, 1]], np.int32))
    assert isinstance(make_system("line-of-sight"), Believer)
    assert not isinstance(make_system("autopilot"), Believer)
    assert not isinstance(Blind(), Believer)
