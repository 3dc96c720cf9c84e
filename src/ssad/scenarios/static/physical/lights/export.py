"""A light attack as files: what shines, and how, to be set up outside or filmed in a drive."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.core.images import save_picture
from ssad.rendering.agent_edit import LiveAttack
from ssad.rendering.camera.render import Weather
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.hours import at_hour
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.physical.lights import Projector, Target, make_light
from ssad.scenarios.static.physical.textures.controls import texture_picture
from ssad.scenarios.static.physical.textures.export import Print, load_print


@dataclass(frozen=True, slots=True)
class Shining:
    """A light attack with what it takes to make it shine again.

    Attributes:
        attack: Its name (`ssad.scenarios.static.physical.lights.LIGHTS`).
        options: Of the attack.
        hour: When it shines (see `ssad.rendering.hours.HOURS`).
        target: Whom it was found for, as for `ssad record --target`.
        values: Its settings, in the units of their names; of a projector none.
        colour: What a projector shows, sRGB [3, H, W] in 0 to 1; else None.
    """

    attack: str
    options: Mapping[str, Any]
    hour: str
    target: str
    values: Mapping[str, float]
    colour: Tensor | None = None

    def edit(self, mesh: Mesh) -> SceneEdit:
        """It shines on a body. ConfigError: it cannot be."""
        made = make_light(self.attack, self.options)
        low, high = mesh.bounds()
        length, width, height = (high - low).tolist()
        target = Target(length, width, height)
        if not isinstance(made, Projector):
            return made.edit(self.values, target)
        if self.colour is None:
            raise ConfigError(f"{self.attack}: there is no picture that it shows")
        return made.edit(self.colour, target)

    def live(self, agent: int) -> LiveAttack:
        """It shines on an agent of the closed loop."""
        car = parse_target(self.target)
        if not isinstance(car, TargetCar):
            raise ConfigError(f"this light is made for {self.target}; only cars drive")
        return LiveAttack(self.edit, car, agent)


def export_light(out: Path, made: Shining, *, name: str = "") -> list[Path]:
    """Write a light attack: light.json, and for a projector its picture as picture.png and, exactly, picture.npz.

    Args:
        out: Folder.
        made: The attack.
        name: What light.json calls it.

    Returns:
        What was written.
    """
    attack = make_light(made.attack, made.options)
    about: dict[str, Any] = {
        "name": name,
        "attack": made.attack,
        "options": dict(made.options),
        "hour": made.hour,
        "target": made.target,
        "values": dict(made.values),
    }
    safeio.make_folder(out)
    written = [out / "light.json"]
    if made.colour is not None:
        assert isinstance(attack, Projector)
        numbers = safeio.npz_bytes({"colour": made.colour.numpy()})
        safeio.write_atomic(out / "picture.npz", numbers)
        everywhere = np.ones(tuple(made.colour.shape[1:]), np.bool_)
        save_picture(out / "picture.png", texture_picture(made.colour, everywhere))
        about |= {"lumens": attack.power(made.colour), "sha256": hashlib.sha256(numbers).hexdigest()}
        written += [out / "picture.png", out / "picture.npz"]
    elif not isinstance(attack, Projector):
        about["lumens"] = attack.power(made.values)
    safeio.write_atomic(out / "light.json", safeio.dump_json(about, indent=1) + "\n")
    return written


def load_light(folder: Path) -> Shining:
    """What `export_light` wrote.

    Raises:
        FormatError: A file is missing or broken, or the picture is not the one that was exported.
        SSADError: A light attack or an hour that there is not.
    """
    about, colour = safeio.read_json(folder / "light.json"), None
    try:
        if "sha256" in about:
            numbers = safeio.read_bytes(folder / "picture.npz")
            if hashlib.sha256(numbers).hexdigest() != about["sha256"]:
                raise FormatError(f"{folder / 'picture.npz'}: not what light.json describes; export it again")
            colour = torch.from_numpy(safeio.load_npz(folder / "picture.npz")["colour"].copy())
        found = Shining(about["attack"], about["options"], about["hour"], about["target"], about["values"], colour)
        make_light(found.attack, found.options)
        at_hour(Weather(), found.hour)
        return found
    except (KeyError, TypeError) as error:
        raise FormatError(f"{folder / 'light.json'}: no exported light ({error}); export it again") from None


def load_worn(folder: Path) -> Print | Shining:
    """What `ssad export texture` or `ssad export light` wrote.

    Raises:
        FormatError: Neither, or a broken one.
    """
    if (folder / "light.json").is_file():
        return load_light(folder)
    return load_print(folder)
