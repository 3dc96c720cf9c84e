"""Conformance tests of the parts of perceiving drivers for the guarantees that the rest of SSAD relies on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np

from ssad.core.driving import Observation, Reproducible, Sensor, Simulator
from ssad.core.errors import ConfigError
from ssad.core.perception import I64, Objects, Tracks, no_objects
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, AgentKind, Episode
from ssad.drivers.perceiving.driver import PerceivedEvent, PerceivingDriver, PerceptionEvent
from ssad.drivers.perceiving.parts import Perceiver, Percepts, Planner, Tracker, restore_part, snapshot_part
from ssad.drivers.perceiving.perceivers import PerfectPerceiver
from ssad.drivers.perceiving.sensors import sensors_of
from ssad.drivers.perceiving.tracks import check_tracks
from ssad.rendering.onboard import Onboard
from ssad.world.rollout import Loop, step_limit

MakeSimulator = Callable[[Sequence[int]], Simulator]
STEP = 0.2  # s between the looks of `check_tracker`
CLOSE = 2.0  # m within which a track counts as that of a car


class PartCheckError(AssertionError):
    """Violation of a guarantee by a part of a perceiving driver; the message names the guarantee."""


def _require(is_met: bool, guarantee: str) -> None:
    if not is_met:
        raise PartCheckError(guarantee)


def check_perceiver(
    make: Callable[[], Perceiver],
    simulator: MakeSimulator,
    *,
    episodes: int,
    steps: int = 12,
    sensors: Mapping[str, Sensor] | None = None,
) -> None:
    """Check that a perceiver keeps its protocol, and that its result depends on the scene alone.

    Args:
        make: Builds the perceiver.
        simulator: Builds a simulator with scene b running episode `assign[b]` of a bank of `episodes`.
        episodes: Number of episodes in the bank; at least 2.
        steps: Number of steps to drive, with a look at each.
        sensors: Sensors that it reads; None: those of its models, rendered on the CPU.

    Raises:
        PartCheckError: A guarantee is broken; the message names it.
    """
    perceiver = make()
    _require(
        isinstance(perceiver, Perceiver),
        "it has the methods and attributes of ssad.drivers.perceiving.parts.Perceiver",
    )
    for attribute in ("sensors", "classes"):
        value = getattr(perceiver, attribute)
        _require(
            not isinstance(value, str) and all(isinstance(name, str) for name in value), f"its {attribute} are names"
        )
    _require(len(perceiver.sensors) > 0, "it reads a sensor")
    assignment = list(range(min(episodes, 3)))

    def run(part: Perceiver, order: Sequence[int]) -> list[list[bytes | None]]:
        return _record_looks(part, simulator(order), steps, sensors)

    reference = run(perceiver, assignment)
    _require(run(perceiver, assignment) == reference, "reset makes it forget: the same again is perceived the same")
    _require(run(make(), assignment[::-1])[::-1] == reference, "the order of scenes does not matter")
    _require(run(make(), assignment[:1]) == reference[:1], "a scene alone is perceived as it is in a batch")
    _require(
        any(look for scene in reference for look in scene),
        "an object is detected, or else nothing is checked: take episodes with one in range, or more steps",
    )
    world = simulator(assignment)
    if isinstance(world, Reproducible):
        _check_snapshot(make(), world, steps, sensors)


def check_tracker(make: Callable[[], Tracker], *, episodes: Sequence[Episode], looks: int = 30) -> None:
    """Check that a tracker keeps its protocol, follows cars that are detected at every look, and predicts them.

    Args:
        make: Builds the tracker.
        episodes: Episodes that it is reset with; at least 2, one for each scene.
        looks: Number of looks, 0.2 s apart, at cars that drive at constant velocities.

    Raises:
        PartCheckError: A guarantee is broken; the message names it.
    """
    _require(len(episodes) >= 2, "there are at least two episodes to check with")
    tracker = make()
    _require(isinstance(tracker, Tracker), "it has the methods of ssad.drivers.perceiving.parts.Tracker")
    scenes = list(range(len(episodes)))

    def run(part: Tracker, order: Sequence[int]) -> list[list[bytes]]:
        part.reset([episodes[scene] for scene in order])
        return _track_scenes(part, order, range(looks))

    reference = run(tracker, scenes)
    _require(run(tracker, scenes) == reference, "reset makes it forget: the same again is tracked the same")
    _require(run(make(), scenes[::-1])[::-1] == reference, "the order of scenes does not matter")
    _require(run(make(), scenes[:1]) == reference[:1], "a scene alone is tracked as it is in a batch")
    _check_following(make(), episodes, looks)

    tracker, half = make(), looks // 2
    tracker.reset(list(episodes))
    _track_scenes(tracker, scenes, range(half))
    saved = snapshot_part(tracker)
    ends = _track_scenes(tracker, scenes, range(half, looks))
    tracker = restore_part(tracker, saved)
    _require(_track_scenes(tracker, scenes, range(half, looks)) == ends, "a restored snapshot continues as before")


def check_planner(make: Callable[[], Planner], simulator: MakeSimulator, *, episodes: int, steps: int = 40) -> None:
    """Check that a planner keeps its protocol, and that its controls depend on the scene alone.

    Args:
        make: Builds the planner; it drives over the belief of a perfect perceiver.
        simulator: As for `check_perceiver`.
        episodes: Number of episodes in the bank; at least 2.
        steps: Number of steps to drive.

    Raises:
        PartCheckError: A guarantee is broken; the message names it.
    """
    planner = make()
    _require(isinstance(planner, Planner), "it has the methods of ssad.drivers.perceiving.parts.Planner")
    assignment = list(range(min(episodes, 4)))

    def run(part: Planner, order: Sequence[int]) -> list[bytes]:
        driver = _ControlledDriver(PerfectPerceiver(), planner=part)
        world = simulator(order)
        loop = Loop(world, {0: driver})
        loop.reset()
        poses = []
        for _ in range(min(steps, step_limit(world))):
            _run_guarded(loop.step)
            poses.append(world.state().pose[:, 0].copy())
        return [np.stack(poses)[:, scene].tobytes() for scene in range(world.batch)]

    reference = run(planner, assignment)
    _require(run(planner, assignment) == reference, "reset makes it forget: the same again is driven the same")
    _require(run(make(), assignment[::-1])[::-1] == reference, "the order of scenes does not matter")
    _require(run(make(), assignment[:1]) == reference[:1], "a scene alone is driven as it is in a batch")


class _ControlledDriver(PerceivingDriver):
    """Driver whose planner's controls are checked."""

    def act(self, view: Observation) -> F32:
        pose = view.pose.copy()
        controls = np.asarray(super().act(view), np.float32)
        _require(controls.ndim == 2 and len(controls) == len(pose), "plan returns [N, 3] for the N egos that it sees")
        running = ~view.done
        _require(bool(np.isfinite(controls[running]).all()), "its controls are finite")
        lower_limits = np.array([0.0, 0.0, -1.0], np.float32)
        in_range = (controls[running, :3] >= lower_limits) & (controls[running, :3] <= 1.0)
        _require(bool(in_range.all()), "its controls are in range")
        _require(bool((view.pose == pose).all()), "it changes nothing that it is given")
        return controls


