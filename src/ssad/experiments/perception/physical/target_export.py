"""`ssad export texture` and `ssad export light`: the texture or light of a cell of a physical run, for other uses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssad.core.errors import ConfigError, StoreError
from ssad.experiments.perception.physical.target_attacks import TargetAttacks, surface_of
from ssad.scenarios.static.physical import TextureSpec
from ssad.scenarios.static.physical.lights.export import LightSetup, export_light
from ssad.scenarios.static.physical.lights.folder import LightSpec
from ssad.scenarios.static.physical.textures.export import PrintedTexture, export_texture


def export_shown_texture(
    attacks: TargetAttacks, row: Mapping[str, Any], out: Path, *, name: str, dots: int = 1000
) -> list[Path]:
    """Write the texture of a row.

    Args:
        attacks: Attacks of the run.
        row: Its spec, as of `TableRow`.
        out: Folder to write to.
        name: Name of the texture.
        dots: Dots of the print per metre.

    Returns:
        The written files (see `ssad.scenarios.static.physical.textures.export.export_texture`).

    Raises:
        ConfigError: The row shows no texture.
        StoreError: The texture has not been trained yet.
    """
    if row["attack"] is None:
        if row.get("light", {}).get("attack"):
            raise ConfigError(f"{name} shows a light: ssad export light writes it")
        raise ConfigError(f"{name} shows no texture; choose one of an attack or control")
    spec = TextureSpec.of_row(row)
    if spec.trained and not attacks.textures.colour_path(spec).is_file():
        raise StoreError(f"{attacks.folder}: the texture of {name} is not trained yet; run the suite")

    def fail_if_missing() -> list[object]:
        raise StoreError(f"{attacks.folder}: the texture of {name} is gone; run the suite again")

    surface = surface_of(attacks.target, spec.surface)
    colour = attacks.textures.texture(spec, surface, views=fail_if_missing, detector=fail_if_missing)  # type: ignore[arg-type]
    return export_texture(out, PrintedTexture(colour, spec.carrier, spec.options, attacks.target), dots=dots, name=name)


def export_shown_light(attacks: TargetAttacks, row: Mapping[str, Any], out: Path, *, name: str) -> list[Path]:
    """Write the light attack of a row.

    Args:
        attacks: Attacks of the run.
        row: Its spec, as of `TableRow`.
        out: Folder to write to.
        name: Name of the light.

    Returns:
        The written files (see `ssad.scenarios.static.physical.lights.export.export_light`).

    Raises:
        ConfigError: The row shows no light.
        StoreError: The light has not been searched yet.
    """
    light_row = row.get("light")
    if light_row is None or light_row["attack"] is None:
        raise ConfigError(f"{name} shows no light; choose one of a light attack")
    spec = LightSpec.of_row(light_row)
    if not attacks.lights.record_path(spec).is_file():
        raise StoreError(f"{attacks.folder}: the light of {name} is not searched yet; run the suite")
    values, colour = attacks.lights.load_values(spec)
    return export_light(
        out, LightSetup(spec.device, spec.options, spec.hour, attacks.target, values, colour), name=name
    )
