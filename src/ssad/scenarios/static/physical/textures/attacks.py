"""Registry of the attacks that train a texture."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.registry import names, resolve
from ssad.core.schema import build_validated
from ssad.scenarios.static.physical.textures.optimise import TextureAttack

ATTACKS: dict[str, str] = {
    "adv-patch": "ssad.scenarios.static.physical.textures.adv_patch:adv_patch",
    "das": "ssad.scenarios.static.physical.textures.das:das",
    "tpa": "ssad.scenarios.static.physical.textures.tpa:tpa",
    "vanishing": "ssad.scenarios.static.physical.textures.vanishing:vanishing",
}


def physical_names() -> dict[str, str]:
    """Return the names of all attacks that train a texture and the objects that define them."""
    return names("physical-attack", ATTACKS)


def make_physical(name: str, /, **settings: Any) -> TextureAttack:
    """Create an attack that trains a texture, by name.

    Args:
        name: Key of `ATTACKS`, or "module:object".
        **settings: Fields of `TextureAttack` that differ from the attack's own.

    Raises:
        UnknownNameError: There is no such attack.
        ConfigError: A setting is unknown or has an invalid value.
    """
    definition = resolve("physical-attack", ATTACKS, name)
    factory = definition if callable(definition) else partial(replace, definition)
    try:
        attack = build_validated(factory, settings, subject=f"attack {name}", kind=TextureAttack)
    except TypeError as error:
        raise ConfigError(f"attack {name}: {error}") from None
    if not isinstance(attack, TextureAttack):
        raise ConfigError(f"attack {name}: expected a TextureAttack, not {type(attack).__name__}")
    return attack


def default_carrier(name: str) -> str:
    """Return the carrier of an attack for suites that do not name one."""
    return "patch" if name == "adv-patch" else "camouflage"
