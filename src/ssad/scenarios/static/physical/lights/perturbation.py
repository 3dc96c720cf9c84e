"""Light on a car, and a dark night: the same on recorded targets and in the loop."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.source import plugin_version
from ssad.core.types import AgentKind, Episode
from ssad.rendering.camera.scene_edit import NO_EDIT
from ssad.rendering.hours import at_hour
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.perturbation import EGO, Perturbation, TargetImages
from ssad.scenarios.static.physical.lights import BUILT_IN, LIGHTS, Projector, TargetSize, make_light, random_settings
from ssad.scenarios.static.physical.lights.export import LightSetup, load_light
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from torch import Tensor

    from ssad.core.detections import Truth
    from ssad.rendering.sensor_suite import SensorSuite

NIGHT: Final = "night"
POWERS: Final = (0.25, 0.5, 1.0, 2.0, 4.0)  # of each lamp's own, by severity
LAMPS: Final = {"laser": "watts", "projector": "lumens", "flashlight": "lumens"}  # the power of each lamp


@dataclass(frozen=True)
class LightPerturbation(Perturbation):
    """Light on a car (paper III.A.1, non-invasive attacks), or the night in which lamps shine.

    Attributes:
        light: "night"; a light of `LIGHTS` or a class of the user's own, with settings drawn at random, lamps by night
            and others at the hour of the episode; or a folder that `ssad export light` wrote, at its hour.
        severity: 1 to 5, power of a lamp; 1 for everything else.
        options: Fields of the light that differ from its defaults.
        label: Name in tables; "": that of the light or of its folder.

    Raises:
        UnknownNameError: There is no such light.
        FormatError: The folder holds no exported light.
        ConfigError: An option is unknown or has an invalid value.
    """

    light: str
    severity: int = 1
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""
    family: str = field(default="light", init=False)

    def __post_init__(self) -> None:
        self.setup(0)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        return self.label or (self.light if self.exported is None else self.exported.name)

    @cached_property
    def exported(self) -> Path | None:
        """Folder of the light, if it was exported; None for a named one."""
        folder = Path(self.light).expanduser()
        return folder if self.light not in (NIGHT, *LIGHTS) and (folder / "light.json").is_file() else None

    def setup(self, seed: int) -> LightSetup | None:
        """Return the light with all its settings; None for the night alone.

        Args:
            seed: Seed of settings that are drawn at random.
        """
        if self.light == NIGHT:
            return None
        if self.exported is not None:
            return load_light(self.exported)
        options = dict(self.options)
        if self.light in LAMPS and LAMPS[self.light] not in options:
            power = LAMPS[self.light]
            options[power] = POWERS[self.severity - 1] * getattr(make_light(self.light, options), power)
        light, car = make_light(self.light, options), TargetCar()
        hour = getattr(light, "hour", NIGHT if self.light in LAMPS else "recorded")
        lower, upper = car.mesh().bounds()
        target = TargetSize(*(upper - lower).tolist())
        if isinstance(light, Projector):
            texture_size = light.surface(target).size
            colours = generator("random light", self.light, seed).random((3, *texture_size))
            return LightSetup(self.light, options, hour, "sedan", {}, torch.from_numpy(colours.astype("float32")))
        return LightSetup(self.light, options, hour, "sedan", random_settings(light, target, key=("loop", seed)))

    @property
    def hour(self) -> str:
        """Hour of the episodes: "recorded" (unchanged), or one of `ssad.rendering.hours.HOURS`."""
        light = self.setup(0)
        return NIGHT if light is None else light.hour

    @property
    def needs_target(self) -> bool:
        """True, but for the night: something must be lit."""
        return self.light != NIGHT

    @property
    def target(self) -> str:
        """Target that the light is made for; "" for the night alone."""
        light = self.setup(0)
        return "" if light is None else light.target

    def version(self) -> str:
        """Return the hash of an exported light or of a user's module; "" for the others, which the code decides."""
        if self.exported is None:
            return "" if self.light == NIGHT else plugin_version("light", BUILT_IN, self.light)
        files = (self.exported / file_name for file_name in ("light.json", "picture.npz"))
        return hashlib.sha256(b"".join(safeio.read_bytes(file) for file in files if file.is_file())).hexdigest()

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the first car besides the ego; for the night alone the ego."""
        if not self.needs_target:
            return EGO
        agents = enumerate(episode.agents)
        return next((number for number, agent in agents if number and MODELS[agent.model].kind == AgentKind.CAR), None)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite in which the light shines on an agent, at its hour."""
        light = self.setup(seed)
        suite = replace(suite, weather=at_hour(suite.weather, self.hour))
        return suite if light is None else suite.with_agent_edit(light.live(target))

    def clean_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target at the hour of the light, without it."""
        return images.lit(self.hour, NO_EDIT) if self.hour != "recorded" else images.clean()

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1, and truth of a recorded car in the light, at its hour.

        Raises:
            ConfigError: The light is not made for a car.
        """
        light = self.setup(0)
        if light is None:
            return images.lit(NIGHT, NO_EDIT)
        target = parse_target(light.target)
        if not isinstance(target, TargetCar):
            raise ConfigError(f"light '{self.name}' is made for {light.target}; only cars can be lit")
        return images.lit(light.hour, light.edit(target.mesh()))
