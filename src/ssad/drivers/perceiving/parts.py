"""Parts of a perceiving driver: perceiver, tracker and planner, each a protocol with a table of names.

    readings of the sensors -> Perceiver -> detections -> Tracker -> tracks -> belief -> Planner -> controls

A class need not inherit from a protocol: having its attributes and methods is enough. A package offers its parts by
name through entry points, and `ssad list` shows them; without a package, a name of the form "module:object" is
imported from the working folder:

    [project.entry-points."ssad.perceivers"]
    my-lidar = "my_package.eyes:Clusters"

    systems:
    - {name: mine, perceiver: {my-lidar: {reach: 40}}, tracker: "my_package.tracks:Nearest", planner: autopilot}

Shape letters: N rows of an observation, n rows that are processed, M objects. Units are metres, seconds and radians.
The world frame is right-handed (x east, y north, z up); an ego's frame is x forward, y left, z up, from the middle of
its base.

Requirements on every implementation: a result must not depend on the scenes that share its batch, nor on the order of
batches; all randomness comes from `ssad.core.seeding`; `reset` discards all memory. `ssad.drivers.perceiving.check`
tests parts against their protocols.

A part may have further attributes and methods:

* `snapshot()` and `restore(snapshot)`: the state that changes while it drives. Without them the part is deep-copied.
* `to(device)`: move the computation to a device, such as cuda:0.
* `version`: text that enters the keys of results, such as a hash of weights. The source of a part of a user and the
  files that its arguments name enter them in any case.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol, cast, runtime_checkable

import numpy as np

from ssad.core.checkpoints import state_hash
from ssad.core.detections import Detections
from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import CAMERAS
from ssad.core.perception import I64, Objects, Tracks
from ssad.core.registry import Reference, make, names, resolve
from ssad.core.safeio import read_bytes
from ssad.core.seeding import digest
from ssad.core.source import source_version
from ssad.core.types import F32, F64, I32, Controller, Episode
from ssad.drivers.perceiving.ego_boxes import EgoBoxes
from ssad.rendering.camera.rig import rig_camera

Percepts = Sequence[EgoBoxes | None] | Mapping[str, Sequence[Detections | None]]
"""Result of a perceiver: boxes in the frames of the egos by row, or detections in images by camera and row."""


@runtime_checkable
class Perceiver(Protocol):
    """Detects the objects around egos in the readings of their sensors.

    A perceiver is not restricted to images: it names any sensors, and reads each in `Observation.readings`. Names of
    nuScenes (`CAM_FRONT`, ..., `LIDAR_TOP`) are the sensors of that data set; `truth` is a `Belief` of all agents.
    Other sensors need a model under their name in one of three optional attributes, each a mapping by name. A model
    has the pose of its sensor on the ego, `to_ego` [4, 4].

    * `cameras` (`ssad.core.frames.Camera`): images uint8 [N, 3, H, W], RGB; 0 everywhere where the signal is lost.
    * `lidars` (`ssad.rendering.lidar.Lidar`): points float32 [N, P, 5]: x, y, z in the sensor's frame (x right, y
      forward, z up), m, intensity, and ring, which is -1 in rows after the last point.
    * `radars` (a `Lidar` of its rays): float32 [N, P, 4]: distance, m, 0 in rows after the last return; elevation and
      azimuth to the right, rad; range rate, m/s.

    A perceiver with an attribute `detector` (`ssad.core.protocols.Detector`) can be the victim of digital attacks.

    `ssad.drivers.perceiving.check.check_perceiver` tests an implementation against this protocol.

    Attributes:
        sensors: Names of the sensors that it reads.
        classes: Names of the labels of its detections, such as "car"; those of nuScenes and COCO that mean road users
            or obstacles matter to a driver (`ssad.drivers.perceiving.objects.KINDS`), others do not.

    Example:
        The frame of a perceiver of LiDAR points; `boxes` returns `ssad.drivers.perceiving.ego_boxes.EgoBoxes`::

            class Clusters:
                sensors, classes = ("LIDAR_TOP",), ("car", "pedestrian")

                def reset(self, episodes): ...

                def perceive(self, view, rows):
                    sweeps = view.readings["LIDAR_TOP"][rows]
                    return [self.boxes(points[points[:, 4] >= 0]) for points in sweeps]
    """

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that it reads."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the labels of its detections."""

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Discard all memory; called once before each batch.

        Args:
            episodes: The B episodes that are driven next; `Observation.scene` counts them.
        """

    def perceive(self, view: Observation, rows: I64) -> Percepts:
        """Detect the objects around some egos at the present time.

        Args:
            view: Observation of N egos. `others` and `others_lane`, which hold the truth, are empty.
            rows: [n] rows to process, in ascending order: those of running episodes that are due at this time. The
                other rows of `view` and of its readings do not count.

        Returns:
            One of two forms. A sequence of length n: the boxes of each row in the frame of its ego; None where there
            was no reading, which is a loss of signal and not an empty scene. Or a mapping from each name of `cameras`
            to such a sequence of detections in the frame of that camera: the driver projects them to the road, and
            boxes of 2D detectors become objects. In both forms the driver keeps one of several large objects in the
            same place.

        Raises:
            ConfigError: A reading is not of the expected shape or type.
        """


@runtime_checkable
class Tracker(Protocol):
    """Follows the detected objects of B scenes through time.

    Objects and tracks are in the world frame: the driver has moved the detections there by the pose of the ego at the
    time of the look, so that the motion of the ego is compensated.

    `ssad.drivers.perceiving.check.check_tracker` tests an implementation against this protocol.
    """

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Discard all tracks; called once before each batch.

        Args:
            episodes: The B episodes that are driven next; scenes count them.
        """

    def update(self, scenes: I64, times: F64, objects: Objects, poses: F64) -> None:
        """Take in the detections of one look at each of some scenes.

        Args:
            scenes: [n] scenes that were looked at, each once. In a scene without objects nothing was detected. A scene
                without a reading is left out.
            times: [n] times of the looks, s, in ascending order for each scene from call to call.
            objects: Objects of these scenes, best first; not to be modified.
            poses: [n, 3] x, y, yaw of the egos at these times.
        """

    def confirmed(self, scenes: I32 | I64, times: F64) -> Tracks:
        """Return the tracks that the driver is to believe, each predicted to the time of its scene.

        Called at every step, also between looks; it must not change the state of the tracker.

        Args:
            scenes: [n] distinct scenes.
            times: [n] present times, s, not before the last look of the scene.
        """


