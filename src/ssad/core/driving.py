"""The seams of the closed loop: simulators, what they tell about their state, and the drivers that act in them.

A class need not inherit from a protocol: it is enough that it has these attributes and methods. A package offers its
drivers by name through entry points, and `ssad list` shows them; without a package, a name of the form
"module:object" is imported from the working folder:

    [project.entry-points."ssad.systems"]
    careful = "my_package.driver:Careful"

    ssad run quick --set systems=[careful,my_driver:Driver]

Shape letters: B scenes, A agents of a scene (agent 0 is the ego), N rows of what a driver sees, R points of all routes,
L lanes of all towns, S signals of a town. Units are metres, seconds and radians. The world frame is right-handed (x
east, y north, z up); an agent's frame is x forward, y left.

What every implementation owes its callers: a result must not depend on which scenes share its batch, nor on the order
in which batches come; and what is random comes from `ssad.core.seeding` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, F64, I32, U8, AgentKind, Bool, Controller, Episode

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
    """Where everybody is and how the egos fare: plain arrays that any simulator can fill.

    They may be views that hold until the next step; whoever keeps them makes copies.

    Attributes:
        time: [B] s since the episode began.
        pose: [B, A, 3] x, y, yaw of the centre of the body.
        speed: [B, A] m/s along the heading, negative in reverse.
        accel: [B, A] m/s^2 along the heading.
        active: [B, A] whether somebody is there.
        kind: [B, A] `ssad.core.types.AgentKind`; NONE: an empty slot.
        size: [B, A, 2] length and width, m.
        control: [B, A, 4] throttle, brake, steer and reverse of the last step.
        controller: [B, A] `ssad.core.types.Controller`: who drives now.
        policy: [B, A] number of the driver that acts for the agent, -1 none.
        target_speed: [B, A] m/s that an agent should drive at where nothing hinders it.
        touch: [B, A] int64, agents touched now: one bit an agent.
        lane: [B, A] lane under the centre, -1 off the road.
        route: [B, A, 2] first point of the agent's route in `roads` and number of points; 0 points: it has none.
        progress: [B, A] nearest point of the route, counted from its first.
        roads: Routes and lanes.
        signals: Gives `signal`, when somebody asks for it.
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
        note: [B, A] what a selector has noted on an agent (`Choice.note`), 0 at the start; None in a simulator that
            keeps no notes.
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

    @cached_property
    def signal(self) -> U8:
        """`ssad.core.types.SignalState` [B, S] of the signals of each scene's town; S of the town with most."""
        return self.signals()


class LaneRelation(IntEnum):
    """Where another agent's lane lies, as seen from the agent that looks."""

    ELSEWHERE = 0
    SAME = 1
    LEFT = 2
    RIGHT = 3
    ROUTE = 4  # on a lane that its route takes within the next 60 m


