"""The driving system that knows of traffic only what its cameras show.

    cameras -> detector -> world -> tracker -> belief -> the Autopilot's planner and controller

Route, lane map and its own pose are given, signals are those of the map, and so are stop signs unless it reads them
itself; other road users are told by detected objects and nothing else. All else is the Autopilot, so that what it
drives worse is what it sees worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.rotations import upright_poses
from ssad.core.types import F32, F64, I32, U8, Controller, Episode
from ssad.drivers.perceiving.eyes import Eyes
from ssad.drivers.perceiving.lift import Lifting, lift, merged
from ssad.drivers.perceiving.objects import I64, Objects, no_objects
from ssad.drivers.perceiving.repair import Repair
from ssad.drivers.perceiving.signs import SignMemory, SignReading, read_signs
from ssad.drivers.perceiving.tracker import Tracker, Tracking, Tracks, believed

LATE = 1e-4  # s, less than a step: times are 32-bit numbers


@dataclass(frozen=True, eq=False)
class Sighting:
    """One look of a scene, for who watches.

    Attributes:
        scene: Which scene.
        time: s when the pictures were taken.
        found: What was found in them, in the world; None: no camera had a picture.
        pictures: What the cameras showed, uint8 [3, H, W] by name, where eyes look at pictures; tensors where pictures
            stay on a GPU.
        signs: Where the stop signs stand that were read, if the driver reads them: x, y in the world [M, 2], m.
        eye: From where: x, y [2].
    """

    scene: int
    time: float
    found: Objects | None
    pictures: Mapping[str, U8] = field(default_factory=dict)
    signs: F64 | None = None
    eye: F64 | None = None


@dataclass(frozen=True, eq=False)
class Known:
    """What is believed at a step, for who watches.

    Attributes:
        scene: [N] the scenes.
        time: [N] s.
        tracks: The confirmed tracks of these scenes at these times.
    """

    scene: I32
    time: F64
    tracks: Tracks


class Perceiving:
    """The Autopilot over what its eyes see.

    Args:
        eyes: What looks.
        lifting: How detections become places.
        tracking: How places become tracks.
        rate: Looks a second; the world has 10 steps a second.
        latency: s from a picture to its detections. Tracks are moved on to the present, so what is late is not
            misplaced, but unknown for so long.
        watch: Told of each look, and at each step of what is believed.
        repair: Repairs one error of what is found, to see what it alone does.
        signs: How it reads stop signs; None: it knows those of the map.

    Raises:
        ConfigError: A value is out of its range.
    """

    name = "perceiving"
    controller = Controller.AUTOPILOT

    def __init__(
        self,
        eyes: Eyes,
        *,
        lifting: Lifting | None = None,
        tracking: Tracking | None = None,
        rate: float = 5.0,
        latency: float = 0.1,
        watch: Callable[[Sighting | Known], None] | None = None,
        repair: Repair | None = None,
        signs: SignReading | None = None,
    ) -> None:
        if not 0.0 < rate <= 1000.0 or not 0.0 <= latency <= 10.0:
            raise ConfigError(f"perceiving needs a rate above 0 and a latency of 0 to 10 s, not {rate} and {latency}")
        self.eyes, self.lifting, self.tracking = eyes, lifting or Lifting(), tracking or Tracking()
        self.rate, self.latency, self.watch = rate, latency, watch
        self.repair = repair
        self.sensors: tuple[str, ...] = tuple(dict.fromkeys((*eyes.sensors, *(("truth",) if repair else ()))))
        self._signs = None if signs is None else SignMemory(signs)
        self._tracker = Tracker(self.tracking, 0)
        self._looks = np.zeros(0, np.int64)
        self._waiting: list[Sighting] = []

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras among its sensors, which the engine makes."""
        return {name: camera for name, camera in self.eyes.cameras.items() if name in self.sensors}

    @property
    def detector(self) -> Any:
        """The detector of its eyes, which attacks ask for; None if they have none."""
        return getattr(self.eyes, "detector", None)

    def to(self, device: str) -> None:
        """Compute on another device, if its eyes can."""
        move = getattr(self.eyes, "to", None)
        if move is not None:
            move(device)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past."""
        self._tracker = Tracker(self.tracking, len(episodes))
        self._looks = np.full(len(episodes), -1)
        self._waiting = []
        if self._signs is not None:
            self._signs.reset(len(episodes))
        self.eyes.reset(episodes)

    def snapshot(self) -> Any:
        """All that changes; with a snapshot of the simulator, `restore` goes on from there to the bit."""
        signs = None if self._signs is None else self._signs.snapshot()
        return self._tracker.snapshot(), self._looks.copy(), list(self._waiting), self.eyes.snapshot(), signs

    def restore(self, snapshot: Any) -> None:
        """Go on from an earlier moment of the same batch."""
        tracks, looks, waiting, eyes, signs = snapshot
        self._tracker.restore(tracks)
        self._looks, self._waiting = looks.copy(), list(waiting)
        self.eyes.restore(eyes)
        if self._signs is not None:
            self._signs.restore(signs)

    def act(self, view: Observation) -> F32:
        """Never called: the planner runs inside the world."""
        raise RuntimeError("the Autopilot runs inside the world")

    def believe(self, view: Observation) -> Belief:
        """What is around the egos, as far as it has been seen."""
        now = view.time.astype(np.float64)
        looks = np.floor((now + LATE) * self.rate).astype(np.int64)
        due = np.flatnonzero(~view.done & (looks > self._looks[view.scene]))
        if len(due):
            self._looks[view.scene[due]] = looks[due]
            self._waiting += self._sightings(view, due, now)
        self._take_in(dict(zip(view.scene.tolist(), now.tolist(), strict=True)))
        tracks = self._tracker.confirmed(view.scene, now)
        if self.watch is not None:
            self.watch(Known(view.scene, now, tracks))
        belief = believed(tracks, view.scene)
        if self._signs is None:
            return belief
        return replace(belief, stop_sign=self._signs.known(view.scene, now, view.pose))

    def _sightings(self, view: Observation, rows: I64, now: F64) -> list[Sighting]:
        """What is seen now in some rows."""
        looked, scenes = self.eyes.look(view, rows), view.scene[rows].astype(np.int64)
        egos = upright_poses(view.pose[rows].astype(np.float64))
        parts, blind, signs = [no_objects()], np.ones(len(rows), bool), [[np.zeros((0, 2))] for _ in rows]
        for name, camera in self.eyes.cameras.items():
            seen = np.array([k for k, one in enumerate(looked[name]) if one is not None], np.int64)
            found, eyes = [one for one in looked[name] if one is not None], egos[seen] @ camera.to_ego
            parts.append(lift(found, camera, eyes, scenes[seen], self.eyes.classes, settings=self.lifting))
            blind[seen] = False
            if self._signs is not None:
                for k, one, at in zip(seen.tolist(), found, eyes, strict=True):
                    signs[k].append(read_signs(one, camera, at, self.eyes.classes, score=self._signs.settings.score))
        together = merged(Objects.joined(parts), self.lifting.merge)
        sightings = []
        for k, row in enumerate(rows.tolist()):
            mine = slice(*np.searchsorted(together.scene, [scenes[k], scenes[k] + 1]))
            all_ = None if blind[k] else together.take(mine)
            if self.repair is not None:
                all_ = self.repair(view, row, all_ or no_objects(), self.eyes.cameras, self.lifting)
            shown = {} if self.watch is None else self._pictures(view, row)
            read = None if self._signs is None else np.concatenate(signs[k])
            sightings.append(Sighting(int(scenes[k]), float(now[row]), all_, shown, read, egos[k, :2, 3]))
            if self.watch is not None:
                self.watch(sightings[-1])
        return sightings

    def _pictures(self, view: Observation, row: int) -> dict[str, U8]:
        """What the cameras showed to a row."""
        return {name: view.readings[name][row] for name in self.cameras}

    def _take_in(self, now: Mapping[int, float]) -> None:
        """Hand the tracker what has arrived, look by look; a look without any picture tells nothing."""
        ready = [s for s in self._waiting if s.scene in now and s.time + self.latency <= now[s.scene] + LATE]
        taken = {id(s) for s in ready}
        self._waiting = [s for s in self._waiting if id(s) not in taken]
        while ready:
            first: dict[int, Sighting] = {}
            for sighting in ready:
                first.setdefault(sighting.scene, sighting)
            ready = [s for s in ready if first[s.scene] is not s]
            batch = [s for s in first.values() if s.found is not None]
            if batch:
                scenes = np.array([s.scene for s in batch])
                times = np.array([s.time for s in batch])
                found = Objects.joined([no_objects(), *(s.found for s in batch if s.found is not None)])
                self._tracker.update(scenes, times, found)
                for one in batch:
                    if self._signs is not None and one.signs is not None and one.eye is not None:
                        self._signs.update(one.scene, one.time, one.eye, one.signs)
