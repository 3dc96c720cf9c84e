"""Embedded world: batched scenes that advance together at 10 Hz on CPU or CUDA, deterministically."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.driving import Belief, Scenes, WorldState
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import start_warp_quietly
from ssad.core.types import F32, I8, I32, U8, AgentKind, Bool, Controller, Episode, Model, SignalState
from ssad.world.belief import Lanes, check, complete_belief, lanes_of, rest_times
from ssad.world.episode_arrays import build
from ssad.world.kernels.belief import fill_all_rows
from ssad.world.kernels.data import (
    BLOCK,
    HORIZON,
    Ego,
    PerceivedAgents,
    Presence,
    ScriptState,
    State,
    WalkState,
    Work,
    array_types,
)
from ssad.world.kernels.drive import drive
from ssad.world.kernels.giving_way import give_way
from ssad.world.kernels.lane_choice import change_lanes
from ssad.world.kernels.motion import move
from ssad.world.kernels.noise import advance_noise, reset_noise
from ssad.world.kernels.record import contact, record, restart, restart_record
from ssad.world.kernels.script import restart_scripts, run_scripts
from ssad.world.kernels.traffic import react_to_agents, scan_all_agents
from ssad.world.kernels.walkers import restart_walks, walk_all, yield_to_walkers
from ssad.world.models import MODELS
from ssad.world.noise import NAMES, Keys, Noise, episode_keys, noise_state
from ssad.world.turn_signals import turn_signals

VERSION = "7"  # part of every cell's key: raise it when the same episode no longer gives the same bits

_STATE, _SEEN, _EGO = array_types(State), array_types(PerceivedAgents), array_types(Ego)
_SCRIPT, _WALK = array_types(ScriptState), array_types(WalkState)
# The remaining arrays of `PerceivedAgents` have one row per object, so a growing belief resizes them.
_OF_SCENES = ("believes", "told", "light", "sign")  # arrays of `PerceivedAgents` that have no rows of objects
# Threads of a block on CUDA where another number is faster than `BLOCK`; kernels of one module share it.
BLOCKS = {scan_all_agents: 256, react_to_agents: 256, give_way: 64}
MEETING_THREADS = 1 << 16
_IMMUTABLE = ("episodes", "graphs", "models", "bank")  # attributes that deep copies share
# Attributes that live on the device or refer to it: a copy makes its own.
_ON_DEVICE = (
    *("arrays", "seen", "ego", "script", "walk", "controls", "places", "_mask", "work", "noise", "_views", "_looks"),
    *("_restart", "_see", "_plan", "_advance", "_graph"),
)


@dataclass(frozen=True)
class Snapshot:
    """Host copy of everything that changes in a world. Worlds restored from equal snapshots continue identically."""

    arrays: Mapping[str, npt.NDArray[np.generic]]


class World:
    """Batch of episodes that run side by side. Implements `Simulator` of `ssad.core.driving`, and `Reproducible`.

    The bits of a scene depend on its episode and controls alone: not on the batch, its order or the other scenes.

    Worlds deep-copy and pickle, in the midst of an episode too, and a copy continues to the bit. Deep copies share the
    bank of episodes, which never changes; an unpickled world builds it again, on the same device.

    Args:
        episodes: The bank of episodes.
        graphs: Lane graph of each town that the episodes name.
        assign: Episode number of each scene; None: one scene per episode.
        device: Warp device, such as "cpu" or "cuda:0".
        dt: Length of a step, s.
        substeps: Parts of a step in which motion is integrated.
        ego: Controller that replaces every ego's; None: as the episodes say.
        models: Bodies by name.
        autoreset: Restart a scene at the next step after its episode has ended.
        noise: Randomness in traffic, from a key per scene (see `rekey`); None: no randomness.

    Raises:
        ConfigError: An episode cannot be built, or an argument is out of range.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        assign: Scenes | None = None,
        device: str = "cpu",
        dt: float = 0.1,
        substeps: int = 2,
        ego: Controller | None = None,
        models: Mapping[str, Model] = MODELS,
        autoreset: bool = False,
        noise: Noise | None = None,
    ) -> None:
        if dt <= 0.0 or substeps < 1:
            raise ConfigError(f"a world needs dt > 0 and substeps >= 1, not {dt} and {substeps}")
        start_warp_quietly()
        self.episodes = tuple(episodes)
        self.graphs: Mapping[str, LaneGraph] = dict(graphs)
        self.dt = dt
        self.device = device
        self.models: Mapping[str, Model] = dict(models)
        self._ego_controller = ego
        self.bank = build(self.episodes, graphs, device, ego, models, dt)
        # All scenes have as many slots as the widest episode; the others leave theirs empty.
        self.agents = self.bank.agents
        assignment = np.arange(len(self.episodes)) if assign is None else np.asarray(assign)
        if len(assignment) == 0 or assignment.min() < 0 or assignment.max() >= len(self.episodes):
            raise ConfigError(f"scenes must be assigned episodes 0 to {len(self.episodes) - 1}")
        self.batch = len(assignment)
        # A pair of agents is stored as one int32 code, with two more bits for its flags.
        if self.batch * self.agents**2 >= 1 << 29:
            raise ConfigError(f"{self.batch} scenes of {self.agents} agents are too many for one world")
        self._lanes: dict[str, Lanes] = {}
        self._settings = (dt, substeps, autoreset)
        self.chance = noise
        self._allocate(assignment.astype(np.int32), believed=0)
        self.reset()

    def _allocate(self, assignment: I32, *, believed: int) -> None:
        """Make all arrays and launches, with room for that many objects of a belief in each scene."""
        device = self.device
        self.belief_capacity = 0  # room for objects of a belief in each scene
        self._views: dict[str, npt.NDArray[Any]] = {}
        self.arrays = State()
        shape = (self.batch, self.agents, HORIZON)
        for name, array_type in _STATE.items():
            setattr(self.arrays, name, wp.zeros(shape[: array_type.ndim], dtype=array_type.dtype, device=device))
        self.seen = PerceivedAgents()
        self.ego = Ego()
        for name, array_type in _EGO.items():
            setattr(self.ego, name, wp.zeros(self.batch, dtype=array_type.dtype, device=device))
        agent_shape = (self.batch, self.agents)
        self.script = ScriptState()
        for name, array_type in _SCRIPT.items():
            script_shape = {
                "begun": (self.batch, self.bank.script_rows[0]),
                "ended": (self.batch, self.bank.script_rows[0]),
                "history": (self.batch, self.bank.script_rows[1]),
            }.get(name, agent_shape)
            # a world without scripts keeps none
            script_shape = script_shape if self._scripted else (1, 1)
            setattr(self.script, name, wp.zeros(script_shape, dtype=array_type.dtype, device=device))
        self.walk = WalkState()
        for name, array_type in _WALK.items():
            walk_shape = agent_shape if self._walks else (1, 1)
            setattr(self.walk, name, wp.zeros(walk_shape, dtype=array_type.dtype, device=device))
        self.controls = wp.zeros(agent_shape, dtype=wp.vec4, device=device)
        self.places = wp.zeros(agent_shape, dtype=wp.vec4, device=device)
        self._mask = wp.zeros(self.batch, dtype=wp.int32, device=device)
        self.work = Work()
        self.work.count = wp.zeros(2, dtype=wp.int32, device=device)
        self.work.leader = wp.zeros((self.batch, self.agents), dtype=wp.int32, device=device)
        self.work.judgement = wp.zeros((self.batch, self.agents), dtype=wp.vec2, device=device)
        if self.chance is not None:
            self.noise = noise_state(self.chance, self.episodes, assignment, self.agents, device)
        self._assign(assignment)
        self._make_room(believed)

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickle stores: arguments, and host copies of the arrays. ConfigError after `capture`."""
        return self._host_state(leave_out=(*_ON_DEVICE, "bank"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the world anew from what `__getstate__` returned."""
        start_warp_quietly()
        arrays = state["saved_arrays"]
        self.__dict__.update({name: value for name, value in state.items() if name != "saved_arrays"})
        if "bank" not in state:
            self.bank = build(self.episodes, self.graphs, self.device, self._ego_controller, self.models, self.dt)
        self._allocate(arrays["episode"], believed=self.belief_capacity)
        for name, value in arrays.items():
            self.put(name, value)

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        """Return a world that continues as this one does; episodes, graphs and the bank are shared."""
        duplicate = object.__new__(type(self))
        memo[id(self)] = duplicate
        # Drivers and views that hold a town or an episode share it too.
        shared = [getattr(self, name) for name in _IMMUTABLE]
        for constant in (*shared, *self.episodes, *self.graphs.values()):
            memo[id(constant)] = constant
        duplicate.__setstate__(copy.deepcopy(self._host_state(leave_out=_ON_DEVICE), memo))
        return duplicate

    def _host_state(self, *, leave_out: Sequence[str]) -> dict[str, Any]:
        """Return attributes by name, and all arrays that hold something from one step to the next."""
        if self._graph is not None:
            raise ConfigError("a world with a captured CUDA graph cannot be copied; copy it, then call capture()")
        names = (*self.names, *(f"seen.{name}" for name in _SEEN), "controls", "places")
        attributes = {name: value for name, value in self.__dict__.items() if name not in leave_out}
        return attributes | {"saved_arrays": {name: self.array(name).copy() for name in names}}

    def _make_room(self, believed: int) -> None:
        """Room for that many objects of a belief in each scene, and the launches of a step, which refer to it."""
        row_count = self.agents + believed
        if self.batch * self.agents * row_count >= 1 << 29:
            raise ConfigError(f"{self.batch} scenes of {self.agents} agents and {believed} objects are too many")
        previous_arrays = {name: self.array(f"seen.{name}").copy() for name in _SEEN} if self.belief_capacity else {}
        self.belief_capacity = believed
        for name, array_type in _SEEN.items():
            shape = {
                "believes": (self.batch,),
                "told": (self.batch,),
                "light": (self.batch, self.bank.forced.shape[1]),
            }.get(name, (self.batch, row_count, HORIZON)[: array_type.ndim])
            setattr(self.seen, name, wp.zeros(shape, dtype=array_type.dtype, device=self.device))
            self._views.pop(f"seen.{name}", None)
        for name, previous in previous_arrays.items():
            enlarged = self.array(f"seen.{name}").copy()
            enlarged[tuple(slice(length) for length in previous.shape)] = previous
            self.put(f"seen.{name}", enlarged)
        # Every agent may pair with every other agent, but only the ego pairs with believed objects.
        pair_capacity = self.batch * (self.agents * max(self.agents - 1, 1) + believed)
        self.work.pair = wp.zeros(pair_capacity, dtype=wp.int32, device=self.device)
        # only drivers of the population foresee meetings
        meeting_capacity = pair_capacity if self.bank.has_drivers else 1
        self.work.meeting = wp.zeros(meeting_capacity, dtype=wp.int32, device=self.device)
        self.work.crossing = wp.zeros(meeting_capacity, dtype=wp.float32, device=self.device)
        # one thread walks the list on CPU; on CUDA enough to fill the device
        pair_threads = 1 if self.device == "cpu" else min(pair_capacity, 1 << 21)
        # few pairs, and a long way each: no more threads than are resident at once
        meeting_threads = min(pair_threads, MEETING_THREADS)
        dt, substeps, autoreset = self._settings
        bank, roads, state, perceived = self.bank.episodes, self.bank.roads, self.arrays, self.seen
        scripts, walkers = self.bank.scripts, self.bank.walkers

        # threads of a scene: on CPU to begin one costs more than what most of them have to do
        agent_threads = 1 if self.device == "cpu" else self.agents
        launch_shape = (self.batch, agent_threads)

        def restarts(ended_too: int) -> list[Any]:
            noise_reset = []
            if self.chance is not None:
                noise_inputs = [state, self.noise, self._mask, ended_too, self.agents, self.chance.stretches]
                noise_reset = [self.launch(reset_noise, self.batch, noise_inputs)]
            script_reset = []
            if self._scripted:
                script_inputs = [bank, roads, scripts, state, self.script, self._mask, ended_too, self.agents]
                script_reset = [self.launch(restart_scripts, self.batch, [*script_inputs, *self.bank.script_rows])]
            walk_reset = []
            if self._walks:
                walk_inputs = [bank, roads, walkers, state, self.walk, self._mask, ended_too, self.agents]
                walk_reset = [self.launch(restart_walks, self.batch, walk_inputs)]
            return [
                *noise_reset,
                *script_reset,
                *walk_reset,
                self.launch(
                    restart, launch_shape, [bank, roads, state, self._mask, ended_too, self.agents, agent_threads]
                ),
                self.launch(
                    restart_record, self.batch, [bank, roads, state, perceived, self.ego, self._mask, ended_too]
                ),
            ]

        self._restart = restarts(0)
        self._see = self.launch(
            fill_all_rows, launch_shape, [bank, roads, state, perceived, self.agents, agent_threads, dt]
        )
        self._plan = [
            *(restarts(1) if autoreset else []),
            self._see,
            self.launch(
                scan_all_agents,
                launch_shape,
                [bank, roads, state, perceived, self.work, self.agents, row_count, agent_threads, dt],
            ),
            *(
                [
                    self.launch(
                        yield_to_walkers,
                        launch_shape,
                        [bank, roads, walkers, state, perceived, self.walk, self.agents, agent_threads],
                    )
                ]
                if self._walks
                else []
            ),
            self.launch(
                react_to_agents,
                pair_threads,
                [bank, roads, state, perceived, self.work, self.agents, row_count, pair_threads, dt],
            ),
            *(
                [
                    self.launch(
                        give_way,
                        meeting_threads,
                        [bank, roads, state, perceived, self.work, self.agents, row_count, meeting_threads, dt],
                    )
                ]
                if self.bank.has_drivers
                else []
            ),
            self.launch(
                change_lanes,
                launch_shape,
                [bank, roads, state, perceived, self.work, self.agents, row_count, agent_threads],
            ),
            *(
                [self.launch(run_scripts, self.batch, [bank, roads, scripts, state, self.script, self.agents, dt])]
                if self._scripted
                else []
            ),
            *(
                [
                    self.launch(
                        walk_all,
                        self.batch,
                        [bank, roads, walkers, state, self.script, self.walk, self.agents, dt],
                    )
                ]
                if self._walks
                else []
            ),
            self.launch(
                drive, launch_shape, [bank, roads, state, perceived, self.agents, row_count, agent_threads, dt]
            ),
        ]
        if self.chance is not None:
            noise_inputs = [bank, roads, state, self.chance.rule(dt), self.noise, self.agents, agent_threads]
            self._plan.append(self.launch(advance_noise, launch_shape, noise_inputs))
        self._advance = [
            self.launch(
                move,
                launch_shape,
                [bank, roads, state, self.script, self.controls, self.places, self.agents, agent_threads, dt, substeps],
            ),
            self.launch(contact, launch_shape, [bank, roads, state, self.work, self.agents, agent_threads]),
            self.launch(record, self.batch, [bank, roads, state, self.ego, self.agents, dt]),
        ]
        self._graph: Any = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays that hold everything that changes, as long as no ego plans over a belief."""
        script_names = _SCRIPT if self._scripted else ()
        walk_names = _WALK if self._walks else ()
        return (
            *_STATE,
            *(f"ego.{name}" for name in _EGO),
            *(f"noise.{name}" for name in self._noisy),
            *(f"script.{name}" for name in script_names),
            *(f"walk.{name}" for name in walk_names),
        )

    @property
    def _scripted(self) -> bool:
        return self.bank.script_rows[0] > 0

    @property
    def _walks(self) -> bool:
        return self.bank.walkers is not None

    @property
    def _noisy(self) -> tuple[str, ...]:
        return () if self.chance is None else NAMES

    def launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> Any:
        """Record a launch, so that its arguments are packed only once."""
        block_size = BLOCKS.get(kernel, BLOCK) if self.device != "cpu" else None
        return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_size, record_cmd=True)

    def _assign(self, order: npt.NDArray[np.int32]) -> None:
        self.put("episode", order)
        self._forget()

    def _forget(self) -> None:
        """Drop the cached lookups that depend on the assignment of episodes."""
        self.__dict__.pop("_fixed", None)
        self.__dict__.pop("_lamps", None)

    @cached_property
    def _fixed(self) -> dict[str, npt.NDArray[Any]]:
        """Properties of the scenes' episodes that a step does not change."""
        assignment = self.array("episode")
        return {
            "kind": self.bank.kind[assignment],
            "size": self.bank.size[assignment],
            "route": self.bank.route[assignment],
        }

    @cached_property
    def _lamps(self) -> tuple[npt.NDArray[np.float64], I32, F32]:
        """Signals of each scene's town: programmes, forced states, and the time until which they are forced."""
        assignment = self.array("episode")
        return self.bank.program[assignment], self.bank.forced[assignment], self.bank.until[assignment]

    @property
    def assigned(self) -> I32:
        """Number of the episode that each scene runs, [B]."""
        return self.array("episode").copy()

    def array(self, name: str) -> npt.NDArray[Any]:
        """Return an array as numpy: a view on CPU, a copy on CUDA.

        Args:
            name: Name of a state array; `ego.<name>`, `seen.<name>`, `noise.<name>`, `script.<name>` or `walk.<name>`
                for the other groups.
        """
        view = self._views.get(name)
        if view is None:
            view = self._source(name).numpy()
            if self.device == "cpu":
                self._views[name] = view
        return view

    def _source(self, name: str) -> Any:
        if name in ("controls", "places"):
            return getattr(self, name)
        group, _, member = name.rpartition(".")
        if group == "noise":
            return getattr(self.noise, member)
        groups = {"": self.arrays, "ego": self.ego, "seen": self.seen, "script": self.script, "walk": self.walk}
        return getattr(groups[group], member)

    def put(self, name: str, value: npt.NDArray[Any]) -> None:
        """Fill the array that `array(name)` reads."""
        if self.device == "cpu":
            self.array(name)[...] = value
        else:
            self._source(name).assign(value)

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Restart scenes.

        Args:
            scenes: Numbers of the scenes; None: all.
            episodes: Episode number for each of them; None: the episode that it runs already.

        Raises:
            ConfigError: The bank has no such episode.
        """
        scene_indices = np.arange(self.batch) if scenes is None else np.asarray(scenes, np.int64)
        if episodes is not None:
            assignment = self.assigned
            assignment[scene_indices] = episodes
            if len(assignment) and (assignment.min() < 0 or assignment.max() >= len(self.episodes)):
                raise ConfigError(f"no such episode; the bank holds {len(self.episodes)}")
            self._assign(assignment)
        mask = np.zeros(self.batch, np.int32)
        mask[scene_indices] = 1
        self._mask.assign(mask)
        for command in self._restart:
            command.launch()
        if self.chance is not None and episodes is not None:
            self.rekey(episode_keys(self.episodes)[np.asarray(episodes)], scene_indices)

    def rekey(self, keys: Keys, scenes: Scenes | None = None) -> None:
        """Give scenes other noise keys, which determine all randomness from now on.

        Args:
            keys: One key per scene.
            scenes: Numbers of the scenes; None: all.

        Raises:
            ConfigError: The world has no noise.
        """
        if self.chance is None:
            raise ConfigError("there is no chance in this world: it was made without noise")
        scene_keys = self.array("noise.key").copy()
        scene_keys[np.arange(self.batch) if scenes is None else np.asarray(scenes)] = keys
        self.put("noise.key", scene_keys)

    def set_controls(self, controls: npt.ArrayLike) -> None:
        """Set the controls of external agents.

        Args:
            controls: [B, 3|4] for the egos or [B, A, 3|4] for all agents: throttle, brake, steer and (optional)
                reverse.

        Raises:
            ConfigError: The shape is wrong, or a number is not finite.
        """
        values = np.asarray(controls, np.float32)
        all_controls = np.zeros((self.batch, self.agents, 4), np.float32)
        if values.ndim == 2 and values.shape[0] == self.batch and values.shape[1] in (3, 4):
            all_controls[:, 0, : values.shape[1]] = values
        elif values.ndim == 3 and values.shape[:2] == all_controls.shape[:2] and values.shape[2] in (3, 4):
            all_controls[..., : values.shape[2]] = values
        else:
            raise ConfigError(
                f"controls have shape {values.shape}; expected ({self.batch}, 3) or "
                f"({self.batch}, {self.agents}, 3): throttle, brake, steer"
            )
        if not np.isfinite(all_controls).all():
            raise ConfigError("controls hold a number that is not finite")
        self.put("controls", all_controls)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by dt. Ended scenes stand still, or restart with `autoreset`."""
        if controls is not None:
            self.set_controls(controls)
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self.plan()
        self.advance()

    def plan(self) -> None:
        """Run the first half of a step: decide the controls of all agents that the world drives."""
        for command in self._plan:
            command.launch()

    def planned_controls(self) -> F32:
        """Return the controls that `plan` decided, [B, A, 4]: throttle, brake, steer, reverse."""
        controls: F32 = self.array("control").copy()
        return controls

    def set_planned_controls(self, controls: F32) -> None:
        """Replace the controls that `plan` decided, [B, A, 4], for the next `advance`."""
        self.put("control", np.asarray(controls, np.float32))

    def advance(self) -> None:
        """Run the second half of a step: motion, contacts and the egos' records."""
        for command in self._advance:
            command.launch()

    def capture(self, *, more: Sequence[Any] = (), steps: int = 1) -> None:
        """Record `steps` steps (and `more` launches after each) as one CUDA graph that `step` replays; CUDA only."""
        with wp.ScopedCapture(device=self.device) as recorded:
            for _ in range(steps):
                for command in [*self._plan, *self._advance, *more]:
                    command.launch()
        self._graph = recorded.graph

    def take(
        self, agents: Bool, controller: Controller | None, *, policy: int = -1, target_speed: float | None = None
    ) -> None:
        """Assign agents to a controller, or return them to the one that their episode names.

        An agent that is returned looks up its place on its route again, since it may have been driven past it.

        Args:
            agents: [B, A] mask of the agents.
            controller: New controller; None: that of the episode.
            policy: Number of the driver that acts for them, -1: none.
            target_speed: m/s; None: unchanged.

        Raises:
            ConfigError: The mask has another shape.
        """
        agent_mask = np.asarray(agents, bool)
        if agent_mask.shape != (self.batch, self.agents):
            raise ConfigError(f"a mask of agents has shape {agent_mask.shape}; expected ({self.batch}, {self.agents})")
        agent_mask = agent_mask & (self._fixed["kind"] != AgentKind.NONE)
        assignment = self.assigned
        updates: dict[str, Any] = {"controller": controller, "policy": policy, "cruise": target_speed}
        if controller is None:
            episode_arrays = self.bank.episodes
            updates = {
                "controller": episode_arrays.controller.numpy()[assignment],
                "cruise": episode_arrays.cruise.numpy()[assignment][..., 0],
            }
            updates |= {"policy": -1, "progress": self._places_on_routes(agent_mask)}
        presence = self.array("active")
        # A sleeping agent only brakes, whatever its controller; see `kernels.drive`.
        updates["active"] = np.where(presence == Presence.ASLEEP, int(Presence.AWAKE), presence)
        for name, value in updates.items():
            if value is not None:
                self.put(name, np.where(agent_mask, value, self.array(name)).astype(self.array(name).dtype))

    def _places_on_routes(self, mask: Bool) -> I32:
        """Return `progress` [B, A] with masked agents moved to the nearest remaining point of their routes."""
        progress: I32 = self.array("progress").copy()
        pose, route = self.array("pose"), self._fixed["route"]
        for scene, agent in np.argwhere(mask).tolist():
            first, point_count = route[scene, agent].tolist()
            if point_count > 1:
                current = int(progress[scene, agent])
                remaining = self.bank.tables.path[first + current : first + point_count, :2]
                progress[scene, agent] = current + int(np.argmin(((remaining - pose[scene, agent, :2]) ** 2).sum(1)))
        return progress

    def keep_note(self, note: I32) -> None:
        """Store the note of a selector on agents, [B, A]. A restart resets it to 0."""
        self.put("note", np.asarray(note, np.int32))

    def remove(self, agents: Bool) -> None:
        """Remove agents [B, A] from their scenes until these restart, including agents that follow a trajectory."""
        is_removed, controller = np.asarray(agents, bool), self.array("controller")
        on_trajectory = is_removed & (controller == Controller.TRAJECTORY)  # would be back in the next step
        for name, mask, value in (
            ("active", is_removed, Presence.ABSENT),
            ("controller", on_trajectory, Controller.NONE),
        ):
            current = self.array(name)
            self.put(name, np.where(mask, int(value), current).astype(current.dtype))

    def place(self, places: npt.ArrayLike) -> None:
        """Set where agents with the controller PLACED are at the end of the next step.

        Args:
            places: [B, A, 4] x, y (m), yaw (rad), speed (m/s).

        Raises:
            ConfigError: The shape is wrong, or a number is not finite.
        """
        values = np.asarray(places, np.float32)
        if values.shape != (self.batch, self.agents, 4) or not np.isfinite(values).all():
            raise ConfigError(f"places must be ({self.batch}, {self.agents}, 4) finite numbers: x, y, yaw, speed")
        # Agents with another controller ignore their row.
        self.put("places", values)

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Set the egos' beliefs, over which their Autopilot plans until the next belief or a restart of the scene.

        Args:
            belief: [B, K]. None: return to the truth.
            scenes: [B] mask of the scenes whose egos hold it; None: all.

        Raises:
            ConfigError: An array has another shape, or a number that counts is not finite.
        """
        scene_mask = np.ones(self.batch, bool) if scenes is None else np.asarray(scenes, bool)
        if scene_mask.shape != (self.batch,):
            raise ConfigError(f"a mask of scenes has shape {scene_mask.shape}; expected ({self.batch},)")
        believes = np.where(scene_mask, belief is not None, self.array("seen.believes"))
        if belief is not None:
            current_signals = self.array("seen.light")
            check(belief, self.batch, current_signals.shape[1], scene_mask)
            towns = [self.episodes[index].town for index in self.array("episode")]
            belief_arrays = complete_belief(belief, lanes_of(self.graphs, towns, self._lanes), scene_mask)
            step = self.array("step")
            if belief.standing_time is None:
                previous = {
                    name: self.array(f"seen.{name}")[:, self.agents :] for name in ("pose", "speed", "kind", "waited")
                }
                previous["kind"] = np.where(self.array("seen.believes")[:, None], previous["kind"], AgentKind.NONE)
                belief_arrays["waited"] = rest_times(
                    belief_arrays, previous, self.dt * (step - self.array("seen.told"))
                )
            object_count = belief_arrays["kind"].shape[1]
            if object_count > self.belief_capacity:
                # Round up, so that a slowly growing belief does not record the launches again each time.
                self._make_room(-(-object_count // 16) * 16)
            for name, value in belief_arrays.items():
                self._put_rows(name, value, scene_mask)
            believed_signals = (
                np.full(current_signals.shape, -1) if belief.signal is None else np.asarray(belief.signal)
            )
            self.put("seen.told", np.where(scene_mask, step, self.array("seen.told")).astype(np.int32))
            self.put("seen.light", np.where(scene_mask[:, None], believed_signals, current_signals).astype(np.int32))
            known_signs = np.ones(self.batch) if belief.stop_sign is None else np.asarray(belief.stop_sign)
            self.put("seen.sign", np.where(scene_mask, known_signs, self.array("seen.sign")).astype(np.int32))
        self.put("seen.believes", believes.astype(np.int32))

    def _put_rows(self, name: str, value: npt.NDArray[Any], scenes: Bool) -> None:
        """Fill the rows that hold a belief and clear the remaining ones."""
        array = self.array(f"seen.{name}")
        end = self.agents + value.shape[1]
        array[scenes, self.agents : end] = value[scenes]
        if name == "kind":
            # Rows of an earlier, larger belief must not be planned over.
            array[scenes, end:] = AgentKind.NONE
        if self.device != "cpu":
            self.put(f"seen.{name}", array)

    def truth(self) -> Belief:
        """Return the true state as a belief [B, A]: handed in unchanged, it changes no agent's driving.

        Row i is agent i. The row of the ego itself is not used, nor are the rows of ended scenes.
        """
        self._see.launch()
        all_arrays = {name: self.array(f"seen.{name}") for name in _SEEN}
        agent_arrays = {
            name: values[:, : self.agents].copy() for name, values in all_arrays.items() if name not in _OF_SCENES
        }
        agent_arrays["kind"][:, 0] = AgentKind.NONE
        agent_arrays["kind"][self.ended() != 0] = AgentKind.NONE
        return Belief(
            pose=agent_arrays["pose"],
            speed=agent_arrays["speed"],
            size=np.float32(2.0) * agent_arrays["half"],
            kind=agent_arrays["kind"],
            forecast=agent_arrays["forecast"],
            way=agent_arrays["way"],
            line_signal=agent_arrays["signal"],
            standing_time=agent_arrays["waited"],
            gives_way=agent_arrays["gives_way"] != 0,
            change=agent_arrays["change"],
            height=agent_arrays["height"],
        )

    def state(self) -> WorldState:
        """State of all agents; see `WorldState`. On CPU most arrays are views that hold until the next step."""
        constants = self._fixed
        time = self.array("step") * self.dt
        return WorldState(
            time=time,
            pose=self.array("pose"),
            speed=self.array("speed"),
            accel=self.array("accel"),
            active=self.array("active") != Presence.ABSENT,
            kind=constants["kind"],
            size=constants["size"],
            control=self.array("control"),
            controller=self.array("controller"),
            policy=self.array("policy"),
            target_speed=self.array("cruise"),
            touch=self.array("touch"),
            lane=self.array("lane"),
            route=constants["route"],
            progress=self.array("progress"),
            roads=self.bank.tables,
            signals=lambda: self._signals(time),
            contact=self.array("ego.contact").astype(np.uint8),
            contact_agent=self.array("ego.contact_agent"),
            off_road=self.array("ego.off_road") != 0,
            route_distance=self.array("ego.route_distance"),
            route_point=self.array("ego.route_point"),
            route_complete=self.array("ego.complete"),
            driven=self.array("ego.driven"),
            lane_invasion=self.array("ego.invasion").astype(np.uint8),
            # 2 marks a line already counted in the step before
            red_light=(self.array("ego.red_light") == 1).astype(np.uint8),
            stop_sign=self.array("ego.stop_sign").astype(np.uint8),
            note=self.array("note"),
            turn_signals=self._turn_signals,
        )

    def _turn_signals(self) -> I8:
        """Return `TurnSignal` [B, A]."""
        constants = self._fixed
        route, controller = constants["route"], self.array("controller")
        point = route[..., 0] + self.array("progress")
        return turn_signals(
            shift=self.array("shift"),
            along=self.array("aim")[..., 0],
            speed=self.array("speed"),
            junction_distance=self.bank.tables.rule[point, 2],
            turn=self.bank.turn[point],
            half_length=np.float32(0.5) * constants["size"][..., 0],
            indicates=(controller == Controller.AUTOPILOT)
            & (route[..., 1] > 1)
            & (constants["kind"] != AgentKind.WALKER)
            & (self.array("active") == Presence.AWAKE),
        )

    def _signals(self, time: npt.NDArray[np.float64]) -> U8:
        """Return `SignalState` [B, S], computed once for scenes that run one episode and are at the same step."""
        lookup_keys = self.array("step").astype(np.int64) * len(self.episodes) + self.array("episode")
        _, first_scenes, inverse = np.unique(lookup_keys, return_index=True, return_inverse=True)
        program, forced, until = self._lamps
        # Gathering the distinct scenes pays off only where many of them share one key.
        if 2 * len(first_scenes) > len(time):
            return signal_states(program, forced, until, time)
        return signal_states(program[first_scenes], forced[first_scenes], until[first_scenes], time[first_scenes])[
            inverse
        ]

    def _script_size(self, scene: int, name: str) -> int:
        """Return the number of phases, or words of history, that a scene uses."""
        sizes = self.bank.script_sizes[self.array("episode")[scene]]
        return int(sizes[1 if name == "script.history" else 0])

    def ended(self) -> npt.NDArray[np.int32]:
        """Return `End` [B], index into ENDS."""
        return self.array("end")

    def snapshot(self) -> Snapshot:
        """Copy everything that changes."""
        arrays = {name: self.array(name).copy() for name in self.names}
        if self.array("seen.believes").any():
            arrays |= {f"seen.{name}": self.array(f"seen.{name}").copy() for name in _SEEN}
        return Snapshot(arrays)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this world. Raises ConfigError if its shape does not fit."""
        groups = (("noise", bool(self._noisy)), ("script", self._scripted), ("walk", self._walks))
        for group, is_present in groups:
            if any(name.startswith(f"{group}.") for name in snapshot.arrays) != is_present:
                raise ConfigError(f"snapshot does not fit this world: only one of them has {group}")
        saved_rows = max(np.shape(snapshot.arrays.get("seen.kind", self.array("pose")))[1] - self.agents, 0)
        if saved_rows > self.belief_capacity:
            self._make_room(saved_rows)
        for name, value in snapshot.arrays.items():
            current = self.array(name)
            arrays = value
            if name.startswith("seen.") and value.ndim > 1 and current.shape[1] > value.shape[1]:
                arrays = current.copy()  # there is more room by now
                arrays[:, : value.shape[1]] = value
                if name == "seen.kind":
                    arrays[:, value.shape[1] :] = AgentKind.NONE
            if current.shape != arrays.shape:
                raise ConfigError(f"snapshot does not fit this world: {name} has shape {value.shape}")
            self.put(name, arrays)
        if "seen.believes" not in snapshot.arrays:
            self.put("seen.believes", np.zeros(self.batch, np.int32))
        self._forget()

    def hashes(self) -> list[str]:
        """Return one hash per scene over everything that changes, except its place in the batch and the bank."""
        arrays = {name: self.array(name) for name in self.names if name != "episode"}
        believes = self.array("seen.believes")
        object_arrays = [self.array(f"seen.{name}") for name in _SEEN if name not in _OF_SCENES]
        kind, signals = self.array("seen.kind"), self.array("seen.light")
        assignment = self.array("episode")
        digests = []
        for scene in range(self.batch):
            occupied = self._fixed["kind"][scene] != AgentKind.NONE
            hasher = hashlib.sha256()
            for name, values in arrays.items():
                scene_values = values[scene]
                if name == "pending" and not scene_values.any():
                    # hashes are those of before there were drivers that react
                    continue
                if name.startswith(("script.", "walk.")):
                    if not scene_values.any():
                        continue  # a scene without scripts has the hash that it has in a world without scripts
                    if name in ("script.begun", "script.ended", "script.history"):
                        hasher.update(scene_values[: self._script_size(scene, name)].tobytes())
                        continue
                # empty slots that only the batch's widest scene needs do not count
                hasher.update(
                    np.ascontiguousarray(
                        scene_values[occupied]
                        if np.ndim(scene_values) and len(scene_values) == len(occupied)
                        else scene_values
                    ).tobytes()
                )
            if believes[scene]:
                believed_rows = np.flatnonzero(kind[scene, self.agents :]) + self.agents
                for values in object_arrays:
                    hasher.update(np.ascontiguousarray(values[scene, believed_rows]).tobytes())
                hasher.update(
                    signals[scene, : len(self.graphs[self.episodes[assignment[scene]].town].signal_phase)].tobytes()
                )
            digests.append(hasher.hexdigest())
        return digests


def signal_states(program: npt.NDArray[np.float64], forced: I32, until: F32, time: npt.NDArray[np.float64]) -> U8:
    """Evaluate signals on the host, equivalent to `kernels.shared.signal_state`.

    Args:
        program: [B, S, 4] cycle, start of green, green, yellow, s.
        forced: [B, S] forced states, -1: none.
        until: [B] time until which they are forced, s.
        time: [B] s.

    Returns:
        `SignalState` [B, S].
    """
    cycle, green_start, green, yellow = (program[..., column] for column in range(4))
    phase = (time[:, None] - green_start) % np.maximum(cycle, 1e-9)
    state = np.where(phase < green + yellow, SignalState.YELLOW, SignalState.RED)
    state = np.where(phase < green, SignalState.GREEN, state)
    state = np.where(cycle > 0, state, SignalState.OFF)
    return np.where((forced >= 0) & (time < until)[:, None], forced, state).astype(np.uint8)