@dataclass(frozen=True)
class Observation:
    """What a driver sees at one step: N agents that it drives, in scenes of their own or together in one.

    The arrays are copies; to change them changes nothing in the world.

    Attributes:
        scene: [N] scene of each row.
        agent: [N] agent of each row; 0 is the ego.
        time: [N] s since the episode began.
        speed: [N] m/s along the agent's heading, negative in reverse.
        accel: [N] m/s^2 along the agent's heading.
        pose: [N, 3] x, y, yaw of the agent in the world frame.
        target_speed: [N] m/s that the agent should drive at where nothing hinders it.
        route: [N, 40, 2] the next 40 m of the route in the agent's frame, a point a metre; past its end the last point
            is repeated. Without a route: straight on.
        lane_offset: [N] m from the route to the agent, positive to the left.
        heading_error: [N] rad from the route's heading to the agent's, positive where the agent points further left.
        others: [N, 16, 7] the agents within 60 m, nearest first, in the agent's frame: x, y, yaw, speed along their own
            heading, length, width, and kind (`ssad.core.types.AgentKind`). Rows that are not needed are 0, kind too.
        others_lane: [N, 16] `LaneRelation` of these agents.
        signal: [N, 2] state of the next signal on the route (`ssad.core.types.SignalState`) and metres to its stop
            line. Without a signal: 0 (off) and 1e6.
        done: [N] whether the episode has ended; the control is then ignored.
        readings: What the sensors that the driver asked for show, [N, ...] each; `truth` a `Belief` of N rows. Each is
            read when it is first looked up, which must be before the driver returns.
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
    readings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Belief:
    """What the Autopilot plans over: K others around each ego, in the world frame, as a perceiver sees them.

    Pose, speed, size and kind are enough. What is None is made up from them: an object drives on along the lane under
    it, straight on where lanes part, at its speed; walkers, and who is on no lane that goes its way, move straight on;
    vehicles are relied on to give way, walkers and things are not.

    Attributes:
        pose: [B, K, 3] x, y, yaw of the centre of the body.
        speed: [B, K] m/s along its heading, negative in reverse.
        size: [B, K, 2] length and width, m.
        kind: [B, K] `ssad.core.types.AgentKind`; NONE: the row is not used, and its other values do not count.
        forecast: [B, K, 8, 3] x, y, yaw where it will be in 0.5, 1, ... 4 s.
        way: [B, K, 4] m from its centre to where it would wait (the stop line before it, or the junction) and to the
            next junction (0 inside; 1e6: none), how it turns there (0 straight, 1 right, 2 left; 3 more with a stop or
            yield sign), and m that its path ahead leaves the straight line along its heading.
        line_signal: [B, K] signal of the stop line before it, -1 none.
        stood: [B, K] s that it has been at rest while wanting to go. None: as long as earlier beliefs have had somebody
            at rest where it is.
        gives_way: [B, K] whether it can be relied on to give way to those who go first.
        change: [B, K, 2] turn signal of a lane change (1 left, -1 right, 0 none), and 1 while it passes somebody on an
            oncoming lane. None: nobody changes lane.
        height: [B, K] m, of the road under it: who is on, or below, a bridge does not count. None: of the lane under
            it; NaN: not known.
        signal: [B, S] `ssad.core.types.SignalState` of the signals of the scene's town, -1: as it is. None: all as
            they are.
        stop_sign: [B] 1 if it knows of the stop sign that it comes to next, 0 if it does not and drives on. Where the
            map has none, nothing makes it stop. None: it knows all signs of the map.
    """

    pose: F32
    speed: F32
    size: F32
    kind: I32
    forecast: F32 | None = None
    way: F32 | None = None
    line_signal: I32 | None = None
    stood: F32 | None = None
    gives_way: Bool | None = None
    change: I32 | None = None
    height: F32 | None = None
    signal: npt.NDArray[np.int8] | None = None
    stop_sign: U8 | None = None

    def keep(self, mask: Bool) -> Self:
        """Forget objects.

        Args:
            mask: [B, K] those that stay.

        Returns:
            The same belief without the others.
        """
        return replace(self, kind=np.where(mask, self.kind, np.int32(AgentKind.NONE)))

    def rows(self, scenes: Scenes) -> Self:
        """Pick scenes.

        Args:
            scenes: N of them.

        Returns:
            The belief of these scenes, [N, K]; its arrays are copies.
        """
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        which = np.asarray(scenes, np.int64)
        return replace(self, **{name: value[which] for name, value in given.items() if value is not None})


@runtime_checkable
class Driver(Protocol):
    """What drives an agent, ten times a second: the ego, or any other vehicle, cyclist or walker.

    A driver that has an attribute `target_speed` (m/s) drives at that speed instead of the episode's; one that has an
    attribute `sensors` (names) finds their readings in `Observation.readings`. A short class may leave out `name` and
    `controller`: `ssad.drivers.make_system` fills them in. `ssad.world.check.check_driver` holds an implementation to
    what is said here.

    Attributes:
        name: What tables call it.
        controller: EXTERNAL: `act` is called at each step. AUTOPILOT and FOLLOW run inside the world, and `act` is
            never called.

    Example:
        A driver that brakes for what is ahead and steers for a point 6 m down its route::

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
        """Forget the past; called once before each batch.

        Args:
            episodes: The B episodes that are driven next; `Observation.scene` counts them.
        """

    def act(self, view: Observation) -> F32:
        """Choose the controls of all agents that it drives, for the next step.

        Args:
            view: What these N agents see now. A driver of one agent number gets one row a scene, in order; one that
                takes agents over gets a row for each that it drives at this moment.

        Returns:
            [N, 3] throttle in [0, 1], brake in [0, 1] and steer in [-1, 1] (left positive, 1: wheels at full lock).
            With a fourth column, the throttle drives in reverse where that is above 0.5. A walker's throttle is its
            speed as a share of 4 m/s, and its steer turns it by up to half a turn a second. A value that is not
            finite in a running episode fails the episode.
        """


@runtime_checkable
class Believer(Protocol):
    """A driver of egos whose controller is AUTOPILOT: what it believes goes into the Autopilot's planner.

    It works in simulators that are a `Planner`.
    """

    def believe(self, view: Observation) -> Belief:
        """Say what is around the egos, before each step.

        Args:
            view: What the N egos see now, one row a scene, in order. The sensor `truth` shows a `Belief` [N, K] that
                holds everybody, with all that the Autopilot of the background traffic knows of them.

        Returns:
            The belief [N, K] of each row; K may change from step to step. Rows of ended episodes do not count.
        """