class _GuardedPerceiver:
    """Perceiver that fails the check if it changes what it is given."""

    def __init__(self, perceiver: Perceiver) -> None:
        self._perceiver = perceiver
        self.name = getattr(perceiver, "name", type(perceiver).__name__)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of a copy whose perceiver is not set yet
            raise AttributeError(name)
        return getattr(self._perceiver, name)

    def perceive(self, view: Observation, rows: I64) -> Percepts:
        inputs = {name: _arrays(view.readings[name]) for name in self._perceiver.sensors}
        inputs |= {"pose": _arrays(view.pose), "rows": _arrays(rows)}
        percepts = self._perceiver.perceive(view, rows)
        inputs_after = {name: _arrays(view.readings[name]) for name in self._perceiver.sensors}
        inputs_after |= {"pose": _arrays(view.pose), "rows": _arrays(rows)}
        _require(inputs_after == inputs, "it changes nothing that it is given")
        return percepts


def _arrays(value: Any) -> list[bytes]:
    """Return the contents of an array, or of the arrays of a dataclass."""
    columns = [getattr(value, column.name) for column in fields(value)] if is_dataclass(value) else [value]
    return [np.asarray(column).tobytes() for column in columns if column is not None]


def _run_guarded(step: Callable[[], None]) -> None:
    """Take a step; an output that the driver refuses is a broken guarantee."""
    try:
        step()
    except ConfigError as error:
        raise PartCheckError(f"what it returns is as its protocol says: {error}") from error


