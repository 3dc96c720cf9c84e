"""The one loop of all that drives: drivers act for agents of a simulator, step by step, and what happens is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import (
    Believer,
    Choice,
    Driver,
    NoteKeeper,
    Perturbation,
    Planner,
    Policies,
    Scenes,
    Selector,
    Sensor,
    Simulator,
    WorldState,
)
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import ENDS, F32, I32, AgentKind, Bool, Controller, End, EpisodeTrace, Route
from ssad.world.observation import observe
from ssad.world.sensors import SENSORS

Drivers = Mapping[int | Selector, Driver]
_AGENT = ("x", "y", "yaw", "speed", "active")


class Loop:
    """Drivers at work in a simulator.

    `drivers` says who acts for whom: an agent's number, or a selector that chooses at every step whom its driver takes
    over (those it no longer chooses are given back). Agents that nobody is named for are driven by what their episode
    says. All that changes lies in the simulator, so that a snapshot of it continues to the bit if its drivers do.
    An episode may also name an agent's driver (`EpisodeAgent.policy`), which `policies` makes; whoever is in `drivers`
    goes before it. `sensors` adds to those of `ssad.world.sensors`; only what a driver asks for is computed.
    `perturbation` changes the pictures ([N, C, H, W]) that drivers get; a mapping those of sensors it names.
    """

    def __init__(
        self,
        simulator: Simulator,
        drivers: Drivers,
        *,
        sensors: Mapping[str, Sensor] | None = None,
        perturbation: Perturbation | Mapping[str, Perturbation] | None = None,
        policies: Policies | None = None,
    ) -> None:
        self.simulator = simulator
        self.drivers = list(drivers.items())
        for name in sorted({agent.policy for episode in simulator.episodes for agent in episode.agents} - {""}):
            if policies is None:
                raise ConfigError(
                    f"an actor follows the policy '{name}': say who makes drivers, policies=ssad.make_system"
                )
            self.drivers.append((_told_to(simulator, name, len(self.drivers)), policies(name)))
        self.sensors = SENSORS | dict(sensors or {})
        self.perturbation = perturbation
        shape = (simulator.batch, simulator.agents)
        for who, driver in self.drivers:
            if isinstance(who, int) and not 0 <= who < simulator.agents:
                raise ConfigError(f"driver {driver.name}: there is no agent {who}; scenes have {simulator.agents}")
            if isinstance(driver, Believer):
                _check_believer(simulator, who, driver)
            for name in getattr(driver, "sensors", ()):
                if name not in self.sensors:
                    known = ", ".join(self.sensors)
                    raise ConfigError(f"driver {driver.name} asks for sensor '{name}'; known: {known}")
        # sensors that remember follow every step, also while nobody looks
        asked = {name for _, driver in self.drivers for name in getattr(driver, "sensors", ())}
        following = (getattr(self.sensors[name], "follow", None) for name in sorted(asked))
        self._following = [follow for follow in following if follow is not None]
        self._controls = np.zeros((*shape, 4), np.float32)
        self._fixed = [
            np.stack([np.arange(shape[0]), np.full(shape[0], who)], 1).astype(np.int32)
            if isinstance(who, int)
            else None
            for who, _ in self.drivers
        ]

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Start scenes again (default: all), as `Simulator.reset`; drivers take their seats there.

        Drivers forget the past only when all scenes start again.
        """
        simulator = self.simulator
        simulator.reset(scenes, episodes=episodes)
        started = np.full(simulator.batch, scenes is None)
        if scenes is not None:
            started[np.asarray(scenes)] = True
        for policy, (who, driver) in enumerate(self.drivers):
            if isinstance(who, int):
                self._seat(policy, (np.arange(simulator.agents) == who) & started[:, None])
            if (driver.controller == Controller.EXTERNAL or isinstance(driver, Believer)) and scenes is None:
                driver.reset([simulator.episodes[k] for k in simulator.assigned])

    def _seat(self, policy: int, mask: npt.NDArray[np.bool_]) -> None:
        driver = self.drivers[policy][1]
        speed = getattr(driver, "target_speed", None)
        self.simulator.take(mask, driver.controller, policy=policy, target_speed=speed)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance all scenes by one step.

        `controls` [B, A, 3|4] are for agents that no driver here acts for. Raises ConfigError if a driver returns
        controls of a wrong shape or not finite; what it raises passes.
        """
        if not self.drivers:
            self.simulator.step(controls)
            return
        self._controls[:] = 0.0
        if controls is not None:
            given = np.asarray(controls, np.float32)
            self._controls[..., : given.shape[-1]] = given
        asked = controls is not None
        for follow in self._following:
            follow(self.simulator)
        state: WorldState | None = None
        for policy, (who, driver) in enumerate(self.drivers):
            agents = self._fixed[policy]
            external = driver.controller == Controller.EXTERNAL
            if agents is None or external or isinstance(driver, Believer):
                state = self.simulator.state() if state is None else state
            if agents is None and not isinstance(who, int):
                assert state is not None
                chosen, state = self._choose(who, state)
                chosen = chosen & (self.simulator.ended() == End.RUNNING)[:, None]
                had = state.policy == policy
                if (chosen != had).any():
                    if (had & ~chosen).any():
                        self.simulator.take(had & ~chosen, None)
                    if (chosen & ~had).any():
                        self._seat(policy, chosen & ~had)
                    state = self.simulator.state()
                agents = np.argwhere(chosen).astype(np.int32)
            if external and agents is not None and len(agents):
                assert state is not None
                asked = True
                given = self._act(driver, state, agents)
                self._controls[agents[:, 0], agents[:, 1], : given.shape[1]] = given
            if isinstance(driver, Believer) and agents is not None:
                assert state is not None
                self._believe(driver, state, agents)
        self.simulator.step(self._controls if asked else None)

    def _choose(self, who: Selector, state: WorldState) -> tuple[Bool, WorldState]:
        """Whom a selector chooses [B, A], and the state after it has noted what it remembers and removed whom it does.

        Raises ConfigError if it remembers something and the simulator keeps no notes.
        """
        choice = who(state)
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
        """Hand what the driver believes to the planner; scenes that have ended keep what they had."""
        assert isinstance(driver, Believer)
        assert isinstance(self.simulator, Planner)
        ended = self.simulator.ended() != End.RUNNING
        readings = self._readings(driver, state, egos)
        belief = driver.believe(observe(state, egos, ended, readings))
        readings.close()
        try:
            self.simulator.believe(belief, ~ended)
        except ConfigError as error:
            raise ConfigError(f"system {driver.name}: {error}") from None

    def _act(self, driver: Driver, state: WorldState, agents: I32) -> F32:
        """Controls [N, 3|4] of the agents; 0 where the episode has ended."""
        ended = self.simulator.ended() != End.RUNNING
        readings = self._readings(driver, state, agents)
        given = np.asarray(driver.act(observe(state, agents, ended, readings)), np.float32)
        readings.close()
        if given.ndim != 2 or given.shape[0] != len(agents) or given.shape[1] not in (3, 4):
            raise ConfigError(
                f"system {driver.name}: act returned shape {given.shape}, expected ({len(agents)}, 3): "
                "throttle, brake, steer"
            )
        running = ~ended[agents[:, 0]]
        if not np.isfinite(given[running]).all():
            raise ConfigError(f"system {driver.name}: act returned a control that is not finite")
        return np.where(running[:, None], given, np.float32(0.0))

    def _readings(self, driver: Driver, state: WorldState, agents: I32) -> _Readings:
        names = tuple(getattr(driver, "sensors", ()))
        return _Readings(names, lambda name: self._read(name, driver, state, agents))

    def _read(self, name: str, driver: Driver, state: WorldState, agents: I32) -> Any:
        reading = self.sensors[name](self.simulator, agents)
        perturbation = self.perturbation.get(name) if isinstance(self.perturbation, Mapping) else self.perturbation
        if perturbation is None or getattr(reading, "ndim", 0) != 4:
            return reading
        episodes, assigned = self.simulator.episodes, self.simulator.assigned
        generators = []
        for scene, agent in agents.tolist():
            episode, step = episodes[assigned[scene]], round(float(state.time[scene]) / self.simulator.dt)
            generators.append(generator("perturbation", episode.key, episode.seed, name, agent, step))
        if hasattr(reading, "cpu"):  # pictures that stayed on a device
            reading = reading.cpu().numpy()
        return perturbation.apply(reading, driver, state, generators)


class _Readings(Mapping[str, Any]):
    """What sensors show, each read when it is first asked for: a camera that nobody looks through renders nothing."""

    def __init__(self, names: tuple[str, ...], read: Callable[[str], Any]) -> None:
        self._names, self._read, self._found = names, read, dict[str, Any]()
        self._open = True

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._found:
            if not self._open:
                raise ConfigError(f"sensor '{name}' was not read in its step: ask for it while the driver is called")
            self._found[name] = self._read(name)
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def close(self) -> None:
        """The step is over: what was not read cannot be read any more."""
        self._open = False


def _told_to(simulator: Simulator, policy: str, number: int) -> Selector:
    """The agents that their episodes give to a policy, driver `number`, and that nobody else has taken over."""
    told = np.zeros((len(simulator.episodes), simulator.agents), bool)
    for row, episode in zip(told, simulator.episodes, strict=True):
        row[: len(episode.agents)] = [agent.policy == policy for agent in episode.agents]

    def choose(state: WorldState) -> Bool:
        free = (state.policy < 0) | (state.policy == number)
        return np.asarray(told[simulator.assigned] & free & state.active)

    return choose


def _check_believer(simulator: Simulator, who: int | Selector, driver: Driver) -> None:
    if driver.controller != Controller.AUTOPILOT:
        raise ConfigError(
            f"driver {driver.name} has a belief, so its controller must be AUTOPILOT, which plans over it"
        )
    if not isinstance(who, int) or who != 0:
        raise ConfigError(f"driver {driver.name} plans over a belief: it can drive egos alone, agent 0")
    if not isinstance(simulator, Planner):
        raise ConfigError(f"driver {driver.name} plans over a belief, which this simulator takes from nobody")


def run(loop: Loop) -> None:
    """Start all scenes again and step them to their ends."""
    loop.reset()
    for _ in range(step_limit(loop.simulator)):
        loop.step()
        if (loop.simulator.ended() != End.RUNNING).all():
            break


def step_limit(simulator: Simulator) -> int:
    """Steps after which every episode has ended."""
    limits = [simulator.episodes[k].limits for k in simulator.assigned]
    most = max(int(limit.max_steps) for limit in limits)
    return min(most, int(max(limit.max_time for limit in limits) / simulator.dt) + 1)


def rollout(
    simulator: Simulator,
    drivers: Drivers | Driver,
    *,
    sensors: Mapping[str, Sensor] | None = None,
    perturbation: Perturbation | Mapping[str, Perturbation] | None = None,
    policies: Policies | None = None,
) -> list[EpisodeTrace]:
    """Drive all scenes of a simulator from their starts to their ends.

    Args:
        simulator: Where: `World(episodes, graphs)`, or another simulator.
        drivers: Who drives whom, as `Loop` takes it; a driver alone drives the egos.
        sensors: What drivers may ask for besides `ssad.world.sensors.SENSORS`.
        perturbation: What changes the pictures that drivers get; a mapping: of each sensor by its name.
        policies: Makes the drivers that episodes name, such as `ssad.drivers.make_system`.

    Returns:
        A trace of each scene.

    Raises:
        ConfigError: A driver returns controls of a wrong shape or not finite, or asks for what is not there. Episodes
            name drivers, and there is no `policies`.
    """
    by_agent: Drivers = drivers if isinstance(drivers, Mapping) else {0: drivers}
    loop = Loop(simulator, by_agent, sensors=sensors, perturbation=perturbation, policies=policies)
    loop.reset()
    rows = [_row(simulator.state())]
    lengths = np.zeros(simulator.batch, np.int64)
    for step in range(1, step_limit(simulator) + 1):
        running = simulator.ended() == End.RUNNING
        loop.step()
        rows.append(_row(simulator.state()))
        lengths[running] = step
        if (simulator.ended() != End.RUNNING).all():
            break
    whole = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return [_trace(simulator, whole, b, int(lengths[b]) + 1) for b in range(simulator.batch)]


def route_signals(graph: LaneGraph, route: Route) -> I32:
    """The signals at the junctions that a route passes: those whose states a trace keeps."""
    junctions = {int(graph.junction[k]) for k in np.unique(route.lane[route.lane >= 0])} - {-1}
    return np.flatnonzero(np.isin(graph.signal_junction, sorted(junctions))).astype(np.int32)


def _row(state: WorldState) -> dict[str, npt.NDArray[np.generic]]:
    """One step of all scenes, in the terms and types of `EpisodeTrace`: first what all agents have, then the ego's."""
    return {
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


def _trace(simulator: Simulator, rows: dict[str, npt.NDArray[np.generic]], b: int, steps: int) -> EpisodeTrace:
    """Of scene b, from the steps of all scenes [T, B, ...]."""
    episode = simulator.episodes[simulator.assigned[b]]
    graph = simulator.graphs[episode.town]
    state = simulator.state()
    n = int((state.kind[b] != AgentKind.NONE).sum())
    agent: dict[str, Any] = {name: rows[name][:steps, b, :n].copy() for name in _AGENT}
    ego: dict[str, Any] = {name: rows[name][:steps, b].copy() for name in rows if name not in _AGENT}
    route = episode.agents[0].route
    assert route is not None  # checked when the world was built
    near = route_signals(graph, route)
    ego["signal"] = ego["signal"][:, near]
    return EpisodeTrace(
        key=episode.key,
        town=episode.town,
        dt=simulator.dt,
        names=tuple(a.name for a in episode.agents),
        models=tuple(a.model for a in episode.agents),
        kind=state.kind[b, :n].astype(np.uint8),
        length=state.size[b, :n, 0].astype(np.float32),
        width=state.size[b, :n, 1].astype(np.float32),
        signal_ids=near,
        route=route.xy,
        end=ENDS[int(simulator.ended()[b])] or "max_steps",
        **agent,
        **ego,
    )
