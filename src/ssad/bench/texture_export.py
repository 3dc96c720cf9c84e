"""`ssad export texture`: the texture of a cell of a physical run, for printing and for other programs."""

from __future__ import annotations

from pathlib import Path

from ssad.bench.kind import find_cell
from ssad.bench.run import read_plan
from ssad.core.errors import ConfigError, StoreError
from ssad.recording.target import parse_target
from ssad.recording.texture_export import Print, export_texture
from ssad.scenarios.static.physical import CONTROLS, TextureSpec, make_carrier
from ssad.scenarios.static.physical.kept import TextureFolder


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
        raise ConfigError(
            f"{folder}: cell {cell.key} ({cell.name}) shows no texture; choose one of an attack or control"
        )
    spec, suite = TextureSpec.of_row(cell.spec), plan.suite
    kept = TextureFolder(folder / "textures", suite.seed, "cpu")
    if (spec.attack not in CONTROLS or spec.source) and not kept.kept(spec).is_file():
        raise StoreError(f"{folder}: the texture of cell {cell.key} ({cell.name}) is not trained yet; run the suite")

    def never() -> list[object]:
        raise StoreError(f"{folder}: the texture of cell {cell.key} is gone; run the suite again")

    surface = make_carrier(spec.carrier, spec.options).on(parse_target(suite.target).mesh())
    colour = kept.texture(spec, surface, views=never, detector=never)  # type: ignore[arg-type]
    return export_texture(out, Print(colour, spec.carrier, spec.options, suite.target), dots=dots, name=cell.name)
