"""Distribution shifts as perturbations: those of SSAD, and a function of your own on images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ssad.core.driving import Generators, Sensor
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera, Frame
from ssad.core.seeding import generator
from ssad.core.source import source_version
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.scenarios.static.perturbation import Perturbation, PerturbedScene, RecordedScene, SceneVictim
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter
from ssad.scenarios.static.shifts.spec import Calibration, ShiftSpec

if TYPE_CHECKING:  # the renderer needs Warp, which recorded scenes do without
    from ssad.rendering.onboard import Onboard
    from ssad.rendering.sensor_suite import SensorSuite


@dataclass(frozen=True, slots=True)
class Shift(Perturbation):
    """Distribution shift of SSAD (paper III.A.2).

    Attributes:
        shift: Name of the shift (`ssad list shifts`).
        severity: 1 to 5; "random": drawn for each recorded scene, or in the paper's calibration for each sample.
        calibration: Calibration of the severities.
        label: Name in tables; "": that of the shift.

    Raises:
        ConfigError: There is no such shift, severity or calibration.
    """

    shift: str
    severity: Any = 3
    calibration: Calibration = "physical"
    label: str = ""
    family: str = field(default="shift", init=False)

    def __post_init__(self) -> None:
        self.spec(0)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        return self.label or self.shift

    @property
    def folder(self) -> str:
        """Name of the folder of its detections."""
        return f"{self.shift}-{self.severity}"

    def spec(self, seed: int) -> ShiftSpec:
        """Return the specification with a seed; severity 1 if it is drawn."""
        severity = 1 if self.severity == "random" else self.severity
        return ShiftSpec(self.shift, severity, seed=seed, calibration=self.calibration)

    def shifter(self, scene: RecordedScene) -> SceneShifter:
        """Return a recorded scene seen through the shift."""
        return SceneShifter(scene.root, scene.data, self.spec(scene.seed), random=self.severity == "random")

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return shifted images, the same for all detectors; the notes count how often the shift was applied."""
        shifter, applied_counts = self.shifter(scene), Counter[str]()

        def look(frames: Sequence[SensorFrame]) -> Sequence[U8]:
            images, reports = shifter.images(frames, device=None if scene.device == "cpu" else scene.device)
            applied_counts.update("applied" if report.applied else "not applied" for report in reports)
            for report in reports:
                applied_counts.update({f"skipped: {reason}": int(count) for reason, count in report.skipped.items()})
            return images

        return PerturbedScene(look, lambda: applied_counts)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with all its cameras under the shift: one weather per episode."""
        return with_cameras(suite, partial(_shifted_camera, spec=self.spec(seed)))


def _shifted_camera(onboard: Onboard, camera: Camera, *, spec: ShiftSpec) -> Sensor:
    from ssad.scenarios.static.shifts.loop import ShiftedCamera

    return ShiftedCamera(onboard.camera(camera), spec)


def with_cameras(suite: SensorSuite, make: Any) -> SensorSuite:
    """Return a suite whose cameras are made by a function of the renderer and the camera.

    Raises:
        ConfigError: There are no cameras, or another perturbation makes them already.
    """
    if not suite.cameras:
        raise ConfigError("a shift changes camera images, and this system has no camera")
    if suite.camera_sensors:
        raise ConfigError("the cameras are under a shift already; use one shift at a time")
    return replace(suite, camera_sensors=dict.fromkeys(suite.cameras, make))


@runtime_checkable
class ImageShift(Protocol):
    """A distribution shift of your own; `{"my_module:Haze": {...}}` names it in a suite.

    Attributes may set its severity: a class with an argument `severity` is made once for each.
    """

    def shift(self, images: U8, frames: Sequence[Frame], generators: Generators) -> U8:
        """Return shifted images.

        Args:
            images: uint8 RGB [N, H, W, 3].
            frames: Camera, pose, time, boxes and, where it is known, depth of each image.
            generators: One for each image: the result must depend on nothing else.

        Returns:
            uint8 RGB [N, H, W, 3].
        """


@dataclass(frozen=True, slots=True)
class UserShift(Perturbation):
    """Distribution shift by a class of the user's own (see `ImageShift`).

    Attributes:
        name: Name in tables.
        shift: The object that shifts images.
        severity: 1 to 5; 1 if the class has no severities.
    """

    name: str
    shift: ImageShift
    severity: int = 1
    family: str = field(default="shift", init=False)

    def version(self) -> str:
        """Return 12 hex digits over the source of the module."""
        return source_version(type(self.shift).__module__)

    def shifted(self, images: U8, frames: Sequence[Frame], seed: int) -> U8:
        """Return shifted images [N, H, W, 3]; each depends on its own frame alone.

        Raises:
            ConfigError: The class returns images of another shape or type.
        """
        generators = [generator("own shift", self.name, seed, frame.sample) for frame in frames]
        shifted = np.asarray(self.shift.shift(images.copy(), frames, generators))
        if shifted.shape != images.shape or shifted.dtype != np.uint8:
            raise ConfigError(
                f"shift '{self.name}': returned {shifted.dtype} {list(shifted.shape)}, expected uint8 "
                f"{list(images.shape)}"
            )
        return shifted

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return shifted images, each by itself."""
        shifter = SceneShifter(scene.root, scene.data, ShiftSpec("uniform", 0, seed=scene.seed))

        def look(frames: Sequence[SensorFrame]) -> Sequence[U8]:
            return [
                self.shifted(shifter.read(frame)[None], [shifter.describe_frame(frame)], scene.seed)[0]
                for frame in frames
            ]

        return PerturbedScene(look)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with all its cameras under the shift."""
        return with_cameras(suite, partial(_own_shifted_camera, shift=self, seed=seed))


def _own_shifted_camera(onboard: Onboard, camera: Camera, *, shift: UserShift, seed: int) -> Sensor:
    from ssad.scenarios.static.shifts.loop import UserShiftedCamera

    return UserShiftedCamera(onboard.camera(camera), partial(shift.shifted, seed=seed))
