"""Images in the report of a table of physical attacks: detections under textures and lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ssad.core import safeio
from ssad.core.images import save_picture
from ssad.detectors.drawing import LEAST
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.physical.target_attacks import TargetAttacks
from ssad.experiments.perception.physical.target_table import CLEAN, GRID, Pair, TargetTable, options_title
from ssad.scenarios.static.physical import TextureSpec
from ssad.scenarios.static.physical.lights.folder import LightSpec

SIDES = (0.0, 90.0, 180.0, 270.0)  # of the grid that pictures show

Cells = Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]  # fields and spec, as of `TableRow`


def write_sheets(attacks: TargetAttacks, table: TargetTable, cells: Cells) -> None:
    """Write missing sheets of each test town under each texture, of the grid from four sides, and of lights.

    Args:
        attacks: Textures and lights of a results folder; sheets go to its folder `pictures`.
        table: The requested table.
        cells: Fields and spec of each cell.
    """
    folder, detector_name = attacks.folder, table.detectors[0]
    captions: dict[str, str] = {}
    lights, path = _lights_shown(cells, table, attacks), folder / "pictures" / "lights.jpg"
    if lights and not path.is_file() and (folder / "data" / table.pairs[0].test / "annotations").is_dir():
        save_picture(path, attacks.light_sheet(detector_name, table.pairs[0].test, lights))
    caption_start = (
        f"What {detector_name} finds (orange, score at least {LEAST[attacks.detector(detector_name).task]:g}) in"
    )
    if path.is_file():
        captions[path.name] = f"{caption_start} a picture of {table.pairs[0].test} under each light."
    for pair in table.pairs:
        pair_textures = _textures_shown(cells, attacks, pair, detector_name)
        trained = [
            (title, texture_spec)
            for title, texture_spec in pair_textures.items()
            if texture_spec.source and not texture_spec.of
        ]
        for view, camera_side, sides, sheet_textures in (
            ("drive", "from behind", (None,), pair_textures),
            (GRID, "from the front, the left, the rear and the right", SIDES, dict(trained[-1:])),
        ):
            path = folder / "pictures" / f"{view}-{pair.test.lower()}.jpg"
            recording = folder / "data" / f"{pair.test}{'-grid' if view == GRID else ''}"
            target_images = RelightableTargetImages(recording, 1, device=attacks.device)
            if pair_textures and not path.is_file() and (target_images.folder / "annotations").is_dir():
                save_picture(
                    path, attacks.sheet(detector_name, target_images, textures=sheet_textures, sides=sides, clean=CLEAN)
                )
            if path.is_file():
                captions[path.name] = f"{caption_start} {pair.test}, clean and attacked, {camera_side}."
    if captions:
        safeio.write_atomic(folder / "pictures" / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")


def _textures_shown(cells: Cells, attacks: TargetAttacks, pair: Pair, detector: str) -> dict[str, TextureSpec]:
    """Return the stored textures of a pair of towns, one of each attack, by title."""
    textures: dict[str, TextureSpec] = {}
    for fields, spec in cells:
        if spec["attack"] is None or spec["pair"] != pair.model_dump() or spec["number"]:
            continue
        if fields["detector"] == detector and spec["source"] in ("", detector):
            texture = TextureSpec.of_row(spec)
            if not texture.trained or attacks.textures.colour_path(texture).is_file():
                textures.setdefault(f"{fields['attack']} ({fields['carrier']})", texture)
    return textures


def _lights_shown(cells: Cells, table: TargetTable, attacks: TargetAttacks) -> dict[str, tuple[str, LightSpec | None]]:
    """Return the stored lights of the first detector and pair of towns by title, with their hours; None: no light."""
    lights: dict[str, tuple[str, LightSpec | None]] = {}
    for fields, cell_spec in cells:
        light: Mapping[str, Any] = cell_spec.get("light", {})
        if not light or light["number"] or light["pair"] != table.pairs[0].model_dump():
            continue
        if fields["detector"] != table.detectors[0]:
            continue
        spec = None if light["attack"] is None else LightSpec.of_row(light)
        if spec is None or attacks.lights.record_path(spec).is_file():
            title = f"{fields['attack']}, {light['hour']} {options_title(light)}"
            lights.setdefault(title, (light["hour"], spec))
    return lights
