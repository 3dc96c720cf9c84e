"""Interfaces of the closed loop: simulators, their state, and the drivers that act in them.

A class need not inherit from a protocol: having its attributes and methods is enough. A package offers its drivers by
name through entry points, and `ssad list` shows them; without a package, a name of the form "module:object" is
imported from the working folder:

    [project.entry-points."ssad.systems"]
    careful = "my_package.driver:Careful"

    ssad run quick --set systems=[careful,my_driver:Driver]

Shape letters: B scenes, A agents of a scene (agent 0 is the ego), N rows of an observation, R points of all routes,
L lanes of all towns, S signals of a town. Units are metres, seconds and radians. The world frame is right-handed (x
east, y north, z up); an agent's frame is x forward, y left.

Requirements on every implementation: a result must not depend on the scenes that share its batch, nor on the order of
batches; all randomness comes from `ssad.core.seeding`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, F64, I8, I32, U8, AgentKind, Bool, Controller, Episode

Scenes = Sequence[int] | npt.NDArray[np.integer[Any]]


@dataclass(frozen=True)
class RoadTables:
    """Routes and lanes of all scenes; they do not change while episodes run.

    Attributes:
        path: [R, 4] x, y, yaw and curvature of route points, one a metre.
        rule: [R, 4] speed cap m/s, metres to the next stop line and to the next junction (0 inside; 1e6: none), and how
            the route turns there.
        signal: [R] signal of the next stop line, -1 none.
        lane: [R] lane of the point, -1 none.
        left: [L] lane on the left of a lane as seen in its own direction, -1 none.
        right: [L] lane on its right.
        side: [L] 1 or -1, the sign of its OpenDRIVE id: lanes of a road that go the same way have the same.
        junction: [L] whether it lies inside a junction.
    """

    path: F32
    rule: F32
    signal: I32
    lane: I32
    left: I32
    right: I32
    side: I32
    junction: Bool


@dataclass(frozen=True)
class WorldState:
    """Positions of all agents and progress of the egos: plain arrays that any simulator can fill.

    They may be views that are valid until the next step; copy them to keep them.

    Attributes:
        time: [B] s since the episode began.
        pose: [B, A, 3] x, y, yaw of the centre of the body.
        speed: [B, A] m/s along the heading, negative in reverse.
        accel: [B, A] m/s^2 along the heading.
        active: [B, A] whether the agent is present.
        kind: [B, A] `ssad.core.types.AgentKind`; NONE: an empty slot.
        size: [B, A, 2] length and width, m.
        control: [B, A, 4] throttle, brake, steer and reverse of the last step.
        controller: [B, A] `ssad.core.types.Controller` that drives now.
        policy: [B, A] number of the driver that acts for the agent, -1 none.
        target_speed: [B, A] desired speed of the agent on a free road, m/s.
        touch: [B, A] int64, agents touched now: one bit an agent.
        lane: [B, A] lane under the centre, -1 off the road.
        route: [B, A, 2] first point of the agent's route in `roads` and number of points; 0 points: no route.
        progress: [B, A] nearest point of the route, counted from its first.
        roads: Routes and lanes.
        signals: Function that returns `signal`, called on first use.
        contact: [B] `ssad.core.types.Contact` bits of the ego's contacts that began in this step.
        contact_agent: [B] agent that the ego touched first in this step, -1 none.
        off_road: [B] whether the ego's centre is off the road.
        route_distance: [B] m from the ego to the rest of its route.
        route_point: [B] the point of its route that this is measured from.
        route_complete: [B] percent.
        driven: [B] m.
        lane_invasion: [B] lane markings crossed in this step.
        red_light: [B] red lights run in this step.
        stop_sign: [B] stop signs run in this step; None in a world without stop signs.
        note: [B, A] note of a selector on an agent (`Choice.note`), 0 at the start; None in a simulator without
            notes.
        turn_signals: Function that returns `turn_signal`, called on first use; None in a simulator without turn
            signals.
    """

    time: F64
    pose: F32
    speed: F32
    accel: F32
    active: Bool
    kind: I32
    size: F32
    control: F32
    controller: I32
    policy: I32
    target_speed: F32
    touch: npt.NDArray[np.int64]
    lane: I32
    route: I32
    progress: I32
    roads: RoadTables
    signals: Callable[[], U8]
    contact: U8
    contact_agent: I32
    off_road: Bool
    route_distance: F32
    route_point: I32
    route_complete: F32
    driven: F32
    lane_invasion: U8
    red_light: U8
    stop_sign: U8 | None = None
    note: I32 | None = None
    turn_signals: Callable[[], I8] | None = None

    @cached_property
    def signal(self) -> U8:
        """`ssad.core.types.SignalState` [B, S] of the signals of each scene's town; S of the town with most."""
        return self.signals()

    @cached_property
    def turn_signal(self) -> I8:
        """`ssad.core.types.TurnSignal` [B, A]: of Autopilots before and in lane changes and turns; of others 0."""
        if self.turn_signals is None:
            return np.zeros(self.speed.shape, np.int8)
        return self.turn_signals()


