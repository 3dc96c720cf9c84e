"""Non-invasive physical attacks (paper III.A.1): light and shadow on an unmodified target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ssad.core.errors import unknown_name
from ssad.core.registry import make, names, resolve
from ssad.core.schema import build_validated
from ssad.scenarios.static.physical.lights.flashlight import Flashlight
from ssad.scenarios.static.physical.lights.laser import Laser
from ssad.scenarios.static.physical.lights.light import LightAttack, TargetSize
from ssad.scenarios.static.physical.lights.lit_image import LitImage
from ssad.scenarios.static.physical.lights.projector import Projector
from ssad.scenarios.static.physical.lights.search import (
    LightSearchResult,
    SearchBudget,
    SearchView,
    random_settings,
    search_light,
)
from ssad.scenarios.static.physical.lights.shadow import Shadow

LIGHTS: dict[str, Callable[..., Shadow | Laser | Projector | Flashlight]] = {
    "shadow": Shadow,
    "laser": Laser,
    "projector": Projector,
    "flashlight": Flashlight,
}

BUILT_IN: dict[str, str] = dict.fromkeys(LIGHTS, __name__)
"""Built-in light attacks and the package that defines them."""


def make_light(name: str, options: Mapping[str, Any]) -> Any:
    """Create a light attack by name.

    Args:
        name: Key of `LIGHTS`, entry point of the group `ssad.lights`, or "module:object" of a `LightAttack`.
        options: Fields that differ from the defaults.

    Raises:
        UnknownNameError: There is no such attack.
        ConfigError: An option is unknown or has an invalid value.
    """
    if name in LIGHTS:
        return build_validated(LIGHTS[name], options, subject=f"attack {name}")
    if ":" not in name and name not in names("light", {}):
        raise unknown_name("light attack", name, LIGHTS)
    return make("light", name, resolve("light", {}, name), options, ("ranges", "edit"))


__all__ = [
    "LIGHTS",
    "Flashlight",
    "Laser",
    "LightAttack",
    "LightSearchResult",
    "LitImage",
    "Projector",
    "SearchBudget",
    "SearchView",
    "Shadow",
    "TargetSize",
    "make_light",
    "random_settings",
    "search_light",
]
