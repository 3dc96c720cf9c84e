"""The embedded world: B scenes of A agents advance together at 10 Hz, on CPU or CUDA, the same every time."""

from __future__ import annotations

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
from ssad.core.machine import quiet_warp
from ssad.core.types import F32, I32, U8, AgentKind, Bool, Controller, Episode, Model, SignalState
from ssad.world.belief import Lanes, check, complete, lanes_of, rested
from ssad.world.episode_arrays import build
from ssad.world.kernels.belief import see
from ssad.world.kernels.data import BLOCK, HORIZON, Ego, Presence, Seen, State, Work, array_types
from ssad.world.kernels.drive import drive
from ssad.world.kernels.motion import move
from ssad.world.kernels.noise import calm, chance
from ssad.world.kernels.overtake import change_lanes
from ssad.world.kernels.record import contact, record, restart, restart_record
from ssad.world.kernels.traffic import meet, sight
from ssad.world.models import MODELS
from ssad.world.noise import NAMES, Keys, Noise, episode_keys, noise_state

VERSION = "6"  # part of every cell's key: raise it when the same episode no longer gives the same bits

_STATE, _SEEN, _EGO = array_types(State), array_types(Seen), array_types(Ego)
_OF_SCENES = ("believes", "told", "light", "sign")  # arrays of `Seen` that have no rows of objects


@dataclass(frozen=True)
class Snapshot:
    """Everything that changes in a world, copied to the host; equal snapshots continue equally."""

    arrays: Mapping[str, npt.NDArray[np.generic]]


