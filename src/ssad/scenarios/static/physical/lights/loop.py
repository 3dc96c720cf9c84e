"""Light attacks on a car in the drives of suites of kind `gap`: drawn at random, or as a search has found them."""

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
    """The light of a perturbation; None where it is night and nothing shines.

    Args:
        name: night; shine-LIGHT: settings drawn at random at full power, lamps by night, a shadow at the hour of the
            drive; shine:FOLDER: as it was found, at its hour.
        severity: 1 to 5, how strong a lamp is; of no account to a shadow and to what was found.
        seed: Of the settings.

    Raises:
        FormatError: There is no exported light in the folder.
    """
    if name == NIGHT:
        return None
    if name.startswith(FOUND):
        return load_light(Path(name.removeprefix(FOUND)).expanduser())
    light = name.removeprefix(SHINE)
    options: dict[str, Any] = {}
    if light in LAMPS:
        options = {LAMPS[light]: POWERS[severity - 1] * getattr(make_light(light, {}), LAMPS[light])}
    made, car = make_light(light, options), TargetCar()
    hour = NIGHT if light in LAMPS else "recorded"
    low, high = car.mesh().bounds()
    target = Target(*(high - low).tolist())
    if isinstance(made, Projector):
        size = made.surface(target).size
        colour = torch.from_numpy(generator("random light", light, seed).random((3, *size)).astype("float32"))
        return Shining(light, options, hour, "sedan", {}, colour)
    return Shining(light, options, hour, "sedan", random_settings(made, target, key=("loop", seed)))


def hour_of(name: str) -> str:
    """When the drives of a perturbation are: "recorded" (as they are), or an hour of `lit_clips.HOURS`."""
    found = shining(name)
    return NIGHT if found is None else found.hour


def light_version(name: str) -> str:
    """Hash of what `ssad export light` wrote; "" of other lights, which the code decides."""
    if not name.startswith(FOUND):
        return ""
    folder = Path(name.removeprefix(FOUND)).expanduser()
    total = hashlib.sha256()
    for file in ("light.json", "picture.npz"):
        if (folder / file).is_file():
            total.update(safeio.read_bytes(folder / file))
    return total.hexdigest()