@runtime_checkable
class Planner(Protocol):
    """A simulator whose Autopilot plans over a belief."""

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Hand in what egos believe; it is in force until the next one, or until the scene starts again.

        Args:
            belief: [B, K]. None: the truth again.
            scenes: [B] whose egos believe it; None: all.

        Raises:
            ConfigError: An array is of another shape, or a number that counts is not finite.
        """

    def truth(self) -> Belief:
        """Tell the truth as a belief: handed in as it is, nobody drives otherwise.

        Returns:
            [B, A]; row i is agent i, and the row of the ego itself is not used.
        """


@runtime_checkable
class Simulator(Protocol):
    """A place where episodes run, B scenes at once.

    `ssad.world.check.check_simulator` holds an implementation to this.

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
        """The number of the episode that each scene runs, [B]."""

    @property
    def graphs(self) -> Mapping[str, LaneGraph]:
        """The lane graph of each town that the episodes name."""

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Start scenes again; everybody is driven by what the episode says.

        Args:
            scenes: Numbers of the scenes; None: all of them.
            episodes: For each of these scenes the number of the episode that it runs from now on; None: the same again.

        Raises:
            ConfigError: There is no such episode.
        """

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by `dt`; those that have ended stay as they are.

        Args:
            controls: [B, A, 3] or [B, A, 4] as `Driver.act` returns them; agents whose controller is not EXTERNAL
                ignore theirs. None: the last ones again.

        Raises:
            ConfigError: The controls are of another shape, or not finite.
        """

    def state(self) -> WorldState:
        """Tell where everybody is.

        Returns:
            The state of all scenes, ended ones too.
        """

    def ended(self) -> I32:
        """Tell which scenes have ended.

        Returns:
            [B] 0 while an episode runs, else why it ended, an index into `ssad.core.types.ENDS`.
        """

    def take(
        self, agents: Bool, controller: Controller | None, *, policy: int = -1, target_speed: float | None = None
    ) -> None:
        """Let somebody else drive agents from now on, until they are given back or the scene starts again.

        Args:
            agents: [B, A] whom. Who sleeps wakes up.
            controller: Who drives; None gives them back to what their episode says.
            policy: Number of the driver, for who reads the state.
            target_speed: Their target speed from now on, m/s; None: as it is.

        Raises:
            ConfigError: The simulator has no such controller, or the mask is of another shape.
        """


@runtime_checkable
class Reproducible(Protocol):
    """A simulator in which what happens in a scene depends on its episode and its controls alone, to the bit."""

    def snapshot(self) -> Any:
        """Keep all that changes.

        Returns:
            What `restore` of the same simulator takes.
        """

    def restore(self, snapshot: Any) -> None:
        """Go on from an earlier moment, to the bit.

        Args:
            snapshot: What `snapshot` returned.

        Raises:
            ConfigError: The snapshot is of a simulator of another size.
        """

    def hashes(self) -> list[str]:
        """Sum up the state.

        Returns:
            B texts over all that changes in a scene, whatever its place in the batch: equal where scenes are equal to
            the bit.
        """


@dataclass(frozen=True)
class Choice:
    """What a selector with a memory decides at one step; its memory is in the simulator, with the rest of the state.

    Attributes:
        agents: [B, A] whom its driver drives at the next step.
        note: [B, A] what it finds in `WorldState.note` at the step after.
        remove: [B, A] who leaves the scene.
    """

    agents: Bool
    note: I32
    remove: Bool


@runtime_checkable
class NoteKeeper(Protocol):
    """A simulator that keeps notes of selectors on agents, in its snapshots and hashes, until a scene starts again."""

    def keep_note(self, note: I32) -> None:
        """Keep a note on every agent.

        Args:
            note: [B, A].
        """

    def remove(self, agents: Bool) -> None:
        """Take agents out of their scenes, until these start again.

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
"""Pictures [N, C, H, W]."""

Generators = Sequence[np.random.Generator]
"""Random numbers, a generator for each picture."""


class Perturbation(Protocol):
    """What changes the pictures that a driver gets, the same open loop and closed loop."""

    def apply(self, frames: Frames, victim: Any, truth: Any, generators: Generators) -> Frames:
        """Change pictures.

        Args:
            frames: [N, C, H, W].
            victim: Who looks at them: a driver or a detector.
            truth: What is true at that moment: in the loop a `WorldState`.
            generators: One for each picture, so that none depends on its batch.

        Returns:
            [N, C, H, W].
        """
