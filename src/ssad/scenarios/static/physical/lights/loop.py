"""Light attacks on a car in the drives of suites of kind `gap`: drawn at random, or found by a search."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

import torch

from ssad.core import safeio
from ssad.core.seeding import generator
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.physical.lights import LIGHTS, Projector, Target, make_light, random_settings
from ssad.scenarios.static.physical.lights.export import Shining, load_light

NIGHT: Final = "night"
SHINE: Final = "shine-"
FOUND: Final = "shine:"  # and the folder that `ssad export light` wrote
LIT: Final = (NIGHT, *(f"{SHINE}{name}" for name in LIGHTS))
POWERS: Final = (0.25, 0.5, 1.0, 2.0, 4.0)  # by severity, of each lamp's own
LAMPS: Final = {"laser": "watts", "projector": "lumens", "flashlight": "lumens"}  # what says how strong a lamp is


def shining(name: str, severity: int = 3, seed: int = 0) -> Shining | None:
    """Return the light of a perturbation; None for a dark night.

    Args:
        name: night; shine-LIGHT: settings drawn at random at full power, lamps by night, a shadow at the hour of
            the drive; shine:FOLDER: an exported light, at its hour.
        severity: 1 to 5, power of a lamp; ignored for a shadow and an exported light.
        seed: Seed of the settings.

    Raises:
        FormatError: The folder holds no exported light.
    """
    if name == NIGHT:
        return None
    if name.startswith(FOUND):
        return load_light(Path(name.removeprefix(FOUND)).expanduser())
    light_name = name.removeprefix(SHINE)
    options: dict[str, Any] = {}
    if light_name in LAMPS:
        options = {LAMPS[light_name]: POWERS[severity - 1] * getattr(make_light(light_name, {}), LAMPS[light_name])}
    light_attack, car = make_light(light_name, options), TargetCar()
    hour = NIGHT if light_name in LAMPS else "recorded"
    lower, upper = car.mesh().bounds()
    target = Target(*(upper - lower).tolist())
    if isinstance(light_attack, Projector):
        texture_size = light_attack.surface(target).size
        colour = torch.from_numpy(
            generator("random light", light_name, seed).random((3, *texture_size)).astype("float32")
        )
        return Shining(light_name, options, hour, "sedan", {}, colour)
    return Shining(light_name, options, hour, "sedan", random_settings(light_attack, target, key=("loop", seed)))


def hour_of(name: str) -> str:
    """Return the hour of the drives of a perturbation: "recorded" (unchanged), or one of `lit_clips.HOURS`."""
    light = shining(name)
    return NIGHT if light is None else light.hour


def light_version(name: str) -> str:
    """Return the hash of an export of `ssad export light`; "" for other lights, which the code decides."""
    if not name.startswith(FOUND):
        return ""
    folder = Path(name.removeprefix(FOUND)).expanduser()
    hasher = hashlib.sha256()
    for file_name in ("light.json", "picture.npz"):
        if (folder / file_name).is_file():
            hasher.update(safeio.read_bytes(folder / file_name))
    return hasher.hexdigest()