class LaneRelation(IntEnum):
    """Position of another agent's lane relative to the observing agent."""

    ELSEWHERE = 0
    SAME = 1
    LEFT = 2
    RIGHT = 3
    ROUTE = 4  # on a lane that its route takes within the next 60 m


@dataclass(frozen=True)
class Observation:
    """Input of a driver at one step: N agents that it drives, each in a scene of its own or several in one scene.

    The arrays are copies; changing them does not change the world.

    Attributes:
        scene: [N] scene of each row.
        agent: [N] agent of each row; 0 is the ego.
        time: [N] s since the episode began.
        speed: [N] m/s along the agent's heading, negative in reverse.
        accel: [N] m/s^2 along the agent's heading.
        pose: [N, 3] x, y, yaw of the agent in the world frame.
        target_speed: [N] desired speed of the agent on a free road, m/s.
        route: [N, 40, 2] the next 40 m of the route in the agent's frame, a point a metre; beyond its end the
            last point is repeated. Without a route: straight on.
        lane_offset: [N] m from the route to the agent, positive to the left.
        heading_error: [N] rad from the route's heading to the agent's, positive where the agent points further
            left.
        others: [N, 16, 7] the agents within 60 m, nearest first, in the agent's frame: x, y, yaw, speed along
            their own heading, length, width, and kind (`ssad.core.types.AgentKind`). Unused rows are 0, kind too.
        others_lane: [N, 16] `LaneRelation` of these agents.
        signal: [N, 2] state of the next signal on the route (`ssad.core.types.SignalState`) and metres to its
            stop line. Without a signal: 0 (off) and 1e6.
        done: [N] whether the episode has ended; the control is then ignored.
        others_turn_signal: [N, 16] `ssad.core.types.TurnSignal` of the agents in `others`; None: not known.
        readings: Readings of the driver's sensors by name, [N, ...] each; `truth` is a `Belief` of N rows. Each
            is read on first access, which must be before the driver returns.
    """

    scene: I32
    agent: I32
    time: F32
    speed: F32
    accel: F32
    pose: F32
    target_speed: F32
    route: F32
    lane_offset: F32
    heading_error: F32
    others: F32
    others_lane: U8
    signal: F32
    done: Bool
    others_turn_signal: I8 | None = None
    readings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Belief:
    """Input of the Autopilot's planner: K other objects around each ego, in the world frame, as perceived.

    Pose, speed, size and kind are enough. Missing fields are derived from them: an object drives on along the
    lane under it, straight on at forks, at its speed; walkers, and objects on no lane in their direction, move
    straight on; vehicles are assumed to give way, walkers and static objects are not.

    Attributes:
        pose: [B, K, 3] x, y, yaw of the centre of the body.
        speed: [B, K] m/s along its heading, negative in reverse.
        size: [B, K, 2] length and width, m.
        kind: [B, K] `ssad.core.types.AgentKind`; NONE: the row is unused, and its other values do not count.
        forecast: [B, K, 8, 3] predicted x, y, yaw in 0.5, 1, ... 4 s.
        way: [B, K, 4] m from its centre to its waiting point (the stop line before it, or the junction) and to
            the next junction (0 inside; 1e6: none), its turn there (0 straight, 1 right, 2 left; 3 more with a
            stop or yield sign), and m until its path leaves the straight line along its heading.
        line_signal: [B, K] signal of the stop line before it, -1 none.
        standing_time: [B, K] s that it has been at rest while wanting to go. None: derived from earlier beliefs with an
            object at rest in its place.
        gives_way: [B, K] whether it is expected to give way to those with priority.
        change: [B, K, 2] turn signal of a lane change (1 left, -1 right, 0 none), and 1 while it overtakes on an
            oncoming lane. None: no lane changes.
        height: [B, K] m, of the road under it; objects on or below a bridge do not count. None: height of the
            lane under it; NaN: unknown.
        signal: [B, S] `ssad.core.types.SignalState` of the signals of the scene's town, -1: true state. None: all
            true.
        stop_sign: [B] 1 if the ego knows of the next stop sign, 0 if not and it drives on. Without a sign in the
            map, nothing makes it stop. None: all signs of the map are known.
    """

    pose: F32
    speed: F32
    size: F32
    kind: I32
    forecast: F32 | None = None
    way: F32 | None = None
    line_signal: I32 | None = None
    standing_time: F32 | None = None
    gives_way: Bool | None = None
    change: I32 | None = None
    height: F32 | None = None
    signal: npt.NDArray[np.int8] | None = None
    stop_sign: U8 | None = None

    def keep(self, mask: Bool) -> Self:
        """Remove objects.

        Args:
            mask: [B, K] objects to keep.

        Returns:
            The same belief without the others.
        """
        return replace(self, kind=np.where(mask, self.kind, np.int32(AgentKind.NONE)))

    def rows(self, scenes: Scenes) -> Self:
        """Select scenes.

        Args:
            scenes: N scene numbers.

        Returns:
            The belief of these scenes, [N, K]; its arrays are copies.
        """
        field_values = {belief_field.name: getattr(self, belief_field.name) for belief_field in fields(self)}
        scene_index = np.asarray(scenes, np.int64)
        return replace(self, **{name: value[scene_index] for name, value in field_values.items() if value is not None})


