"""The table of attacks that train a texture."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.registry import names, resolve
from ssad.core.schema import checked
from ssad.scenarios.static.physical.textures.optimise import TextureAttack

ATTACKS: dict[str, str] = {
    "adv-patch": "ssad.scenarios.static.physical.textures.adv_patch:adv_patch",
    "das": "ssad.scenarios.static.physical.textures.das:das",
    "tpa": "ssad.scenarios.static.physical.textures.tpa:tpa",
    "vanishing": "ssad.scenarios.static.physical.textures.vanishing:vanishing",
}


def physical_names() -> dict[str, str]:
    """All names of attacks that train a texture -> where they come from."""
    return names("physical-attack", ATTACKS)


def make_physical(name: str, /, **settings: Any) -> TextureAttack:
    """An attack that trains a texture, by name.

    Args:
        name: Of `ATTACKS`, or "module:object".
        **settings: Fields of `TextureAttack` that differ from the attack's own.

    Raises:
        UnknownNameError: There is no such attack.
        ConfigError: A setting that it does not have, or a value that it refuses.
    """
    build = resolve("physical-attack", ATTACKS, name)
    make = build if callable(build) else partial(replace, build)
    try:
        made = checked(make, settings, what=f"attack {name}", kind=TextureAttack)
    except TypeError as error:
        raise ConfigError(f"attack {name}: {error}") from None
    if not isinstance(made, TextureAttack):
        raise ConfigError(f"attack {name}: expected a TextureAttack, not {type(made).__name__}")
    return made


def default_carrier(name: str) -> str:
    """What a texture is printed on if a suite does not say."""
    return "patch" if name == "adv-patch" else "camouflage"
