"""Simulation loop: drivers act for agents of a simulator step by step, and the outcome is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import (
    BeliefSimulator,
    Believer,
    Choice,
    CommandedSimulator,
    Driver,
    LoopChanges,
    NoteKeeper,
    Observation,
    Policies,
    ReadingChange,
    Scenes,
    Selector,
    Sensor,
    Simulator,
    WorldState,
)
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import ENDS, F32, I32, AgentKind, Bool, Controller, End, Episode, EpisodeTrace, Route
from ssad.world.models import agent_model
from ssad.world.observation import observe
from ssad.world.sensors import SENSORS

Drivers = Mapping[int | Selector, Driver]
Changes = LoopChanges | ReadingChange | Mapping[str, ReadingChange]
"""Changes of a loop: of readings, own state and commands; of all images; or of the readings of the named sensors."""
_AGENT = ("x", "y", "yaw", "speed", "active")


class Loop:
    """Drivers acting in a simulator.

    A restored snapshot of the simulator continues bit-exactly if the drivers keep no state, or theirs is restored too
    (`ssad.core.driving.Branching`).

    Args:
        simulator: The simulator.
        drivers: Driver by agent number, or by a selector that chooses at every step the agents that its driver
            controls; agents that it no longer chooses are returned. Agents without a driver follow their episode.
        sensors: Sensors in addition to `ssad.world.sensors`; only requested ones are computed.
        perturbation: Changes between sensors, drivers and vehicles. A mapping changes the readings of the sensors it
            names; a single change applies to all images ([N, C, H, W]).
        policies: Makes the drivers that episodes name (`EpisodeAgent.policy`); `drivers` take precedence.

    Raises:
        ConfigError: A driver does not fit the simulator or requests an unknown sensor, `policies` is missing, or the
            simulator lets nobody change the commands that it plans.
    """

    def __init__(
        self,
        simulator: Simulator,
        drivers: Drivers,
        *,
        sensors: Mapping[str, Sensor] | None = None,
        perturbation: Changes | None = None,
        policies: Policies | None = None,
    ) -> None:
        self.simulator = simulator
        self.drivers = list(drivers.items())
        for name in sorted({agent.policy for episode in simulator.episodes for agent in episode.agents} - {""}):
            if policies is None:
                raise ConfigError(
                    f"an actor follows the policy '{name}': say who makes drivers, policies=ssad.make_system"
                )
            self.drivers.append((_PolicySelector(simulator, name, len(self.drivers)), policies(name)))
        self.sensors = SENSORS | dict(sensors or {})
        self._image_change = None if isinstance(perturbation, LoopChanges | Mapping | None) else perturbation
        if isinstance(perturbation, LoopChanges):
            self._changes = perturbation
        else:
            self._changes = LoopChanges(perturbation if isinstance(perturbation, Mapping) else {})
        if self._changes.commands and not isinstance(simulator, CommandedSimulator):
            raise ConfigError(
                f"{type(simulator).__name__} plans and moves in one step: its commands cannot be changed; use World"
            )
        shape = (simulator.batch, simulator.agents)
        for target, driver in self.drivers:
            if isinstance(target, int) and not 0 <= target < simulator.agents:
                raise ConfigError(f"driver {driver.name}: there is no agent {target}; scenes have {simulator.agents}")
            if isinstance(driver, Believer):
                _check_believer(simulator, target, driver)
            _check_period(simulator, driver)
            for name in getattr(driver, "sensors", ()):
                if name not in self.sensors:
                    available = ", ".join(self.sensors)
                    raise ConfigError(f"driver {driver.name} asks for sensor '{name}'; known: {available}")
        # sensors that remember follow every step, also while nobody looks
        requested = {name for _, driver in self.drivers for name in getattr(driver, "sensors", ())}
        following = (getattr(self.sensors[name], "follow", None) for name in sorted(requested))
        self._following = [follow for follow in following if follow is not None]
        self._controls = np.zeros((*shape, 4), np.float32)
        self._fixed = [
            np.stack([np.arange(shape[0]), np.full(shape[0], target)], 1).astype(np.int32)
            if isinstance(target, int)
            else None
            for target, _ in self.drivers
        ]

    def reset(
        self, scenes: Scenes | None = None, *, episodes: Scenes | None = None, seeds: Sequence[int] | None = None
    ) -> None:
        """Restart scenes (default: all) as `Simulator.reset` does, and assign the drivers there.

        Drivers forget the past only when all scenes restart.

        Args:
            scenes: Numbers of the scenes; None: all.
            episodes: Number of the next episode of each of these scenes; None: the same again.
            seeds: [B] seeds of the episodes that drivers are given, so that scenes of one episode differ in what
                drivers draw; None: those of the episodes.
        """
        simulator = self.simulator
        simulator.reset(scenes, episodes=episodes)
        is_started = np.full(simulator.batch, scenes is None)
        if scenes is not None:
            is_started[np.asarray(scenes)] = True
        for policy, (target, driver) in enumerate(self.drivers):
            if isinstance(target, int):
                self._assign_policy(policy, (np.arange(simulator.agents) == target) & is_started[:, None])
            if (driver.controller == Controller.EXTERNAL or isinstance(driver, Believer)) and scenes is None:
                episodes_by_scene = [simulator.episodes[episode_index] for episode_index in simulator.assigned]
                if seeds is not None:
                    episodes_by_scene = [
                        replace(episode, seed=seed) for episode, seed in zip(episodes_by_scene, seeds, strict=True)
                    ]
                driver.reset(episodes_by_scene)

    def _assign_policy(self, policy: int, mask: npt.NDArray[np.bool_]) -> None:
        driver = self.drivers[policy][1]
        speed = getattr(driver, "target_speed", None)
        self.simulator.take(mask, driver.controller, policy=policy, target_speed=speed)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance all scenes by one step.

        Args:
            controls: [B, A, 3|4] for agents that no driver acts for.

        Raises:
            ConfigError: A driver returned controls of a wrong shape or not finite. Its own exceptions propagate.
        """
        if not self.drivers:
            self.simulator.step(controls)
            return
        self._controls[:] = 0.0
        if controls is not None:
            values = np.asarray(controls, np.float32)
            self._controls[..., : values.shape[-1]] = values
        has_controls = controls is not None
        for follow in self._following:
            follow(self.simulator)
        state: WorldState | None = None
        for policy, (target, driver) in enumerate(self.drivers):
            agents = self._fixed[policy]
            external = driver.controller == Controller.EXTERNAL
            if agents is None or external or isinstance(driver, Believer):
                # A takeover changes controllers in place, which the next drivers must observe.
                state = self.simulator.state() if state is None else state
            if agents is None and not isinstance(target, int):
                assert state is not None
                selected, state = self._choose(target, state)
                # An ended scene keeps its last state, so no agent of it changes hands.
                selected = selected & (self.simulator.ended() == End.RUNNING)[:, None]
                current = state.policy == policy
                if (selected != current).any():
                    if (current & ~selected).any():
                        self.simulator.take(current & ~selected, None)
                    if (selected & ~current).any():
                        self._assign_policy(policy, selected & ~current)
                    state = self.simulator.state()
                agents = np.argwhere(selected).astype(np.int32)
            if external and agents is not None and len(agents):
                assert state is not None
                has_controls = True
                values = self._act(driver, state, agents)
                self._controls[agents[:, 0], agents[:, 1], : values.shape[1]] = values
            if isinstance(driver, Believer) and agents is not None:
                assert state is not None
                self._believe(driver, state, agents)
        if self._changes.commands:
            self._step_with_changed_commands(has_controls)
        else:
            self.simulator.step(self._controls if has_controls else None)

    def _step_with_changed_commands(self, has_controls: bool) -> None:
        """Advance all scenes by one step in which the commands of the egos are changed on their way."""
        simulator = self.simulator
        assert isinstance(simulator, CommandedSimulator)
        egos = np.stack([np.arange(simulator.batch), np.zeros(simulator.batch, int)], 1).astype(np.int32)
        state = simulator.state()
        simulator.plan()
        planned = simulator.planned_controls()
        is_external = simulator.state().controller[:, 0] == Controller.EXTERNAL
        controls = np.where(is_external[:, None], self._controls[:, 0], planned[:, 0]).astype(np.float32)
        for number, change in enumerate(self._changes.commands):
            generators = self._generators(("command", number), state, egos)
            controls = np.asarray(change.command(controls, state.time.astype(np.float32), generators), np.float32)
            if controls.shape != (simulator.batch, 4) or not np.isfinite(controls).all():
                raise ConfigError(
                    f"{type(change).__name__}.command returned shape {controls.shape} or a number that is not finite; "
                    f"expected ({simulator.batch}, 4) finite numbers: throttle, brake, steer, reverse"
                )
        planned[:, 0] = controls
        simulator.set_planned_controls(planned)
        if has_controls or is_external.any():
            self._controls[:, 0] = np.where(is_external[:, None], controls, self._controls[:, 0])
            simulator.set_controls(self._controls)
        simulator.advance()

    def _choose(self, selector: Selector, state: WorldState) -> tuple[Bool, WorldState]:
        """Whom a selector chooses [B, A], and the state after it has noted what it remembers and removed whom it does.

        Raises ConfigError if it remembers something and the simulator keeps no notes.
        """
        choice = selector(state)
        if not isinstance(choice, Choice):
            return np.asarray(choice, bool), state
        if not isinstance(self.simulator, NoteKeeper):
            raise ConfigError("a selector keeps notes on agents, which this simulator does not")
        self.simulator.keep_note(choice.note)
        if choice.remove.any():
            self.simulator.remove(choice.remove)
            state = self.simulator.state()
        return np.asarray(choice.agents, bool), state

    def _believe(self, driver: Driver, state: WorldState, egos: I32) -> None:
        """Pass the driver's belief to the planner; ended scenes keep their previous one."""
        assert isinstance(driver, Believer)
        assert isinstance(self.simulator, BeliefSimulator)
        ended = self.simulator.ended() != End.RUNNING
        readings = self._readings(driver, state, egos)
        belief = driver.believe(self._observe(state, egos, ended, readings))
        readings.close()
        try:
            self.simulator.believe(belief, ~ended)
        except ConfigError as error:
            raise ConfigError(f"system {driver.name}: {error}") from None

    def _act(self, driver: Driver, state: WorldState, agents: I32) -> F32:
        """Return the controls [N, 3|4] of the agents; 0 where the episode has ended."""
        ended = self.simulator.ended() != End.RUNNING
        readings = self._readings(driver, state, agents)
        controls = np.asarray(driver.act(self._observe(state, agents, ended, readings)), np.float32)
        readings.close()
        if controls.ndim != 2 or controls.shape[0] != len(agents) or controls.shape[1] not in (3, 4):
            raise ConfigError(
                f"system {driver.name}: act returned shape {controls.shape}, expected ({len(agents)}, 3): "
                "throttle, brake, steer"
            )
        running = ~ended[agents[:, 0]]
        if not np.isfinite(controls[running]).all():
            raise ConfigError(f"system {driver.name}: act returned a control that is not finite")
        return np.where(running[:, None], controls, np.float32(0.0))

    def _readings(self, driver: Driver, state: WorldState, agents: I32) -> _Readings:
        names = tuple(getattr(driver, "sensors", ()))
        return _Readings(names, lambda name: self._read(name, driver, state, agents))

    def _observe(self, state: WorldState, agents: I32, ended: Bool, readings: _Readings) -> Observation:
        """Return the observation of agents; egos know of their own state only what the changes leave."""
        observation = observe(state, agents, ended, readings)
        if self._changes.state and not agents[:, 1].any():
            for number, change in enumerate(self._changes.state):
                observation = change.observe(observation, self._generators(("state", number), state, agents))
        return observation

    def _read(self, name: str, driver: Driver, state: WorldState, agents: I32) -> Any:
        reading = self.sensors[name](self.simulator, agents)
        change = self._changes.readings.get(name)
        if change is None:
            # A change that names no sensor is one of images, and only they have four dimensions.
            if self._image_change is None or getattr(reading, "ndim", 0) != 4:
                return reading
            change = self._image_change
        generators = self._generators((name,), state, agents)
        if hasattr(reading, "cpu"):  # images that stayed on a device
            reading = reading.cpu().numpy()
        return change.apply(reading, driver, state, generators)

    def _generators(self, purpose: tuple[object, ...], state: WorldState, agents: I32) -> list[np.random.Generator]:
        """Return a generator for each agent, seeded by what it is for: no result depends on the batch."""
        episodes, assigned = self.simulator.episodes, self.simulator.assigned
        generators = []
        for scene, agent in agents.tolist():
            episode, step = episodes[assigned[scene]], round(float(state.time[scene]) / self.simulator.dt)
            generators.append(generator("perturbation", episode.key, episode.seed, *purpose, agent, step))
        return generators


