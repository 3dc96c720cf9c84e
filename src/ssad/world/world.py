"""The embedded world: B scenes of A agents advance together at 10 Hz, on CPU or CUDA, the same every time."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, Controller, Episode, SignalState
from ssad.world.episode_arrays import agent_kinds, build, signal_programs
from ssad.world.kernels.data import HORIZON, Ego, End, State, Work, array_types
from ssad.world.kernels.drive import drive
from ssad.world.kernels.look import OBSERVATION, look
from ssad.world.kernels.motion import move
from ssad.world.kernels.record import contact, record, restart, restart_record
from ssad.world.kernels.traffic import meet, sight

# names of `End` in traces; "" while the episode runs
ENDS = tuple("" if end == End.RUNNING else end.name.lower() for end in End)
VERSION = "1"  # part of every cell's key: raise it when the same episode no longer gives the same bits

_STATE, _EGO = array_types(State), array_types(Ego)


@dataclass(frozen=True)
class Snapshot:
    """Everything that changes in a world, copied to the host; equal snapshots continue equally."""

    arrays: Mapping[str, npt.NDArray[np.generic]]


class World:
    """Episodes run side by side.

    `episodes` are the bank; scene b runs episode `assign[b]` (default: one scene an episode). `graphs` maps each
    town named by them to its lane graph. `ego` and `ego_speed` replace every ego's
    controller and target speed. With `autoreset` a scene whose
    episode has ended starts it again at the next step. A scene's bits depend on its episode and actions alone: not on
    the batch, its order, or what the other scenes do. Raises ConfigError for an episode that cannot be built.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        assign: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
        device: str = "cpu",
        dt: float = 0.1,
        substeps: int = 2,
        ego: Controller | None = None,
        ego_speed: float | None = None,
        autoreset: bool = False,
    ) -> None:
        if dt <= 0.0 or substeps < 1:
            raise ConfigError(f"a world needs dt > 0 and substeps >= 1, not {dt} and {substeps}")
        wp.init()
        self.episodes = tuple(episodes)
        self.graphs = dict(graphs)
        self.dt = dt
        self.device = device
        self.bank, self.roads, self.agents = build(self.episodes, graphs, device, ego, ego_speed)
        order = np.arange(len(self.episodes)) if assign is None else np.asarray(assign)
        if len(order) == 0 or order.min() < 0 or order.max() >= len(self.episodes):
            raise ConfigError(f"scenes must be assigned episodes 0 to {len(self.episodes) - 1}")
        self.batch = len(order)
        if self.batch * self.agents**2 >= 1 << 29:
            raise ConfigError(f"{self.batch} scenes of {self.agents} agents are too many for one world")
        self.state = State()
        shape = (self.batch, self.agents, HORIZON)
        for name, array in _STATE.items():
            setattr(self.state, name, wp.zeros(shape[: array.ndim], dtype=array.dtype, device=device))
        self.ego = Ego()
        for name, array in _EGO.items():
            setattr(self.ego, name, wp.zeros(self.batch, dtype=array.dtype, device=device))
        self.actions = wp.zeros((self.batch, self.agents), dtype=wp.vec4, device=device)
        self.observation = wp.zeros((self.batch, OBSERVATION), dtype=wp.float32, device=device)
        self._mask = wp.zeros(self.batch, dtype=wp.int32, device=device)
        self.work = Work()
        self.work.count = wp.zeros(1, dtype=wp.int32, device=device)
        pairs = self.batch * self.agents * max(self.agents - 1, 1)
        self.work.pair = wp.zeros(pairs, dtype=wp.int32, device=device)
        # one thread walks the list on CPU; on CUDA enough to fill the device
        workers = 1 if device == "cpu" else min(pairs, 1 << 21)
        self._kinds = agent_kinds(self.bank)
        self._assign(order.astype(np.int32))
        flat = (self.batch, self.agents)
        again = [self.bank, self.roads, self.state, self.ego, self._mask]
        restarts = ((restart, flat), (restart_record, self.batch))
        self._restart = [self._launch(kernel, dim, [*again, 0]) for kernel, dim in restarts]
        self._step = [self._launch(kernel, dim, [*again, 1]) for kernel, dim in restarts] if autoreset else []
        self._step += [
            self._launch(sight, flat, [self.bank, self.roads, self.state, self.work, self.agents, dt]),
            self._launch(meet, workers, [self.bank, self.roads, self.state, self.work, self.agents, workers]),
            self._launch(drive, flat, [self.bank, self.roads, self.state, dt]),
            self._launch(move, flat, [self.bank, self.roads, self.state, self.actions, dt, substeps]),
            self._launch(contact, flat, [self.bank, self.state, self.work, self.agents]),
            self._launch(record, self.batch, [self.bank, self.roads, self.state, self.ego, self.agents, dt]),
        ]
        self._look = self._launch(
            look, self.batch, [self.bank, self.roads, self.state, self.ego, self.agents, self.observation]
        )
        self._graph: Any = None
        self.reset()

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> Any:
        """A recorded launch: its arguments are packed once."""
        return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True)

    def _assign(self, order: npt.NDArray[np.int32]) -> None:
        self.state.episode.assign(order)
        self.kind = self._kinds[order]

    def array(self, name: str) -> npt.NDArray[Any]:
        """A state or ego array by name as numpy: a view on CPU, a copy on CUDA. Ego's come as `ego.<name>`."""
        out: npt.NDArray[Any] = self._source(name).numpy()
        return out

    def _source(self, name: str) -> Any:
        return getattr(self.ego, name[4:]) if name.startswith("ego.") else getattr(self.state, name)

    def reset(
        self,
        scenes: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
        *,
        episodes: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
    ) -> None:
        """Start the given scenes (default: all) again, with other episodes of the bank if given."""
        which = np.arange(self.batch) if scenes is None else np.asarray(scenes, np.int64)
        if episodes is not None:
            order = self.state.episode.numpy().copy()
            order[which] = episodes
            if len(order) and (order.min() < 0 or order.max() >= len(self.episodes)):
                raise ConfigError(f"no such episode; the bank holds {len(self.episodes)}")
            self._assign(order)
        mask = np.zeros(self.batch, np.int32)
        mask[which] = 1
        self._mask.assign(mask)
        for command in self._restart:
            command.launch()

    def set_actions(self, actions: npt.ArrayLike) -> None:
        """Controls of external agents: [B, 3|4] for the egos or [B, A, 3|4] for all; throttle, brake, steer, reverse.

        Raises ConfigError for a wrong shape or a number that is not finite.
        """
        given = np.asarray(actions, np.float32)
        full = np.zeros((self.batch, self.agents, 4), np.float32)
        if given.ndim == 2 and given.shape[0] == self.batch and given.shape[1] in (3, 4):
            full[:, 0, : given.shape[1]] = given
        elif given.ndim == 3 and given.shape[:2] == full.shape[:2] and given.shape[2] in (3, 4):
            full[..., : given.shape[2]] = given
        else:
            raise ConfigError(
                f"actions have shape {given.shape}; expected ({self.batch}, 3) or "
                f"({self.batch}, {self.agents}, 3): throttle, brake, steer"
            )
        if not np.isfinite(full).all():
            raise ConfigError("actions hold a number that is not finite")
        self.actions.assign(full)

    def step(self, actions: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by dt; ended scenes stand still (or start again, with `autoreset`)."""
        if actions is not None:
            self.set_actions(actions)
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        for command in self._step:
            command.launch()

    def capture(self, *, observe: bool = False, steps: int = 1) -> None:
        """Record `steps` steps (and the observation) as one CUDA graph that `step` replays; CUDA only."""
        with wp.ScopedCapture(device=self.device) as recorded:
            for _ in range(steps):
                for command in self._step:
                    command.launch()
                if observe:
                    self._look.launch()
        self._graph = recorded.graph

    def observe(self) -> npt.NDArray[np.float32]:
        """Observation rows [B, 28] of the egos: see kernels.look."""
        self._look.launch()
        out: npt.NDArray[np.float32] = self.observation.numpy()
        return out

    def ended(self) -> npt.NDArray[np.int32]:
        """[B] `End`, index into ENDS."""
        return self.array("end")

    def signals(self, scene: int) -> npt.NDArray[np.uint8]:
        """`SignalState` of every signal of the scene's town at its present time, [S]."""
        episode = self.episodes[int(self.array("episode")[scene])]
        time = float(self.array("step")[scene]) * self.dt
        return signal_states(episode, self.graphs[episode.town], np.array([time])).reshape(-1)

    def snapshot(self) -> Snapshot:
        """Copy of all that changes."""
        arrays = {name: self.array(name).copy() for name in _STATE}
        arrays |= {f"ego.{name}": self.array(f"ego.{name}").copy() for name in _EGO}
        return Snapshot(arrays)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this world; raises ConfigError if it is of another shape."""
        for name, value in snapshot.arrays.items():
            target = self._source(name)
            if tuple(target.numpy().shape) != value.shape:
                raise ConfigError(f"snapshot does not fit this world: {name} has shape {value.shape}")
            target.assign(value)
        self.kind = self._kinds[self.array("episode")]

    def hashes(self) -> list[str]:
        """One hash a scene over all that changes (but its place in the batch and bank)."""
        arrays = [self.array(name) for name in _STATE if name != "episode"]
        arrays += [self.array(f"ego.{name}") for name in _EGO]
        out = []
        for b in range(self.batch):
            live = self.kind[b] != AgentKind.NONE
            h = hashlib.sha256()
            for a in arrays:
                row = a[b]
                # empty slots that only the batch's widest scene needs do not count
                h.update(np.ascontiguousarray(row[live] if np.ndim(row) and len(row) == len(live) else row).tobytes())
            out.append(h.hexdigest())
        return out


def signal_states(episode: Episode, graph: LaneGraph, times: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """`SignalState` [T, S] of a town's signals at `times` [T] s: the host's twin of kernels.shared.signal_state."""
    programs = signal_programs(graph)
    out = np.zeros((len(times), len(programs)), np.uint8)
    for s, (cycle, begin, green, yellow) in enumerate(programs):
        if cycle > 0:
            t = (times - begin) % cycle
            then = np.where(t < green + yellow, SignalState.YELLOW, SignalState.RED)
            out[:, s] = np.where(t < green, SignalState.GREEN, then)
    for s, state in episode.signal_override.items():
        out[times < episode.override_until, s] = int(state)
    return out
