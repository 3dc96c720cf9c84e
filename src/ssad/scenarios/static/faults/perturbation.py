"""Faults as perturbations: the camera faults of SSAD, and a class of your own for any sensor, state or command.

A class of your own has one method or several of `ReadingChange.apply`, `StateChange.observe` and
`CommandChange.command` (`ssad.core.driving`). Its attribute `sensors` names what `apply` changes: sensors by name, or
modalities (camera, lidar, radar); without it, all cameras. A new object is made for each sensor and for each batch of
episodes, so an object may remember earlier readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.driving import CommandChange, ReadingChange, StateChange
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.source import source_version
from ssad.core.types import U8
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.scenarios.static.faults.camera import CameraFault
from ssad.scenarios.static.perturbation import (
    Perturbation,
    PerturbedScene,
    RecordedMoment,
    RecordedScene,
    SceneVictim,
)

if TYPE_CHECKING:
    from ssad.rendering.sensor_suite import SensorSuite

METHODS = ("apply", "observe", "command")
"""Methods of which a fault has at least one."""


@dataclass(frozen=True, slots=True)
class Fault(Perturbation):
    """Fault of sensors, of what the ego knows of itself, or of its commands.

    Attributes:
        name: Name in tables.
        make: Makes a new object of the fault.
        severity: 1 to 5; 1 if the fault has none.

    Raises:
        ConfigError: The object has none of the methods of a fault.
    """

    name: str
    make: Callable[[], Any]
    severity: int = 1
    family: str = field(default="fault", init=False)

    def __post_init__(self) -> None:
        if not any(callable(getattr(self.make(), method, None)) for method in METHODS):
            raise ConfigError(f"fault '{self.name}' has none of the methods {', '.join(METHODS)}")

    @classmethod
    def of_camera(cls, name: str, severity: int, *, label: str = "") -> Fault:
        """Return a camera fault of SSAD.

        Raises:
            UnknownNameError: There is no such fault.
            ConfigError: There is no such severity.
        """
        return cls(label or name, lambda: CameraFault(name, severity), severity)

    def version(self) -> str:
        """Return 12 hex digits over the source of a fault of the user's own; "" for one of SSAD's."""
        module = type(self.make()).__module__
        return "" if module.startswith("ssad.") else source_version(module)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with the fault in its sensors, in the ego's state and in its commands.

        Raises:
            ConfigError: The fault is of sensors that the system does not have.
        """
        example = self.make()
        if isinstance(example, ReadingChange):
            for name in self._sensors(example, suite.sensors):
                suite = suite.with_reading_change(name, self.make())
        if isinstance(example, StateChange):
            suite = suite.with_state_change(self.make())
        if isinstance(example, CommandChange):
            suite = suite.with_command_change(self.make())
        return suite

    def _sensors(self, fault: Any, sensors: dict[str, str]) -> list[str]:
        """Return the names of the sensors, given with their modalities, that a fault changes."""
        sensor_names = set(getattr(fault, "sensors", ("camera",)))
        fault_sensors = [name for name, modality in sensors.items() if name in sensor_names or modality in sensor_names]
        if not fault_sensors:
            raise ConfigError(
                f"fault '{self.name}' is of {', '.join(sorted(sensor_names))}; this system has "
                f"{', '.join(sensors) or 'no such sensors'}"
            )
        return fault_sensors

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return the images of a scene with the fault in its cameras, in order of time.

        Raises:
            ConfigError: The fault is of other sensors, or of state or commands alone.
        """
        example = self.make()
        channels = {frame.channel: frame.modality for frame in scene.data.frames}
        if not isinstance(example, ReadingChange):
            raise ConfigError(f"fault '{self.name}' changes no readings: recorded scenes do not show it")
        faulty_channels = {name for name in self._sensors(example, channels) if channels[name] == "camera"}
        if not faulty_channels:
            raise ConfigError(f"fault '{self.name}' changes no camera: detectors of images do not show it")
        faults: dict[str, Any] = {name: self.make() for name in faulty_channels}
        start = scene.data.samples[0].timestamp if scene.data.samples else 0

        def look(frames: Sequence[SensorFrame]) -> list[U8]:
            images = []
            for frame in frames:
                image = read_frame_image(scene.root, frame)
                if frame.channel in faults:
                    moment = RecordedMoment(np.array([(frame.timestamp_us - start) / 1e6]))
                    draws = [generator("perturbation", scene.seed, frame.scene_token, frame.channel, frame.token)]
                    readings = np.ascontiguousarray(np.moveaxis(image, -1, 0))[None]
                    faulty_readings = faults[frame.channel].apply(readings, victim, moment, draws)
                    image = np.ascontiguousarray(np.moveaxis(np.asarray(faulty_readings)[0], 0, -1))
                images.append(image)
            return images

        return PerturbedScene(look)