def _make_loop(
    perceiver: Perceiver, world: Simulator, sensors: Mapping[str, Sensor] | None
) -> tuple[Loop, PerceivingDriver, list[list[bytes | None]]]:
    """Return a loop in which a perceiver looks at every step, its driver, and the record of its looks by scene."""
    looks: list[list[bytes | None]] = [[] for _ in range(world.batch)]

    def watch(event: PerceivedEvent) -> None:
        if isinstance(event, PerceptionEvent):
            objects = event.objects
            # Without the index of the scene, which depends on the batch.
            columns = [] if objects is None else [getattr(objects, column.name) for column in fields(objects)[1:]]
            looks[event.scene].append(None if objects is None else b"".join(column.tobytes() for column in columns))

    guarded = cast(Perceiver, _GuardedPerceiver(perceiver))
    driver = PerceivingDriver(guarded, rate=1.0 / world.dt, latency=0.0, watch=watch)
    available = sensors_of(perceiver, Onboard()) if sensors is None else dict(sensors)
    loop = Loop(world, {0: driver}, sensors=available)
    loop.reset()
    return loop, driver, looks


def _record_looks(
    perceiver: Perceiver, world: Simulator, steps: int, sensors: Mapping[str, Sensor] | None
) -> list[list[bytes | None]]:
    """Return the objects of each look, [B][looks]; None without a reading."""
    loop, _, looks = _make_loop(perceiver, world, sensors)
    for _ in range(min(steps, step_limit(world))):
        _run_guarded(loop.step)
    return looks