@runtime_checkable
class Planner(Protocol):
    """Chooses the controls of egos from their beliefs.

    An optional attribute `controller` tells who drives. EXTERNAL, the default: `plan` is called at each step.
    AUTOPILOT: the planner of the Autopilot runs inside the world over the belief, and `plan` is never called.

    `ssad.drivers.perceiving.check.check_planner` tests an implementation against this protocol.
    """

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Discard all memory; called once before each batch.

        Args:
            episodes: The B episodes that are driven next; `Observation.scene` counts them.
        """

    def plan(self, view: Observation, belief: Belief) -> F32:
        """Choose the controls of all egos for the next step.

        Args:
            view: Observation of N egos: state, route and signals. `others`, `others_lane` and `readings` are empty.
            belief: The K believed objects around each ego, in the world frame: pose, speed, size and kind [N, K], and
                `stop_sign` where the driver reads stop signs.

        Returns:
            [N, 3] throttle in [0, 1], brake in [0, 1] and steer in [-1, 1] (left positive), as `Driver.act`.
        """


PERCEIVERS: Final[Mapping[str, str]] = {
    "camera": "ssad.drivers.perceiving.perceivers:camera_perceiver",
    "truth": "ssad.drivers.perceiving.perceivers:perfect_perceiver",
}
TRACKERS: Final[Mapping[str, str]] = {"kalman": "ssad.drivers.perceiving.tracker:kalman_tracker"}
PLANNERS: Final[Mapping[str, str]] = {"autopilot": "ssad.drivers.perceiving.planner:AutopilotPlanner"}
TABLES: Final[Mapping[str, Mapping[str, str]]] = {"perceiver": PERCEIVERS, "tracker": TRACKERS, "planner": PLANNERS}
NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    "perceiver": ("sensors", "classes", "reset", "perceive"),
    "tracker": ("reset", "update", "confirmed"),
    "planner": ("reset", "plan"),
}
LARGEST: Final = 8 << 30  # bytes of a file that an argument may name


def part_names(kind: str) -> dict[str, str]:
    """Return the origin of every part of a kind ("perceiver", "tracker" or "planner"), by name."""
    return names(kind, TABLES[kind])


def make_perceiver(name: str, **options: Any) -> Perceiver:
    """Return a perceiver by name, entry point or "module:object".

    Args:
        name: Its name; arguments may follow, as in "mine:Eyes?reach=40".
        options: Arguments of its class or function.

    Raises:
        UnknownNameError: There is no such perceiver.
        ConfigError: It does not import, refuses an argument, or lacks an attribute or a method.
    """
    target = resolve("perceiver", PERCEIVERS, Reference.parse(name).name)
    perceiver = cast(Perceiver, _resolve_part("perceiver", target, name, options))
    for attribute in ("sensors", "classes"):
        value = getattr(perceiver, attribute)
        if isinstance(value, str) or not all(isinstance(entry, str) for entry in value):
            raise ConfigError(f"perceiver '{name}': {attribute} must be a tuple of names, not {value!r}")
    return perceiver


def make_tracker(name: str, **options: Any) -> Tracker:
    """Return a tracker by name, entry point or "module:object"; arguments and errors as `make_perceiver`."""
    target = resolve("tracker", TRACKERS, Reference.parse(name).name)
    return cast(Tracker, _resolve_part("tracker", target, name, options))


def make_planner(name: str, **options: Any) -> Planner:
    """Return a planner by name, entry point or "module:object"; arguments and errors as `make_perceiver`."""
    target = resolve("planner", PLANNERS, Reference.parse(name).name)
    planner = cast(Planner, _resolve_part("planner", target, name, options))
    controller = getattr(planner, "controller", Controller.EXTERNAL)
    if controller not in (Controller.EXTERNAL, Controller.AUTOPILOT):
        raise ConfigError(f"planner '{name}': controller must be Controller.EXTERNAL or AUTOPILOT, not {controller!r}")
    return planner


def _resolve_part(kind: str, target: Any, name: str, options: Mapping[str, Any]) -> Any:
    """Return the part that a class or function makes, or the object itself, with what its kind needs."""
    reference = Reference.parse(name)
    arguments = {**reference.options, **options}
    if callable(target):
        try:
            signature = inspect.signature(target)
        except ValueError:  # of a class in C
            signature = inspect.Signature()
        try:
            signature.bind(**arguments)
        except TypeError as error:
            accepted = ", ".join(signature.parameters) or "no arguments"
            raise ConfigError(f"{kind} '{reference.name}': {error}; it takes {accepted}") from None
    elif arguments:
        raise ConfigError(
            f"{kind} '{reference.name}': it is an object, which takes no arguments; name its class instead"
        )
    part = make(kind, reference.name, target, arguments, NEEDS[kind])
    for method in ("reset", *NEEDS[kind][-1:]):
        if not callable(getattr(part, method)):
            raise ConfigError(f"{kind} '{reference.name}': {method} must be a method")
    return part


def part_version(kind: str, name: str, part: Any, options: Mapping[str, Any]) -> str:
    """Return the version of a part for the keys of results; "" if SSAD's own source decides it alone.

    Args:
        kind: "perceiver", "tracker" or "planner".
        name: As for `make_perceiver`.
        part: The part, as made.
        options: Arguments that it was made with.

    Returns:
        Hashes, separated by spaces: of the source of a part of a user and all that it imports; of the files that
        arguments name; of the weights of its detector; and its own `version`.
    """
    reference = Reference.parse(name)
    versions = []
    if reference.name not in TABLES[kind]:
        target = resolve(kind, TABLES[kind], reference.name)
        versions.append(source_version(getattr(target, "__module__", None) or type(target).__module__))
    arguments = {**reference.options, **options}.values()
    files = [Path(value) for value in arguments if isinstance(value, str) and Path(value).is_file()]
    if files:
        hashes = [hashlib.blake2b(read_bytes(file, limit=LARGEST)).hexdigest() for file in files]
        versions.append(digest("files", *hashes)[:12])
    detector = getattr(part, "detector", None)
    versions += [state_hash(detector) if detector is not None else "", str(getattr(part, "version", ""))]
    return " ".join(filter(None, versions))


def cameras_of(perceiver: Perceiver) -> dict[str, Camera]:
    """Return the cameras of a perceiver by name: its own models, and those of nuScenes that it names alone."""
    cameras = dict(getattr(perceiver, "cameras", {}))
    return cameras | {
        name: rig_camera(name, 640) for name in perceiver.sensors if name in CAMERAS and name not in cameras
    }


def snapshot_part(part: Any) -> Any:
    """Return the state of a part: its own snapshot, or a deep copy of it."""
    return part.snapshot() if hasattr(part, "snapshot") else deepcopy(part)


def restore_part(part: Any, snapshot: Any) -> Any:
    """Return a part in the state of a snapshot of `snapshot_part`."""
    if not hasattr(part, "restore"):
        return deepcopy(snapshot)
    part.restore(snapshot)
    return part


def hide_truth(view: Observation, *, readings: bool) -> Observation:
    """Return an observation without the true state of other agents, and without readings where asked."""
    hidden = replace(
        view,
        others=np.zeros_like(view.others),
        others_lane=np.zeros_like(view.others_lane),
        others_turn_signal=None,
    )
    return hidden if readings else replace(hidden, readings={})
