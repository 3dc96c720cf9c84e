"""Sensors of a driver in the closed loop, and all that a perturbation can change about them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from ssad.core.driving import CommandChange, LoopChanges, ReadingChange, Sensor, StateChange
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.lidar import Lidar
from ssad.rendering.onboard import DAY, Onboard
from ssad.rendering.radar import OnboardRadar
from ssad.rendering.street_edit import StreetEdit

CameraSensor = Callable[[Onboard, Camera], Sensor]
"""Makes the sensor of a camera, such as one whose images are under a shift."""


@dataclass(frozen=True)
class SensorSuite:
    """Sensors that a driver asks for, before they are built.

    A perturbation gets a suite and returns a changed one (`ssad.scenarios.static.perturbation.Perturbation.in_loop`);
    several can be applied in turn. Nothing is rendered before `build`.

    Attributes:
        cameras: Cameras by sensor name.
        lidars: LiDARs by sensor name.
        radars: Radars by sensor name.
        device: Device that renders: cpu or cuda:0.
        weather: Weather of all episodes.
        agent_edit: Texture, light or other edit of an agent, or of the stop signs; None: none.
        street_edit: Edit of the street; None: none.
        camera_sensors: Maker of the sensor of a camera, by sensor name; the others are plain cameras.
        changes: Changes of readings, of the ego's own state and of its commands.
        other_images: Images of a camera in other drives, for attacks that are fitted before they are used: from the
            camera and their number to [N, 3, H, W] in 0 to 1; None: there are none.
    """

    cameras: Mapping[str, Camera] = field(default_factory=dict)
    lidars: Mapping[str, Lidar] = field(default_factory=dict)
    radars: Mapping[str, Lidar] = field(default_factory=dict)
    device: str = "cpu"
    weather: SceneWeather = DAY
    agent_edit: AgentEdit | None = None
    street_edit: StreetEdit | None = None
    camera_sensors: Mapping[str, CameraSensor] = field(default_factory=dict)
    changes: LoopChanges = field(default_factory=LoopChanges)
    other_images: Callable[[Camera, int], Any] | None = None

    @property
    def sensors(self) -> dict[str, str]:
        """Name of each sensor -> its modality: camera, lidar or radar."""
        by_modality = {"camera": self.cameras, "lidar": self.lidars, "radar": self.radars}
        return {name: modality for modality, sensors in by_modality.items() for name in sensors}

    def with_agent_edit(self, edit: AgentEdit) -> Self:
        """Return the suite with an edit of an agent or of the stop signs.

        Raises:
            ConfigError: There is one already.
        """
        self._refuse_second_edit()
        return replace(self, agent_edit=edit)

    def with_street_edit(self, edit: StreetEdit) -> Self:
        """Return the suite with an edit of the street.

        Raises:
            ConfigError: There is an edit already.
        """
        self._refuse_second_edit()
        return replace(self, street_edit=edit)

    def _refuse_second_edit(self) -> None:
        """Raise ConfigError if there is an edit already."""
        if self.agent_edit is not None or self.street_edit is not None:
            raise ConfigError(
                "an agent, the stop signs or the street are edited already; use one texture or light at a time"
            )

    def with_reading_change(self, sensor: str, change: ReadingChange) -> Self:
        """Return the suite with a change of a sensor's readings, after those that it has already."""
        earlier = self.changes.readings.get(sensor)
        combined = change if earlier is None else _Sequence((earlier, change))
        return replace(self, changes=replace(self.changes, readings={**self.changes.readings, sensor: combined}))

    def with_state_change(self, change: StateChange) -> Self:
        """Return the suite with a further change of what the driver knows of its own state."""
        return replace(self, changes=replace(self.changes, state=(*self.changes.state, change)))

    def with_command_change(self, change: CommandChange) -> Self:
        """Return the suite with a further change of the driver's commands."""
        return replace(self, changes=replace(self.changes, commands=(*self.changes.commands, change)))

    def build(self) -> dict[str, Sensor]:
        """Return the sensors by name, as `ssad.world.rollout.rollout` takes them; images stay on a GPU."""
        onboard = Onboard(
            weather=self.weather,
            device=self.device,
            resident=True,
            attack=self.agent_edit,
            street_edit=self.street_edit,
        )
        sensors: dict[str, Sensor] = dict(onboard.group_cameras(self.cameras))
        sensors |= {name: make(onboard, self.cameras[name]) for name, make in self.camera_sensors.items()}
        sensors |= {name: onboard.lidar(lidar) for name, lidar in self.lidars.items()}
        sensors |= {name: OnboardRadar(onboard, radar) for name, radar in self.radars.items()}
        return sensors


@dataclass(frozen=True)
class _Sequence:
    """Several changes of one sensor's readings, in order."""

    changes: tuple[ReadingChange, ...]

    def apply(self, readings: Any, victim: Any, truth: Any, generators: Any) -> Any:
        for change in self.changes:
            readings = change.apply(readings, victim, truth, generators)
        return readings
