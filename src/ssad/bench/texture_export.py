"""`ssad export texture` and `ssad export light`: what a cell of a physical run shows, for use outside."""

from __future__ import annotations

from pathlib import Path

from ssad.bench.kind import find_cell
from ssad.bench.run import read_plan
from ssad.core.errors import ConfigError, StoreError
from ssad.recording.light_export import Shining, export_light
from ssad.recording.target import parse_target
from ssad.recording.texture_export import Print, export_texture
from ssad.scenarios.static.physical import TextureSpec, make_carrier
from ssad.scenarios.static.physical.kept import TextureFolder
from ssad.scenarios.static.physical.noninvasive.kept import LightFolder, LightSpec


def export_cell_texture(folder: Path, name: str, out: Path, *, dots: int = 1000) -> list[Path]:
    """Write the texture that a cell of a physical run shows.

    Args:
        folder: Results folder of the run.
        name: The cell: its key, the start of one, or its name.
        out: Where to write.
        dots: Of the print for each metre.

    Returns:
        What was written (see `ssad.recording.texture_export.export_texture`).

    Raises:
        ConfigError: There is no such cell, or it shows no texture.
        StoreError: The texture has not been trained yet.
    """
    plan = read_plan(folder)
    cell = find_cell(plan.cells, name)
    if plan.kind.name != "physical" or cell.spec.get("attack") is None:
        if cell.spec.get("light", {}).get("attack"):
            raise ConfigError(f"{folder}: cell {cell.key} ({cell.name}) shows a light: ssad export light writes it")
        raise ConfigError(
            f"{folder}: cell {cell.key} ({cell.name}) shows no texture; choose one of an attack or control"
        )
    spec, suite = TextureSpec.of_row(cell.spec), plan.suite
    kept = TextureFolder(folder / "textures", suite.seed, "cpu")
    if spec.trained and not kept.kept(spec).is_file():
        raise StoreError(f"{folder}: the texture of cell {cell.key} ({cell.name}) is not trained yet; run the suite")

    def never() -> list[object]:
        raise StoreError(f"{folder}: the texture of cell {cell.key} is gone; run the suite again")

    surface = make_carrier(spec.carrier, spec.options).on(parse_target(suite.target).mesh())
    colour = kept.texture(spec, surface, views=never, detector=never)  # type: ignore[arg-type]
    return export_texture(out, Print(colour, spec.carrier, spec.options, suite.target), dots=dots, name=cell.name)


def export_cell_light(folder: Path, name: str, out: Path) -> list[Path]:
    """Write the light attack of a cell of a physical run.

    Args:
        folder: Results folder of the run.
        name: The cell: its key, the start of one, or its name.
        out: Where to write.

    Returns:
        What was written (see `ssad.recording.light_export.export_light`).

    Raises:
        ConfigError: There is no such cell, or it shows no light.
        StoreError: The light has not been searched yet.
    """
    plan = read_plan(folder)
    cell = find_cell(plan.cells, name)
    light = cell.spec.get("light") if plan.kind.name == "physical" else None
    if light is None or light["attack"] is None:
        raise ConfigError(f"{folder}: cell {cell.key} ({cell.name}) shows no light; choose one of a light attack")
    spec, kept = LightSpec.of_row(light), LightFolder(folder / "lights", plan.suite.seed, "cpu")
    if not kept.kept(spec).is_file():
        raise StoreError(f"{folder}: the light of cell {cell.key} ({cell.name}) is not searched yet; run the suite")
    values, colour = kept.found(spec)
    made = Shining(spec.device, spec.options, spec.hour, plan.suite.target, values, colour)
    return export_light(out, made, name=cell.name)