class _Readings(Mapping[str, Any]):
    """Lazily read sensors: an unused camera renders nothing."""

    def __init__(self, names: tuple[str, ...], read: Callable[[str], Any]) -> None:
        self._names, self._read, self._cached_readings = names, read, dict[str, Any]()
        self._open = True

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._cached_readings:
            if not self._open:
                raise ConfigError(f"sensor '{name}' was not read in its step: ask for it while the driver is called")
            self._cached_readings[name] = self._read(name)
        return self._cached_readings[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def close(self) -> None:
        """End the step: sensors that were not read are no longer available."""
        self._open = False


class _PolicySelector:
    """Selector of the agents that follow a policy by their episode and that no other driver controls.

    It is an object and no closure, so that the copy of a loop asks the copy of its simulator.
    """

    def __init__(self, simulator: Simulator, policy: str, number: int) -> None:
        self._simulator, self._number = simulator, number
        self._follows_policy = np.zeros((len(simulator.episodes), simulator.agents), bool)
        for row, episode in zip(self._follows_policy, simulator.episodes, strict=True):
            row[: len(episode.agents)] = [agent.policy == policy for agent in episode.agents]

    def __call__(self, state: WorldState) -> Bool:
        free = (state.policy < 0) | (state.policy == self._number)
        return np.asarray(self._follows_policy[self._simulator.assigned] & free & state.active)


def _check_believer(simulator: Simulator, selector: int | Selector, driver: Driver) -> None:
    if driver.controller != Controller.AUTOPILOT:
        raise ConfigError(
            f"driver {driver.name} has a belief, so its controller must be AUTOPILOT, which plans over it"
        )
    if not isinstance(selector, int) or selector != 0:
        raise ConfigError(f"driver {driver.name} plans over a belief: it can drive egos alone, agent 0")
    if not isinstance(simulator, BeliefSimulator):
        raise ConfigError(f"driver {driver.name} plans over a belief, which this simulator takes from nobody")


def run(loop: Loop) -> None:
    """Restart all scenes and step them to their ends."""
    loop.reset()
    for _ in range(step_limit(loop.simulator)):
        loop.step()
        if (loop.simulator.ended() != End.RUNNING).all():
            break


def _check_period(simulator: Simulator, driver: Driver) -> None:
    """Raise ConfigError if a driver decides more often than a simulator steps: it would drive worse than it can."""
    period = float(getattr(driver, "period", simulator.dt))
    if period < simulator.dt - 1e-6:
        raise ConfigError(
            f"system {driver.name} decides every {period:g} s, and {type(simulator).__name__} has steps of "
            f"{simulator.dt:g} s here; drive it in the embedded world or in CARLA "
            f"(in Python: World(..., dt={period:g}, substeps=1))"
        )


def step_limit(simulator: Simulator) -> int:
    """Return the number of steps after which every episode has ended."""
    limits = [simulator.episodes[index].limits for index in simulator.assigned]
    max_steps = max(int(limit.max_steps) for limit in limits)
    return min(max_steps, int(max(limit.max_time for limit in limits) / simulator.dt) + 1)


def rollout(
    simulator: Simulator,
    drivers: Drivers | Driver,
    *,
    sensors: Mapping[str, Sensor] | None = None,
    perturbation: Changes | None = None,
    policies: Policies | None = None,
    all_signals: bool = False,
) -> list[EpisodeTrace]:
    """Drive all scenes of a simulator from their starts to their ends.

    Args:
        simulator: `World(episodes, graphs)`, or another simulator.
        drivers: Drivers as `Loop` takes them; a single driver drives the egos.
        sensors: Sensors that drivers may request besides `ssad.world.sensors.SENSORS`.
        perturbation: Changes between sensors, drivers and vehicles, as `Loop` takes them.
        policies: Makes the drivers that episodes name, such as `ssad.drivers.make_system`.
        all_signals: Record the traffic lights of the whole town, and the turn signals of all agents. By default a trace
            has the traffic lights on the ego's route, and turn signals only where a driver of the population drives.

    Returns:
        A trace of each scene.

    Raises:
        ConfigError: A driver returns controls of a wrong shape or not finite, or requests an unknown sensor. Episodes
            name drivers, and `policies` is missing.
    """
    by_agent: Drivers = drivers if isinstance(drivers, Mapping) else {0: drivers}
    loop = Loop(simulator, by_agent, sensors=sensors, perturbation=perturbation, policies=policies)
    loop.reset()
    # Traces of episodes without drivers of the population are those of earlier versions, to the byte.
    shows_signals = all_signals or any(map(has_drivers, simulator.episodes))
    rows = [_row(simulator.state(), turn_signals=shows_signals)]
    lengths = np.zeros(simulator.batch, np.int64)
    for step in range(1, step_limit(simulator) + 1):
        running = simulator.ended() == End.RUNNING
        loop.step()
        rows.append(_row(simulator.state(), turn_signals=shows_signals))
        # An ended scene keeps standing in the batch; its rows beyond the end are cut below.
        lengths[running] = step
        if (simulator.ended() != End.RUNNING).all():
            break
    recording = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return [
        _trace(simulator, recording, scene, int(lengths[scene]) + 1, all_signals=all_signals)
        for scene in range(simulator.batch)
    ]


def route_signals(graph: LaneGraph, route: Route) -> I32:
    """Return the signals at the junctions that a route passes; a trace keeps their states."""
    junctions = {int(graph.junction[lane]) for lane in np.unique(route.lane[route.lane >= 0])} - {-1}
    return np.flatnonzero(np.isin(graph.signal_junction, sorted(junctions))).astype(np.int32)


def has_drivers(episode: Episode) -> bool:
    """Return whether an agent of the episode has a driver of the population."""
    return any(agent.driver is not None for agent in episode.agents)


def _row(state: WorldState, *, turn_signals: bool) -> dict[str, npt.NDArray[np.generic]]:
    """One step of all scenes, in the terms and types of `EpisodeTrace`: first what all agents have, then the ego's."""
    shown = {"turn_signal": state.turn_signal.copy()} if turn_signals else {}
    return shown | {
        "x": state.pose[..., 0].copy(),
        "y": state.pose[..., 1].copy(),
        "yaw": state.pose[..., 2].copy(),
        "speed": state.speed.copy(),
        "active": state.active.copy(),
        "accel": state.accel[:, 0].copy(),
        "contact": state.contact.copy(),
        "contact_agent": state.contact_agent.copy(),
        "off_road": state.off_road.copy(),
        "route_distance": state.route_distance.copy(),
        "route_complete": state.route_complete.copy(),
        "driven": state.driven.copy(),
        "lane_invasion": state.lane_invasion.copy(),
        "red_light": state.red_light.copy(),
        "stop_sign": np.zeros_like(state.red_light) if state.stop_sign is None else state.stop_sign.copy(),
        "throttle": state.control[:, 0, 0].copy(),
        "brake": state.control[:, 0, 1].copy(),
        "steer": state.control[:, 0, 2].copy(),
        "signal": state.signal.copy(),
    }


def _trace(
    simulator: Simulator, rows: dict[str, npt.NDArray[np.generic]], b: int, steps: int, *, all_signals: bool
) -> EpisodeTrace:
    """Return the trace of scene b from the steps of all scenes [T, B, ...]."""
    episode = simulator.episodes[simulator.assigned[b]]
    graph = simulator.graphs[episode.town]
    state = simulator.state()
    agent_count = int((state.kind[b] != AgentKind.NONE).sum())
    agent_names = (*_AGENT, "turn_signal") if all_signals or has_drivers(episode) else _AGENT
    agent_fields: dict[str, Any] = {name: rows[name][:steps, b, :agent_count].copy() for name in agent_names}
    ego_names = set(rows) - {*_AGENT, "turn_signal"}
    ego_fields: dict[str, Any] = {name: rows[name][:steps, b].copy() for name in rows if name in ego_names}
    route = episode.agents[0].route
    assert route is not None  # checked when the world was built
    signal_ids = route_signals(graph, route)
    if all_signals:
        signal_ids = np.arange(len(graph.signal_junction), dtype=np.int32)
    ego_fields["signal"] = ego_fields["signal"][:, signal_ids]
    return EpisodeTrace(
        key=episode.key,
        town=episode.town,
        dt=simulator.dt,
        names=tuple(participant.name for participant in episode.agents),
        models=tuple(participant.model for participant in episode.agents),
        kind=state.kind[b, :agent_count].astype(np.uint8),
        length=state.size[b, :agent_count, 0].astype(np.float32),
        width=state.size[b, :agent_count, 1].astype(np.float32),
        signal_ids=signal_ids,
        route=route.xy,
        end=ENDS[int(simulator.ended()[b])] or "max_steps",
        heights=_heights(episode),
        **agent_fields,
        **ego_fields,
    )


def _heights(episode: Episode) -> tuple[float, ...]:
    """Return the heights of the agents, m; () if no agent states dimensions of its own."""
    if not any(agent.body.length or agent.body.width or agent.body.height for agent in episode.agents):
        return ()
    return tuple(float(np.float32(agent_model(agent).height)) for agent in episode.agents)
