"""The differentiable twin moves as the kernels do, and its gradients are those of finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError
from ssad.core.geometry import obb_distance
from ssad.core.types import EpisodeLimits, LaneType
from ssad.world.models import MODELS
from ssad.world.roads.library import load_town
from ssad.world.roads.query import LaneQuery
from ssad.world.twin import MotionState, RoadField, advance, bodies_of, box_gap, unroll
from ssad.world.world import World

from .worlds import GRAPHS, ego, episode, straight_graph

STEPS = 80
BOX = st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-3.1, 3.1), st.floats(0.4, 9), st.floats(0.4, 3))


def controls(seed: int, count: int) -> np.ndarray:
    """[STEPS, count, 4] of all kinds: pushed, braked, turned hard, in reverse, standing still, out of range."""
    draws = np.random.default_rng(seed)
    held = draws.uniform(-0.3, 1.3, (STEPS // 8, count, 4)).repeat(8, 0)
    held[..., 1] *= draws.random((STEPS // 8, count)).repeat(8, 0) < 0.4
    held[..., 2] = 2.2 * held[..., 2] - 1.1
    held[..., 3] = draws.random((STEPS // 8, count)).repeat(8, 0) < 0.25
    held[: STEPS // 8, ::2, 0] = 0.0  # some start by standing with turned wheels
    return held


def start(count: int, speed: np.ndarray, dtype: torch.dtype) -> MotionState:
    """On the road at x = 10."""
    pose = torch.tensor([[10.0, 0.0, 0.0]] * count, dtype=dtype)
    return MotionState(pose, torch.tensor(speed, dtype=dtype), torch.zeros(count, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("seed", "friction"), [(0, 0.9), (1, 0.4), (2, 0.9)])
def test_every_body_moves_as_in_the_world(seed: int, friction: float, dtype: torch.dtype) -> None:
    names = list(MODELS)
    speeds = np.where([MODELS[n].max_speed > 0 for n in names], np.linspace(0.0, 3.9, len(names)) * (seed > 0), 0.0)
    wide = EpisodeLimits(max_steps=10_000, max_time=1e6)
    cases = [
        episode(ego(model=name, speed=float(speed)), key=name, limits=wide, friction=friction)
        for name, speed in zip(names, speeds, strict=True)
    ]
    world = World(cases, GRAPHS)
    given_ = controls(seed, len(names)).astype(np.float32)
    poses, wheels = [world.array("pose")[:, 0].copy()], [world.array("wheel")[:, 0].copy()]
    for control in given_:
        actions = np.zeros((len(names), world.agents, 4), np.float32)
        actions[:, 0] = control
        world.step(actions)
        poses.append(world.array("pose")[:, 0].copy())
        wheels.append(world.array("wheel")[:, 0].copy())
    assert not world.ended().any()
    bodies = bodies_of(names, friction=friction, dtype=dtype)
    found = unroll(start(len(names), speeds, dtype), torch.tensor(given_, dtype=dtype), bodies)
    moved = np.array(poses)
    apart = np.abs(found.pose.numpy() - moved)
    apart[..., 2] = np.abs((apart[..., 2] + np.pi) % (2 * np.pi) - np.pi)
    assert apart.max() < 1e-4
    assert np.abs(found.wheel.numpy() - np.array(wheels)).max() < 1e-5
    assert (np.abs(moved[-1] - moved[0]).max(-1)[[MODELS[n].max_speed > 0 for n in names]] > 0.5).all()


def test_gradients_of_a_whole_motion_equal_finite_differences() -> None:
    names = ["car", "bus", "bicycle", "walker"]
    bodies = bodies_of(names, dtype=torch.float64)
    draws = torch.Generator().manual_seed(3)
    # within the limits: at a cut there are two slopes
    throttle = 0.3 + 0.4 * torch.rand((STEPS, 4, 1), generator=draws, dtype=torch.float64)
    steer = 0.12 * torch.rand((STEPS, 4, 1), generator=draws, dtype=torch.float64) - 0.06
    flat = torch.cat([throttle, torch.zeros_like(throttle), steer, torch.zeros_like(throttle)], -1)
    initial = start(4, np.array([3.0, 3.0, 3.0, 1.0]), torch.float64)
    weight = torch.rand((4, 3), generator=draws, dtype=torch.float64)

    def goal(values: torch.Tensor) -> torch.Tensor:
        return (unroll(initial, values, bodies).pose[-1] * weight).sum()

    asked = flat.clone().requires_grad_()
    goal(asked).backward()
    gradient = asked.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    for place in [(0, 0, 0), (0, 0, 2), (10, 1, 0), (40, 1, 2), (60, 2, 0), (70, 2, 2), (0, 3, 0), (79, 0, 0)]:
        beside = [flat.clone() for _ in range(2)]
        beside[0][place] += 1e-5
        beside[1][place] -= 1e-5
        slope = float(goal(beside[0]) - goal(beside[1])) / 2e-5
        assert float(gradient[place]) == pytest.approx(slope, rel=1e-5, abs=1e-7), place
    assert (gradient[:40, :3, 2].abs() > 1e-3).all()  # steering early moves the end


@pytest.mark.parametrize("substeps", [1, 2])
def test_gradients_hold_where_limits_cut(substeps: int) -> None:
    """Brakes to a standstill, wheels that lag behind, sliding, reverse; at places with a single slope."""
    names = ["car", "truck", "bicycle", "walker", "barrier"]
    bodies, draws = bodies_of(names, dtype=torch.float64), np.random.default_rng(substeps)
    values = torch.from_numpy(controls(7, len(names)))
    initial = start(len(names), np.array([9.0, 6.0, 3.0, 1.0, 0.0]), torch.float64)
    weight = torch.from_numpy(draws.standard_normal((STEPS + 1, len(names), 3)))

    def goal(at: torch.Tensor) -> torch.Tensor:
        states = unroll(initial, at, bodies, dt=0.25, substeps=substeps)
        return (states.pose * weight).sum() + (states.speed + states.wheel).mul(weight[..., 0]).sum()

    asked = values.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(goal(asked), asked)
    checked = 0
    for place in zip(*(draws.integers(n, size=120).tolist() for n in (STEPS, len(names), 3)), strict=True):
        slopes = []
        for change in (-1e-6, 1e-6):
            beside = values.clone()
            beside[place] += change
            slopes.append(float(goal(beside) - goal(values)) / change)
        if slopes[0] == pytest.approx(slopes[1], rel=1e-3, abs=1e-3):
            assert float(gradient[place]) == pytest.approx(sum(slopes) / 2, rel=2e-3, abs=2e-3), place
            checked += abs(float(gradient[place])) > 0.01
    assert checked > 30


@pytest.mark.parametrize("names", [["car", "truck", "bicycle"], ["car", "walker", "barrier"]])
def test_one_control_moves_many_agents_and_many_states_share_their_bodies(names: list[str]) -> None:
    bodies = bodies_of(names, dtype=torch.float64)
    one = torch.from_numpy(controls(4, 3))
    initial = start(3, np.array([4.0, 1.0, 0.0]), torch.float64)
    many = MotionState(*(torch.stack([part, part + 0.5]) for part in initial))
    for own in (one[:, 0], one[:, :1], one[:, None, :1]):  # all do the same
        whole = own.reshape(STEPS, 1, 1, 4).expand(STEPS, 2, 3, 4)
        for found, told in zip(unroll(many, own, bodies), unroll(many, whole, bodies), strict=True):
            assert torch.equal(found, told)
    shared = unroll(many, one, bodies)  # what each does, in two scenes
    for scene in range(2):
        alone = unroll(MotionState(*(part[scene] for part in many)), one, bodies)
        assert all(torch.equal(found[:, scene], told) for found, told in zip(shared, alone, strict=True))
    assert advance(many, one[0, 0], bodies).speed.shape == (2, 3)


@pytest.mark.parametrize(("brake", "slope"), [(0.0, 0.4), (0.5, 0.025)])
def test_a_speed_from_a_standstill_lasts_unless_it_is_braked(brake: float, slope: float) -> None:
    bodies = bodies_of(["car"], dtype=torch.float64)
    speed = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    initial = MotionState(torch.zeros(1, 3, dtype=torch.float64), speed, torch.zeros(1, dtype=torch.float64))
    end = unroll(initial, torch.tensor([[[0.0, brake, 0.0, 0.0]]] * 4, dtype=torch.float64), bodies).pose[-1, 0, 0]
    assert float(torch.autograd.grad(end, speed)[0]) == pytest.approx(slope)


@settings(max_examples=200, deadline=None)
@given(first=BOX, second=BOX)
def test_gap_of_boxes_is_their_distance_and_below_zero_where_they_overlap(first: tuple, second: tuple) -> None:
    a, b = (torch.tensor(box, dtype=torch.float64) for box in (first, second))
    gap, reference = float(box_gap(a, b)), float(obb_distance(first, second))
    assert max(gap, 0.0) == pytest.approx(reference, abs=1e-9)
    assert gap == pytest.approx(float(box_gap(b, a)), abs=1e-9)


def test_gap_of_boxes_known_by_hand() -> None:
    here = torch.tensor([0.0, 0.0, 0.0, 4.0, 2.0], dtype=torch.float64)
    beside = torch.tensor(
        [[6.0, 0.0, 0.0, 4.0, 2.0], [3.5, 0.0, 0.0, 4.0, 2.0], [5.0, 6.0, np.pi / 2, 2.0, 2.0], [0.0] * 3 + [4.0, 2.0]],
        dtype=torch.float64,
    )
    np.testing.assert_allclose(box_gap(here, beside).numpy(), [2.0, -0.5, np.hypot(2.0, 4.0), -2.0], atol=1e-12)
    boxes = torch.tensor([[5.0, 3.0, 0.4, 4.0, 2.0], [2.2, 1.0, 0.7, 4.0, 2.0]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: box_gap(here, x), boxes.requires_grad_())


@pytest.fixture(scope="module")
def field() -> RoadField:
    """Of a town with bends and junctions."""
    return RoadField(load_town("Larkhill"))


def test_on_the_road_is_what_the_query_says(field: RoadField) -> None:
    graph = load_town("Larkhill")
    draws = np.random.default_rng(0)
    points = graph.xy[draws.integers(len(graph.xy), size=3000)] + draws.normal(0, 4, (3000, 2))
    points = points.astype(np.float32)
    nearest = LaneQuery(graph).nearest(points)
    gap = field(torch.from_numpy(points).double()).numpy()
    sure = np.abs(gap) > 1e-4
    assert ((gap <= 0) == nearest.is_inside)[sure].all()
    assert sure.mean() > 0.99
    assert 0.1 < nearest.is_inside.mean() < 0.9


def test_distance_from_the_road_has_a_gradient_and_reaches_far(field: RoadField) -> None:
    box = torch.tensor(load_town("Larkhill").xy.min(0) - 50.0, dtype=torch.float64)
    point = box.clone().requires_grad_()
    field(point).backward()
    value = float(field(box))
    assert value > 60.0
    assert point.grad is not None
    assert float(point.grad.norm()) == pytest.approx(1.0, abs=0.05)
    assert float(field(point.detach() - 2.0 * point.grad)) == pytest.approx(value - 2.0, abs=0.1)
    near = torch.tensor(load_town("Larkhill").xy[::400] + 7.3, dtype=torch.float64)
    assert torch.autograd.gradcheck(field, near.requires_grad_())


def test_corners_tell_how_far_a_body_leaves_the_road() -> None:
    straight = RoadField(GRAPHS["Straight"])
    body = torch.tensor([[50.0, 0.0, 0.0, 4.0, 2.0], [50.0, -1.75, 0.0, 4.0, 2.0]], dtype=torch.float64)
    np.testing.assert_allclose(straight.of_boxes(body).numpy(), [-0.75, 1.0], atol=1e-6)


def test_a_lane_that_widens_is_wider_in_between() -> None:
    graph = straight_graph()
    width = graph.width.copy()
    width[:5] = [3.0, 3.2, 3.2, 3.2, 3.2]  # at x = 0, 2, 4 ...
    field = RoadField(replace(graph, width=width), [LaneType.DRIVING])
    places = torch.tensor([[0.5, -3.0], [1.0, -3.0], [5.0, -3.0]], dtype=torch.float64)
    np.testing.assert_allclose(field(places).numpy(), [1.475, 1.45, 1.4], atol=1e-6)


def test_one_state_and_many_controls_are_broadcast() -> None:
    bodies = bodies_of(["car"])
    one = start(1, np.array([5.0]), torch.float32)
    many = torch.zeros(4, 3, 1, 4)
    many[:, 1, :, 0] = 1.0
    found = unroll(one, many, bodies)
    assert found.pose.shape == (5, 3, 1, 3)
    assert float(found.speed[-1, 1, 0]) > float(found.speed[-1, 0, 0]) == 5.0


def test_a_step_of_no_length_is_refused() -> None:
    state = start(1, np.zeros(1), torch.float32)
    for wrong in ({"dt": 0.0}, {"substeps": 0}):
        with pytest.raises(ConfigError, match="dt > 0"):
            advance(state, torch.zeros(1, 4), bodies_of(["car"]), **wrong)
