"""A light attack as files: the lamp and its settings, to be set up outside or filmed in a drive."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.core.images import save_picture
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.hours import at_hour
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.physical.lights import Projector, TargetSize, make_light
from ssad.scenarios.static.physical.textures.controls import texture_picture
from ssad.scenarios.static.physical.textures.export import (
    PrintedTexture,
    check_description,
    colour_tensor,
    load_printed_texture,
)


@dataclass(frozen=True, slots=True)
class LightSetup:
    """Light attack with all settings that are needed to show it again.

    Attributes:
        attack: Its name (`ssad.scenarios.static.physical.lights.LIGHTS`).
        options: Options of the attack.
        hour: Hour at which it shines (see `ssad.experiments.perception.physical.lit_images.HOURS`).
        target: Target that it was searched for, as for `ssad record --target`.
        values: Its settings, in the units of their names; empty for a projector.
        colour: Image of a projector, sRGB [3, H, W] in 0 to 1; else None.
    """

    attack: str
    options: Mapping[str, Any]
    hour: str
    target: str
    values: Mapping[str, float]
    colour: Tensor | None = None

    def edit(self, mesh: Mesh) -> SceneEdit:
        """Return the edit of a scene in which it shines on a body.

        Raises:
            ConfigError: A projector has no image.
        """
        light = make_light(self.attack, self.options)
        lower, upper = mesh.bounds()
        length, width, height = (upper - lower).tolist()
        target = TargetSize(length, width, height)
        if not isinstance(light, Projector):
            edit: SceneEdit = light.edit(self.values, target)
            return edit
        if self.colour is None:
            raise ConfigError(f"{self.attack}: there is no picture that it shows")
        return light.edit(self.colour, target)

    def live(self, agent: int) -> AgentEdit:
        """Return the edit in which it shines on an agent of the closed loop.

        Raises:
            ConfigError: The light is not made for a car.
        """
        car = parse_target(self.target)
        if not isinstance(car, TargetCar):
            raise ConfigError(f"this light is made for {self.target}; only cars drive")
        return AgentEdit(self.edit, car, agent)


_ANY_SIZE = TargetSize(4.9, 2.06, 1.51)


def export_light(out: Path, light: LightSetup, *, name: str = "") -> list[Path]:
    """Write a light attack: light.json, and for a projector its picture as picture.png and, exactly, picture.npz.

    Args:
        out: Folder.
        light: The light with its settings.
        name: Name in light.json.

    Returns:
        Paths of the written files.
    """
    device = make_light(light.attack, light.options)
    description: dict[str, Any] = {
        "name": name,
        "attack": light.attack,
        "options": dict(light.options),
        "hour": light.hour,
        "target": light.target,
        "values": dict(light.values),
    }
    safeio.make_folder(out)
    paths = [out / "light.json"]
    if light.colour is not None:
        assert isinstance(device, Projector)
        # PNG rounds to 8 bits; the file of floats is what `load_light` verifies and reads.
        colour_bytes = safeio.npz_bytes({"colour": light.colour.numpy()})
        safeio.write_atomic(out / "picture.npz", colour_bytes)
        full_mask = np.ones(tuple(light.colour.shape[1:]), np.bool_)
        save_picture(out / "picture.png", texture_picture(light.colour, full_mask))
        description |= {"lumens": device.power(light.colour), "sha256": hashlib.sha256(colour_bytes).hexdigest()}
        paths += [out / "picture.png", out / "picture.npz"]
    elif not isinstance(device, Projector):
        description["lumens"] = device.power(light.values)
    safeio.write_atomic(out / "light.json", safeio.dump_json(description, indent=1) + "\n")
    return paths


def load_light(folder: Path) -> LightSetup:
    """Read a light attack that `export_light` wrote.

    Raises:
        FormatError: A file is missing or broken, or the image is not the one that was exported.
        SSADError: Unknown light attack or hour.
    """
    description, colour = safeio.read_json(folder / "light.json"), None
    try:
        check_description(description, attack=str, options=dict, hour=str, target=str, values=dict)
        if not all(isinstance(value, int | float) for value in description["values"].values()):
            raise TypeError("values are not numbers")
        if "sha256" in description:
            colour_bytes = safeio.read_bytes(folder / "picture.npz")
            if hashlib.sha256(colour_bytes).hexdigest() != description["sha256"]:
                raise FormatError(f"{folder / 'picture.npz'}: not what light.json describes; export it again")
            colour = colour_tensor(safeio.load_npz(folder / "picture.npz")["colour"])
        light = LightSetup(
            description["attack"],
            description["options"],
            description["hour"],
            description["target"],
            description["values"],
            colour,
        )
        # These only validate: a bad name should fail here, not in the middle of a drive.
        if ":" in light.attack:
            raise FormatError(
                f"{folder / 'light.json'}: the attack {light.attack[:80]} is code, which a file must not name; install "
                "it as an entry point of ssad.lights"
            )
        device = make_light(light.attack, light.options)
        at_hour(SceneWeather(), light.hour)
        parse_target(light.target)
        if not isinstance(device, Projector):
            missing = sorted(device.ranges(_ANY_SIZE).keys() - light.values.keys())
            if missing:
                raise KeyError(f"values lack {', '.join(missing)}")
        return light
    except (KeyError, TypeError) as error:
        raise FormatError(f"{folder / 'light.json'}: no exported light ({error}); export it again") from None


def load_exported_attack(folder: Path) -> PrintedTexture | LightSetup:
    """Read the export of `ssad export texture` or `ssad export light`.

    Raises:
        FormatError: The folder holds neither, or a broken one.
    """
    if (folder / "light.json").is_file():
        return load_light(folder)
    return load_printed_texture(folder)