def _check_snapshot(perceiver: Perceiver, world: Simulator, steps: int, sensors: Mapping[str, Sensor] | None) -> None:
    loop, driver, looks = _make_loop(perceiver, world, sensors)
    for _ in range(steps // 2):
        _run_guarded(loop.step)
    saved = cast(Reproducible, world).snapshot(), driver.snapshot_batch()
    runs = []
    for _ in range(2):
        for scene in looks:
            scene.clear()
        for _ in range(steps - steps // 2):
            _run_guarded(loop.step)
        runs.append([list(scene) for scene in looks])
        cast(Reproducible, world).restore(saved[0])
        driver.restore_batch(saved[1])
    _require(runs[0] == runs[1], "a restored snapshot continues as before")


def _car_states(scene: int, look: int) -> tuple[F64, F64]:
    """Return positions and velocities [M, 2] of the cars of a scene at a look."""
    draws = generator("check_tracker", scene)
    count = 2 + scene % 3
    velocity = np.stack([draws.uniform(3.0, 12.0, count), np.zeros(count)], 1)
    start = np.stack([draws.uniform(-20.0, 20.0, count), 12.0 * np.arange(count)], 1)
    return start + velocity * (look * STEP), velocity


def _simulated_detections(scene: int, index: int, look: int) -> Objects:
    """Return detections of the cars of a scene, with errors of 0.1 m, and now and then a false or a missed one."""
    draws = generator("check_tracker look", scene, look)
    place, _ = _car_states(scene, look)
    place = place + draws.normal(0.0, 0.1, place.shape)
    if look % 7 == 5:
        place = np.concatenate([place[1:], draws.uniform(-40.0, -30.0, (1, 2))])
    count = len(place)
    return Objects(
        np.full(count, index, np.int64),
        place,
        np.tile(0.04 * np.eye(2), (count, 1, 1)),
        np.zeros(count),
        np.tile([4.5, 1.9], (count, 1)),
        np.full((count, 2), np.nan),
        np.full(count, int(AgentKind.CAR), np.int64),
        np.full(count, 0.9),
    )


def _confirmed_tracks(tracker: Tracker, scenes: I64, times: F64) -> Tracks:
    """Return confirmed tracks, checked."""
    tracks = tracker.confirmed(scenes, times)
    try:
        check_tracks(tracks, scenes, type(tracker).__name__)
    except ConfigError as error:
        raise PartCheckError(f"what it returns is as its protocol says: {error}") from error
    columns = (tracks.place, tracks.velocity, tracks.yaw, tracks.size, tracks.score)
    _require(all(bool(np.isfinite(column).all()) for column in columns), "its tracks are finite")
    _require(bool((tracks.size > 0.0).all()), "its tracks have a size above 0 m")
    kinds = np.asarray(tracks.kind)
    _require(bool(((kinds > 0) & (kinds < len(AgentKind))).all()), "its tracks have a kind of AgentKind")
    names = list(zip(np.asarray(tracks.scene).tolist(), np.asarray(tracks.ident).tolist(), strict=True))
    _require(len(set(names)) == len(names), "the numbers of its tracks are unique in a scene")
    return tracks


def _track_scenes(tracker: Tracker, order: Sequence[int], looks: range) -> list[list[bytes]]:
    """Return the confirmed tracks of each scene after each look."""
    indices = np.arange(len(order), dtype=np.int64)
    rows: list[list[bytes]] = [[] for _ in order]
    for look in looks:
        # Scenes are not all looked at each time, as when one has lost its signal.
        observed_scenes = np.array([index for index, scene in enumerate(order) if (look + scene) % 11], np.int64)
        parts = [
            no_objects(),
            *(_simulated_detections(order[index], index, look) for index in observed_scenes.tolist()),
        ]
        detections, times = Objects.cat(parts), np.full(len(observed_scenes), look * STEP)
        input_arrays = _arrays(detections)
        tracker.update(observed_scenes, times, detections, np.zeros((len(observed_scenes), 3)))
        _require(_arrays(detections) == input_arrays, "it changes nothing that it is given")
        now = np.full(len(order), look * STEP + 0.1)
        tracks = _confirmed_tracks(tracker, indices, now)
        repeated_tracks = _confirmed_tracks(tracker, indices, now)
        _require(
            _arrays(repeated_tracks) == _arrays(tracks), "confirmed changes no state: asked twice, it answers the same"
        )
        for index in indices.tolist():
            scene_tracks = tracks.take(np.flatnonzero(tracks.scene == index))
            order_of_tracks = np.argsort(scene_tracks.ident, kind="stable")
            columns = [getattr(scene_tracks, column.name)[order_of_tracks] for column in fields(Tracks)[1:]]
            rows[index].append(b"".join(np.ascontiguousarray(column).tobytes() for column in columns))
    return rows


def _check_following(tracker: Tracker, episodes: Sequence[Episode], looks: int) -> None:
    """Check tracks of cars that are found at every look."""
    tracker.reset(list(episodes))
    index, numbers = np.zeros(1, np.int64), []
    for look in range(looks):
        place, _ = _car_states(0, look)
        detections = _simulated_detections(0, 0, 0).take(slice(0, len(place)))
        detections.place[:] = place
        tracker.update(index, np.array([look * STEP]), detections, np.zeros((1, 3)))
        if look < 10:
            continue
        later = look * STEP + 0.3
        tracks = _confirmed_tracks(tracker, index, np.array([later]))
        true_place = _car_states(0, 0)[0] + _car_states(0, 0)[1] * later
        distances = np.linalg.norm(true_place[:, None] - np.asarray(tracks.place)[None], axis=-1)
        nearest = distances.min(1, initial=np.inf)
        _require(
            bool((nearest < CLOSE).all()),
            f"a car that is detected at every look is tracked, and predicted to the present within {CLOSE:g} m",
        )
        numbers.append(np.asarray(tracks.ident)[distances.argmin(1)].tolist())
    _require(all(row == numbers[0] for row in numbers), "a car that is detected at every look keeps its number")