class World:
    """Episodes run side by side: the `Simulator` of `ssad.core.driving`, and `Reproducible`.

    `episodes` are the bank; scene b runs episode `assign[b]` (default: one scene an episode). `graphs` maps each
    town named by them to its lane graph. `ego` replaces every ego's controller; `models` are the bodies. With
    `autoreset` a scene whose episode has ended starts it again at the next step. A scene's bits depend on its episode
    and controls alone: not on the batch, its order, or what the other scenes do. `noise` brings chance into traffic,
    from a key that each scene has (`rekey`); without it there is none.

    Raises ConfigError for an episode that cannot be built.
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
        quiet_warp()
        self.episodes = tuple(episodes)
        self.graphs: Mapping[str, LaneGraph] = dict(graphs)
        self.dt = dt
        self.device = device
        self.bank = build(self.episodes, graphs, device, ego, models)
        self.agents = self.bank.agents
        order = np.arange(len(self.episodes)) if assign is None else np.asarray(assign)
        if len(order) == 0 or order.min() < 0 or order.max() >= len(self.episodes):
            raise ConfigError(f"scenes must be assigned episodes 0 to {len(self.episodes) - 1}")
        self.batch = len(order)
        if self.batch * self.agents**2 >= 1 << 29:
            raise ConfigError(f"{self.batch} scenes of {self.agents} agents are too many for one world")
        self.believed = 0  # room for objects of a belief in each scene
        self._views: dict[str, npt.NDArray[Any]] = {}
        self.arrays = State()
        shape = (self.batch, self.agents, HORIZON)
        for name, array in _STATE.items():
            setattr(self.arrays, name, wp.zeros(shape[: array.ndim], dtype=array.dtype, device=device))
        self.seen = Seen()
        self._lanes: dict[str, Lanes] = {}
        self.ego = Ego()
        for name, array in _EGO.items():
            setattr(self.ego, name, wp.zeros(self.batch, dtype=array.dtype, device=device))
        flat = (self.batch, self.agents)
        self.controls = wp.zeros(flat, dtype=wp.vec4, device=device)
        self.places = wp.zeros(flat, dtype=wp.vec4, device=device)
        self._mask = wp.zeros(self.batch, dtype=wp.int32, device=device)
        self.work = Work()
        self.work.count = wp.zeros(1, dtype=wp.int32, device=device)
        self.work.leader = wp.zeros((self.batch, self.agents), dtype=wp.int32, device=device)
        self._settings = (dt, substeps, autoreset)
        self.chance = noise
        if noise is not None:
            self.noise = noise_state(noise, self.episodes, order.astype(np.int32), self.agents, device)
        self._assign(order.astype(np.int32))
        self._make_room(0)
        self.reset()

    def _make_room(self, believed: int) -> None:
        """Room for that many objects of a belief in each scene, and the launches of a step, which refer to it."""
        rows = self.agents + believed
        if self.batch * self.agents * rows >= 1 << 29:
            raise ConfigError(f"{self.batch} scenes of {self.agents} agents and {believed} objects are too many")
        old = {name: self.array(f"seen.{name}").copy() for name in _SEEN} if self.believed else {}
        self.believed = believed
        for name, array in _SEEN.items():
            shape = {
                "believes": (self.batch,),
                "told": (self.batch,),
                "light": (self.batch, self.bank.forced.shape[1]),
            }.get(name, (self.batch, rows, HORIZON)[: array.ndim])
            setattr(self.seen, name, wp.zeros(shape, dtype=array.dtype, device=self.device))
            self._views.pop(f"seen.{name}", None)
        for name, value in old.items():
            new = self.array(f"seen.{name}").copy()
            new[tuple(slice(n) for n in value.shape)] = value
            self.put(f"seen.{name}", new)
        pairs = self.batch * (self.agents * max(self.agents - 1, 1) + believed)
        self.work.pair = wp.zeros(pairs, dtype=wp.int32, device=self.device)
        # one thread walks the list on CPU; on CUDA enough to fill the device
        workers = 1 if self.device == "cpu" else min(pairs, 1 << 21)
        dt, substeps, autoreset = self._settings
        bank, roads, state, seen = self.bank.episodes, self.bank.roads, self.arrays, self.seen

        # threads of a scene: on CPU to begin one costs more than what most of them have to do
        threads = 1 if self.device == "cpu" else self.agents
        few = (self.batch, threads)

        def restarts(ended_too: int) -> list[Any]:
            forget = []
            if self.chance is not None:
                inputs = [state, self.noise, self._mask, ended_too, self.agents, self.chance.stretches]
                forget = [self.launch(calm, self.batch, inputs)]
            return [
                *forget,
                self.launch(restart, few, [bank, roads, state, self._mask, ended_too, self.agents, threads]),
                self.launch(restart_record, self.batch, [bank, roads, state, seen, self.ego, self._mask, ended_too]),
            ]

        self._restart = restarts(0)
        self._see = self.launch(see, few, [bank, roads, state, seen, self.agents, threads, dt])
        self._plan = [
            *(restarts(1) if autoreset else []),
            self._see,
            self.launch(sight, few, [bank, roads, state, seen, self.work, self.agents, rows, threads, dt]),
            self.launch(meet, workers, [bank, roads, state, seen, self.work, self.agents, rows, workers, dt]),
            self.launch(change_lanes, few, [bank, roads, state, seen, self.work, self.agents, rows, threads]),
            self.launch(drive, few, [bank, roads, state, seen, self.agents, rows, threads, dt]),
        ]
        if self.chance is not None:
            inputs = [bank, roads, state, self.chance.rule(dt), self.noise, self.agents, threads]
            self._plan.append(self.launch(chance, few, inputs))
        self._advance = [
            self.launch(
                move, few, [bank, roads, state, self.controls, self.places, self.agents, threads, dt, substeps]
            ),
            self.launch(contact, few, [bank, roads, state, self.work, self.agents, threads]),
            self.launch(record, self.batch, [bank, roads, state, self.ego, self.agents, dt]),
        ]
        self._graph: Any = None

    @property
    def names(self) -> tuple[str, ...]:
        """The arrays that say all that changes, as long as no ego plans over a belief."""
        return (*_STATE, *(f"ego.{name}" for name in _EGO), *(f"noise.{name}" for name in self._noisy))

    @property
    def _noisy(self) -> tuple[str, ...]:
        return () if self.chance is None else NAMES

    def launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> Any:
        """A recorded launch: its arguments are packed once."""
        # `meet` is faster in blocks of 256, the default; `sight` is in the same module, which is compiled for one size
        block = None if self.device == "cpu" or kernel in (sight, meet) else BLOCK
        return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block, record_cmd=True)

    def _assign(self, order: npt.NDArray[np.int32]) -> None:
        self.put("episode", order)
        self._forget()

    def _forget(self) -> None:
        """What was looked up by episode holds no longer."""
        self.__dict__.pop("_fixed", None)
        self.__dict__.pop("_lamps", None)

    @cached_property
    def _fixed(self) -> dict[str, npt.NDArray[Any]]:
        """What the scenes' episodes say and a step does not change."""
        order = self.array("episode")
        return {"kind": self.bank.kind[order], "size": self.bank.size[order], "route": self.bank.route[order]}

    @cached_property
    def _lamps(self) -> tuple[npt.NDArray[np.float64], I32, F32]:
        """The signals of each scene's town: programmes, forced states, and until when."""
        order = self.array("episode")
        return self.bank.program[order], self.bank.forced[order], self.bank.until[order]

    @property
    def assigned(self) -> I32:
        """[B] number of the episode that each scene runs."""
        return self.array("episode").copy()

    def array(self, name: str) -> npt.NDArray[Any]:
        """A state or ego array by name as numpy: a view on CPU, a copy on CUDA.

        Ego's come as `ego.<name>`, those of `Seen` as `seen.<name>`.
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
        part, _, own = name.rpartition(".")
        if part == "noise":
            return getattr(self.noise, own)
        return getattr({"": self.arrays, "ego": self.ego, "seen": self.seen}[part], own)

    def put(self, name: str, value: npt.NDArray[Any]) -> None:
        """Fill the array that `array` reads."""
        if self.device == "cpu":
            self.array(name)[...] = value
        else:
            self._source(name).assign(value)

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Start the given scenes (default: all) again, with other episodes of the bank if given."""
        which = np.arange(self.batch) if scenes is None else np.asarray(scenes, np.int64)
        if episodes is not None:
            order = self.assigned
            order[which] = episodes
            if len(order) and (order.min() < 0 or order.max() >= len(self.episodes)):
                raise ConfigError(f"no such episode; the bank holds {len(self.episodes)}")
            self._assign(order)
        mask = np.zeros(self.batch, np.int32)
        mask[which] = 1
        self._mask.assign(mask)
        for command in self._restart:
            command.launch()
        if self.chance is not None and episodes is not None:
            self.rekey(episode_keys(self.episodes)[np.asarray(episodes)], which)

    def rekey(self, keys: Keys, scenes: Scenes | None = None) -> None:
        """Give scenes (default: all) other keys: what chance does from now on. ConfigError: the world has no noise."""
        if self.chance is None:
            raise ConfigError("there is no chance in this world: it was made without noise")
        own = self.array("noise.key").copy()
        own[np.arange(self.batch) if scenes is None else np.asarray(scenes)] = keys
        self.put("noise.key", own)

    def set_controls(self, controls: npt.ArrayLike) -> None:
        """Controls of external agents: [B, 3|4] for the egos or [B, A, 3|4] for all; throttle, brake, steer, reverse.

        Raises ConfigError for a wrong shape or a number that is not finite.
        """
        given = np.asarray(controls, np.float32)
        full = np.zeros((self.batch, self.agents, 4), np.float32)
        if given.ndim == 2 and given.shape[0] == self.batch and given.shape[1] in (3, 4):
            full[:, 0, : given.shape[1]] = given
        elif given.ndim == 3 and given.shape[:2] == full.shape[:2] and given.shape[2] in (3, 4):
            full[..., : given.shape[2]] = given
        else:
            raise ConfigError(
                f"controls have shape {given.shape}; expected ({self.batch}, 3) or "
                f"({self.batch}, {self.agents}, 3): throttle, brake, steer"
            )
        if not np.isfinite(full).all():
            raise ConfigError("controls hold a number that is not finite")
        self.put("controls", full)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by dt; ended scenes stand still (or start again, with `autoreset`)."""
        if controls is not None:
            self.set_controls(controls)
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self.plan()
        self.advance()

    def plan(self) -> None:
        """First half of a step: what everybody does whom the world drives."""
        for command in self._plan:
            command.launch()

    def advance(self) -> None:
        """Second half of a step: motion, contacts, the record of the egos."""
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
        """Let somebody else drive agents [B, A] from now on, or (None) give them back to what their episode says.

        Who is given back looks for its place on its route anew, since it may have been driven past it. Raises
        ConfigError for a mask of another shape.
        """
        mask = np.asarray(agents, bool)
        if mask.shape != (self.batch, self.agents):
            raise ConfigError(f"a mask of agents has shape {mask.shape}; expected ({self.batch}, {self.agents})")
        mask = mask & (self._fixed["kind"] != AgentKind.NONE)
        order = self.assigned
        new: dict[str, Any] = {"controller": controller, "policy": policy, "cruise": target_speed}
        if controller is None:
            start = self.bank.episodes
            new = {"controller": start.controller.numpy()[order], "cruise": start.cruise.numpy()[order][..., 0]}
            new |= {"policy": -1, "progress": self._places_on_routes(mask)}
        active = self.array("active")
        new["active"] = np.where(active == Presence.ASLEEP, int(Presence.AWAKE), active)
        for name, value in new.items():
            if value is not None:
                self.put(name, np.where(mask, value, self.array(name)).astype(self.array(name).dtype))

    def _places_on_routes(self, mask: Bool) -> I32:
        """`progress` [B, A], for the agents of the mask the nearest point of all the rest of their routes."""
        progress: I32 = self.array("progress").copy()
        pose, route = self.array("pose"), self._fixed["route"]
        for b, i in np.argwhere(mask).tolist():
            first, count = route[b, i].tolist()
            if count > 1:
                here = int(progress[b, i])
                rest = self.bank.tables.path[first + here : first + count, :2]
                progress[b, i] = here + int(np.argmin(((rest - pose[b, i, :2]) ** 2).sum(1)))
        return progress

    def keep_note(self, note: I32) -> None:
        """Keep what a selector notes on agents, [B, A]; 0 again when a scene starts again."""
        self.put("note", np.asarray(note, np.int32))

    def remove(self, agents: Bool) -> None:
        """Take agents [B, A] out of their scenes, until these start again; also those that follow a trajectory."""
        gone, controller = np.asarray(agents, bool), self.array("controller")
        follows = gone & (controller == Controller.TRAJECTORY)  # would be back in the next step
        for name, where, value in (("active", gone, Presence.ABSENT), ("controller", follows, Controller.NONE)):
            old = self.array(name)
            self.put(name, np.where(where, int(value), old).astype(old.dtype))

    def place(self, places: npt.ArrayLike) -> None:
        """Where agents whose controller is PLACED are at the end of the next step: [B, A, 4] x, y, yaw, speed.

        Raises ConfigError for a wrong shape or a number that is not finite.
        """
        given = np.asarray(places, np.float32)
        if given.shape != (self.batch, self.agents, 4) or not np.isfinite(given).all():
            raise ConfigError(f"places must be ({self.batch}, {self.agents}, 4) finite numbers: x, y, yaw, speed")
        self.put("places", given)

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Hand in what egos believe, over which their Autopilot plans until the next one or until the scene restarts.

        Args:
            belief: [B, K]. None: the truth again.
            scenes: [B] whose egos believe it; None: all.

        Raises:
            ConfigError: An array is of another shape, or a number that counts is not finite.
        """
        which = np.ones(self.batch, bool) if scenes is None else np.asarray(scenes, bool)
        if which.shape != (self.batch,):
            raise ConfigError(f"a mask of scenes has shape {which.shape}; expected ({self.batch},)")
        believes = np.where(which, belief is not None, self.array("seen.believes"))
        if belief is not None:
            light = self.array("seen.light")
            check(belief, self.batch, light.shape[1], which)
            towns = [self.episodes[k].town for k in self.array("episode")]
            rows = complete(belief, lanes_of(self.graphs, towns, self._lanes), which)
            step = self.array("step")
            if belief.stood is None:
                old = {
                    name: self.array(f"seen.{name}")[:, self.agents :] for name in ("pose", "speed", "kind", "waited")
                }
                old["kind"] = np.where(self.array("seen.believes")[:, None], old["kind"], AgentKind.NONE)
                rows["waited"] = rested(rows, old, self.dt * (step - self.array("seen.told")))
            count = rows["kind"].shape[1]
            if count > self.believed:
                self._make_room(-(-count // 16) * 16)
            for name, value in rows.items():
                self._put_rows(name, value, which)
            told = np.full(light.shape, -1) if belief.signal is None else np.asarray(belief.signal)
            self.put("seen.told", np.where(which, step, self.array("seen.told")).astype(np.int32))
            self.put("seen.light", np.where(which[:, None], told, light).astype(np.int32))
            known = np.ones(self.batch) if belief.stop_sign is None else np.asarray(belief.stop_sign)
            self.put("seen.sign", np.where(which, known, self.array("seen.sign")).astype(np.int32))
        self.put("seen.believes", believes.astype(np.int32))

    def _put_rows(self, name: str, value: npt.NDArray[Any], scenes: Bool) -> None:
        """Fill the rows that hold a belief; those that are left over hold nobody."""
        array = self.array(f"seen.{name}")
        end = self.agents + value.shape[1]
        array[scenes, self.agents : end] = value[scenes]
        if name == "kind":
            array[scenes, end:] = AgentKind.NONE
        if self.device != "cpu":
            self.put(f"seen.{name}", array)

    def truth(self) -> Belief:
        """The truth as a belief [B, A]: handed in as it is, nobody drives otherwise. Row i is agent i.

        The row of the ego itself is not used, nor those of scenes that have ended.
        """
        self._see.launch()
        seen = {name: self.array(f"seen.{name}") for name in _SEEN}
        own = {name: a[:, : self.agents].copy() for name, a in seen.items() if name not in _OF_SCENES}
        own["kind"][:, 0] = AgentKind.NONE
        own["kind"][self.ended() != 0] = AgentKind.NONE
        return Belief(
            pose=own["pose"],
            speed=own["speed"],
            size=np.float32(2.0) * own["half"],
            kind=own["kind"],
            forecast=own["forecast"],
            way=own["way"],
            line_signal=own["signal"],
            stood=own["waited"],
            gives_way=own["gives_way"] != 0,
            change=own["change"],
            height=own["height"],
        )

    def state(self) -> WorldState:
        """Where everybody is; see `WorldState`. On CPU most arrays are views that hold until the next step."""
        fixed = self._fixed
        time = self.array("step") * self.dt
        return WorldState(
            time=time,
            pose=self.array("pose"),
            speed=self.array("speed"),
            accel=self.array("accel"),
            active=self.array("active") != Presence.ABSENT,
            kind=fixed["kind"],
            size=fixed["size"],
            control=self.array("control"),
            controller=self.array("controller"),
            policy=self.array("policy"),
            target_speed=self.array("cruise"),
            touch=self.array("touch"),
            lane=self.array("lane"),
            route=fixed["route"],
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
        )

    def _signals(self, time: npt.NDArray[np.float64]) -> U8:
        """`SignalState` [B, S]: once for scenes that run one episode and are at the same step."""
        key = self.array("step").astype(np.int64) * len(self.episodes) + self.array("episode")
        _, first, same = np.unique(key, return_index=True, return_inverse=True)
        program, forced, until = self._lamps
        if 2 * len(first) > len(time):
            return signal_states(program, forced, until, time)
        return signal_states(program[first], forced[first], until[first], time[first])[same]

    def ended(self) -> npt.NDArray[np.int32]:
        """[B] `End`, index into ENDS."""
        return self.array("end")

    def snapshot(self) -> Snapshot:
        """Copy of all that changes."""
        arrays = {name: self.array(name).copy() for name in self.names}
        if self.array("seen.believes").any():
            arrays |= {f"seen.{name}": self.array(f"seen.{name}").copy() for name in _SEEN}
        return Snapshot(arrays)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this world; raises ConfigError if it is of another shape."""
        if any(name.startswith("noise.") for name in snapshot.arrays) != bool(self._noisy):
            raise ConfigError("snapshot does not fit this world: only one of them has noise")
        believed = max(np.shape(snapshot.arrays.get("seen.kind", self.array("pose")))[1] - self.agents, 0)
        if believed > self.believed:
            self._make_room(believed)
        for name, value in snapshot.arrays.items():
            old = self.array(name)
            new = value
            if name.startswith("seen.") and value.ndim > 1 and old.shape[1] > value.shape[1]:
                new = old.copy()  # there is more room by now
                new[:, : value.shape[1]] = value
                if name == "seen.kind":
                    new[:, value.shape[1] :] = AgentKind.NONE
            if old.shape != new.shape:
                raise ConfigError(f"snapshot does not fit this world: {name} has shape {value.shape}")
            self.put(name, new)
        if "seen.believes" not in snapshot.arrays:
            self.put("seen.believes", np.zeros(self.batch, np.int32))
        self._forget()

    def hashes(self) -> list[str]:
        """One hash a scene over all that changes (but its place in the batch and bank)."""
        arrays = {name: self.array(name) for name in self.names if name != "episode"}
        believes = self.array("seen.believes")
        rows = [self.array(f"seen.{name}") for name in _SEEN if name not in _OF_SCENES]
        kind, light = self.array("seen.kind"), self.array("seen.light")
        order = self.array("episode")
        out = []
        for b in range(self.batch):
            live = self._fixed["kind"][b] != AgentKind.NONE
            h = hashlib.sha256()
            for name, a in arrays.items():
                row = a[b]
                if name == "since" and not row.any():
                    continue  # no phase waits for another: hashes are those of before some could
                # empty slots that only the batch's widest scene needs do not count
                h.update(np.ascontiguousarray(row[live] if np.ndim(row) and len(row) == len(live) else row).tobytes())
            if believes[b]:
                used = np.flatnonzero(kind[b, self.agents :]) + self.agents
                for a in rows:
                    h.update(np.ascontiguousarray(a[b, used]).tobytes())
                h.update(light[b, : len(self.graphs[self.episodes[order[b]].town].signal_phase)].tobytes())
            out.append(h.hexdigest())
        return out


def signal_states(program: npt.NDArray[np.float64], forced: I32, until: F32, time: npt.NDArray[np.float64]) -> U8:
    """`SignalState` [B, S] at `time` [B] s: the host's twin of kernels.shared.signal_state.

    program [B, S, 4], forced [B, S] and until [B] as in `Bank`.
    """
    cycle, begin, green, yellow = (program[..., k] for k in range(4))
    phase = (time[:, None] - begin) % np.maximum(cycle, 1e-9)
    state = np.where(phase < green + yellow, SignalState.YELLOW, SignalState.RED)
    state = np.where(phase < green, SignalState.GREEN, state)
    state = np.where(cycle > 0, state, SignalState.OFF)
    return np.where((forced >= 0) & (time < until)[:, None], forced, state).astype(np.uint8)