@runtime_checkable
class Driver(Protocol):
    """Controls an agent ten times a second: the ego, or any other vehicle, cyclist or walker.

    A driver with an attribute `target_speed` (m/s) drives at that speed instead of the episode's; one with an
    attribute `period` (s, a whole fraction of 0.1) is asked that often, and refused by simulators with longer steps;
    one with an attribute `sensors` (names) gets their readings in `Observation.readings`; one with the methods of
    `Branching` can be measured by splitting and importance sampling. A minimal class may omit `name` and
    `controller`: `ssad.drivers.make_system` fills them in. `ssad.world.check.check_driver` tests an implementation
    against this protocol.

    Attributes:
        name: Name in tables.
        controller: EXTERNAL: `act` is called at each step. AUTOPILOT and FOLLOW run inside the world, and `act`
            is never called.

    Example:
        A driver that brakes for objects ahead and steers for a point 6 m down its route::

            class Careful:
                def reset(self, episodes): ...

                def act(self, view):
                    x, y, kind = (view.others[..., k] for k in (0, 1, 6))
                    brake = ((kind > 0) & (x > 0) & (x < 15) & (abs(y) < 2)).any(1)
                    throttle = (view.speed < view.target_speed) & ~brake
                    steer = np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0])
                    return np.stack([throttle, brake, np.clip(1.5 * steer, -1, 1)], 1).astype(np.float32)
    """

    name: str
    controller: Controller

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Discard all memory; called once before each batch.

        Args:
            episodes: The B episodes that are driven next; `Observation.scene` counts them.
        """

    def act(self, view: Observation) -> F32:
        """Choose the controls of all driven agents for the next step.

        Args:
            view: Observations of these N agents. A driver of one agent number gets one row a scene, in order; one
                that takes agents over gets a row for each agent that it drives at this moment.

        Returns:
            [N, 3] throttle in [0, 1], brake in [0, 1] and steer in [-1, 1] (left positive, 1: wheels at full lock).
            With a fourth column, the throttle drives in reverse where that is above 0.5. A walker's throttle is its
            speed as a share of 4 m/s, and its steer turns it by up to half a turn a second. A value that is not
            finite in a running episode fails the episode.
        """


@runtime_checkable
class Branching(Protocol):
    """A driver whose episodes can branch: all that it remembers can be saved and set, episode by episode. Optional.

    Splitting and importance sampling (`ssad.world.rare`) continue an episode in several ways: they copy the state of
    one episode of a batch to others, which may be at other steps. All episodes of such a batch are the same but for
    their seeds. A driver that remembers nothing returns an empty mapping. A driver that runs inside the world needs
    neither method.

    Example:
        A driver that counts its steps, an episode each::

            def reset(self, episodes):
                self.count = np.zeros(len(episodes), int)

            def snapshot(self):
                return {"count": self.count}

            def restore(self, states):
                self.count = states["count"]
    """

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return all that `act` depends on besides its argument.

        Returns:
            Arrays [B, ...] by name; row b belongs to episode b of the last `reset`. Names, shapes and types stay the
            same from `reset` to `reset`, and no array holds objects. The caller copies what it keeps. Random numbers
            belong to it too: the state of a generator, or a seed.
        """

    def restore(self, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from earlier moments, to the bit.

        Args:
            states: Arrays [B, ...] as `snapshot` returns them. Row b is the new state of episode b, from any moment
                of any episode of the batch. The driver may keep the arrays and change them.
        """


@runtime_checkable
class Believer(Protocol):
    """A driver of egos whose controller is AUTOPILOT: its belief is the input of the Autopilot's planner.

    It works in every `BeliefSimulator`.
    """

    def believe(self, view: Observation) -> Belief:
        """Return the perceived surroundings of the egos, before each step.

        Args:
            view: Observations of the N egos, one row a scene, in order. The sensor `truth` reads a `Belief` [N, K] of
                all agents, with all that the Autopilot of the background traffic knows of them.

        Returns:
            The belief [N, K] of each row; K may change from step to step. Rows of ended episodes do not count.
        """


@runtime_checkable
class BeliefSimulator(Protocol):
    """Simulator whose Autopilot plans over a belief."""

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Set the belief of egos; it holds until the next call, or until the scene starts again.

        Args:
            belief: [B, K]. None: the truth again.
            scenes: [B] scenes whose egos it applies to; None: all.

        Raises:
            ConfigError: An array is of another shape, or a used number is not finite.
        """

    def truth(self) -> Belief:
        """Return the truth as a belief: passed to `believe` unchanged, it changes no motion.

        Returns:
            [B, A]; row i is agent i, and the row of the ego itself is not used.
        """


@runtime_checkable
class Simulator(Protocol):
    """Runs episodes, B scenes at once.

    `ssad.world.check.check_simulator` tests an implementation against this protocol.

    Attributes:
        dt: Seconds of a step.
        batch: Number of scenes B.
        agents: Number of agents A that a scene has room for; agent 0 is the ego.
        episodes: The episodes that scenes can run.
    """

    dt: float
    batch: int
    agents: int
    episodes: tuple[Episode, ...]

    @property
    def assigned(self) -> I32:
        """Number of the episode that each scene runs, [B]."""

    @property
    def graphs(self) -> Mapping[str, LaneGraph]:
        """Lane graph of each town that the episodes name."""

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Start scenes again; every agent gets the driver of its episode.

        Args:
            scenes: Numbers of the scenes; None: all of them.
            episodes: Number of the next episode of each of these scenes; None: the same again.

        Raises:
            ConfigError: There is no such episode.
        """

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by `dt`; ended scenes do not change.

        Args:
            controls: [B, A, 3] or [B, A, 4] as `Driver.act` returns them; agents whose controller is not EXTERNAL
                ignore theirs. None: the last ones again.

        Raises:
            ConfigError: The controls are of another shape, or not finite.
        """

    def state(self) -> WorldState:
        """Return the positions of all agents and the progress of the egos.

        Returns:
            The state of all scenes, ended ones too.
        """

    def ended(self) -> I32:
        """Return which scenes have ended.

        Returns:
            [B] 0 while an episode runs, else the reason of its end, an index into `ssad.core.types.ENDS`.
        """

    def take(
        self, agents: Bool, controller: Controller | None, *, policy: int = -1, target_speed: float | None = None
    ) -> None:
        """Change the controller of agents, until they are given back or the scene starts again.

        Args:
            agents: [B, A] agents to take over. Sleeping ones wake up.
            controller: New controller; None gives them back to that of their episode.
            policy: Number of the driver, for readers of the state.
            target_speed: Their target speed from now on, m/s; None: unchanged.

        Raises:
            ConfigError: The simulator has no such controller, or the mask is of another shape.
        """


@runtime_checkable
class Reproducible(Protocol):
    """A simulator in which a scene depends on its episode and its controls alone, to the bit."""

    def snapshot(self) -> Any:
        """Save all changing state.

        Returns:
            An argument for `restore` of the same simulator.
        """

    def restore(self, snapshot: Any) -> None:
        """Continue from an earlier moment, to the bit.

        Args:
            snapshot: Result of `snapshot`.

        Raises:
            ConfigError: The snapshot is of a simulator of another size.
        """

    def hashes(self) -> list[str]:
        """Hash the state of each scene.

        Returns:
            B texts over all that changes in a scene, independent of its place in the batch: equal where scenes are
            equal to the bit.
        """


@dataclass(frozen=True)
class Choice:
    """Decision of a selector with memory at one step; the simulator stores the memory with the rest of its state.

    Attributes:
        agents: [B, A] agents that the selector's driver drives at the next step.
        note: [B, A] value of `WorldState.note` at the step after.
        remove: [B, A] agents that leave the scene.
    """

    agents: Bool
    note: I32
    remove: Bool


@runtime_checkable
class NoteKeeper(Protocol):
    """A simulator that stores selectors' notes on agents, in its snapshots and hashes, until a scene starts again."""

    def keep_note(self, note: I32) -> None:
        """Store a note on every agent.

        Args:
            note: [B, A].
        """

    def remove(self, agents: Bool) -> None:
        """Remove agents from their scenes, until these start again.

        Args:
            agents: [B, A].
        """


Selector = Callable[[WorldState], Bool | Choice]
"""Whom a driver drives at the next step: from the state to [B, A]. It decides from the state alone; one that has to
remember something says so with a `Choice`, in a simulator that is a `NoteKeeper`."""

Policies = Callable[[str], Driver]
"""The driver of a name that an episode gives to an agent (`ssad.core.types.Actor.policy`), a new one at each call."""

Sensor = Callable[[Any, I32], Any]
"""From a simulator and agents [N, 2] (scene, agent) to readings [N, ...]; pictures are [N, C, H, W].

One that also has a method `follow`, which takes the simulator, is told of every step, also where nobody looks."""


Frames = npt.NDArray[Any]
"""Images [N, C, H, W]."""

Generators = Sequence[np.random.Generator]
"""Random numbers, one generator for each row of a reading."""


@runtime_checkable
class ReadingChange(Protocol):
    """Changes the readings of a sensor before a driver or a detector receives them."""

    def apply(self, readings: Any, victim: Any, truth: Any, generators: Generators) -> Any:
        """Return the changed readings.

        Args:
            readings: [N, ...] of one sensor; images are uint8 [N, C, H, W].
            victim: The driver or detector that receives them.
            truth: Truth of that moment: in the loop a `WorldState`, of a recording a `RecordedMoment`; both have
                the field `time`, [N] s.
            generators: One for each row, so that no row depends on its batch.

        Returns:
            Readings of the same shape and type; the argument must not be changed.
        """


@runtime_checkable
class StateChange(Protocol):
    """Changes what an ego's driver knows of its own state: pose, speed, acceleration, route."""

    def observe(self, observation: Observation, generators: Generators) -> Observation:
        """Return the changed observation.

        Args:
            observation: Observation of N egos.
            generators: One for each of them, a new one at every step.

        Returns:
            Observation of the same N egos, such as `dataclasses.replace(observation, speed=...)`.
        """


@runtime_checkable
class CommandChange(Protocol):
    """Changes the commands of an ego's driver on their way to the vehicle."""

    def command(self, controls: F32, time: F32, generators: Generators) -> F32:
        """Return the changed commands.

        Args:
            controls: [N, 4] throttle, brake, steer and reverse of N egos, as `Driver.act` returns them.
            time: [N] s since their episodes began.
            generators: One for each of them, a new one at every step.

        Returns:
            [N, 4].
        """


@dataclass(frozen=True)
class LoopChanges:
    """Everything that a perturbation changes between the sensors of an ego, its driver and its vehicle.

    Attributes:
        readings: Change of each sensor's readings, by the name of the sensor.
        state: Changes of what the driver knows of its own state, in order.
        commands: Changes of its commands, in order.
    """

    readings: Mapping[str, ReadingChange] = field(default_factory=dict)
    state: Sequence[StateChange] = ()
    commands: Sequence[CommandChange] = ()


@runtime_checkable
class CommandedSimulator(Protocol):
    """A simulator whose step has two halves, so that the commands that it plans itself can be changed in between."""

    def set_controls(self, controls: npt.ArrayLike) -> None:
        """Set the commands of agents that are driven from outside, as `Simulator.step` takes them."""

    def plan(self) -> None:
        """Decide the commands of all agents that the simulator drives itself."""

    def planned_controls(self) -> F32:
        """Return the commands that were planned: [B, A, 4] throttle, brake, steer, reverse."""

    def set_planned_controls(self, controls: F32) -> None:
        """Replace the commands that were planned, [B, A, 4]."""

    def advance(self) -> None:
        """Move all agents by their commands."""


STEP = 0.1
"""Seconds between two states of a trace, and between two decisions of a driver without a `period`."""


def steps_per_trace_step(driver: Driver) -> int:
    """Return how often a driver is asked in a step of 0.1 s: once, or by its `period`.

    Raises:
        ConfigError: Its period does not divide 0.1 s.
    """
    period = float(getattr(driver, "period", STEP))
    count = round(STEP / period) if period > 0.0 else 0
    if count < 1 or abs(count * period - STEP) > 1e-6:
        raise ConfigError(f"system {driver.name}: its period is {period:g} s; it must divide {STEP} s, such as 0.05")
    return count


def step_options(count: int) -> dict[str, Any]:
    """Return the arguments of `World` for `count` steps in each of 0.1 s; none for one."""
    return {"dt": STEP / count, "substeps": 1} if count > 1 else {}


def with_finer_steps(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """Return episodes for a simulator with `count` steps in each of 0.1 s: their limits of steps are as much larger."""
    return [
        replace(episode, limits=replace(episode.limits, max_steps=episode.limits.max_steps * count))
        for episode in episodes
    ]
