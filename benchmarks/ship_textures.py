"""Ship the textures of a finished run: python benchmarks/ship_textures.py RUN [--attacks adv-patch,vanishing-all-sides]

RUN is what `ssad run physical` wrote. For each attack that was trained against a detector and scored on it, NAME.png
and NAME.json go to src/ssad/scenarios/static/physical/textures/trained; suites then name them (`texture: NAME`). What
did not beat the controls, and what inks cannot print, is left out: the run's own records decide. Of an attack in
several sizes the last that passes ships.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssad.core.images import read_image
from ssad.core.safeio import make_folder
from ssad.experiments.perception.physical.page import margin_table
from ssad.experiments.perception.physical.physical_run import PhysicalRun, lower, title_of
from ssad.rendering.target import class_of_target, parse_target
from ssad.report.load import load_run
from ssad.scenarios.static.physical.textures.card import SHIPPED, TextureCard, save_texture
from ssad.scenarios.static.physical.textures.inks import CHARACTERISATION

METRICS = ("AP50", "AP50_25", "ASR_25", "n0_25", "ASR_50", "n0_50")


def ship(folder: Path, attacks: set[str]) -> list[str]:
    """Write the textures; their names."""
    run = load_run(folder)
    suite, weights = run.suite, run.header["weights"]
    margins = {row.head[:3]: lower(row.cells[2]) for row in margin_table(PhysicalRun(run)).rows}
    textures: dict[str, tuple[Mapping[str, Any], TextureCard]] = {}
    for line in run.lines:
        own = line["status"] == "ok" and line["view"] == "drive" and line["detector"] == line["source"]
        attack = line["attack"].replace(", ", "-").replace(" ", "-")
        if not own or "epochs" not in line or (attacks and attack not in attacks) or line["spec"]["of"]:
            continue
        title = title_of((line["attack"], line["carrier"]))
        margin = margins.get((line["test"], line["detector"], title))
        if margin is None or margin <= 0:
            print(f"{title} in {line['test']} is not stronger than the controls: left out")
            continue
        if not line["spec"].get("inks") or line.get("outside_gamut") != 0.0:
            outside = line.get("outside_gamut")
            reason = (
                f"{outside:.1%} of its texels outside the gamut of the inks" if outside else "not trained with inks"
            )
            print(f"{title} in {line['test']} cannot be printed ({reason}): left out")
            continue
        spec, pair, around = line["spec"], line["spec"]["pair"], line["spec"]["around"]
        sort = class_of_target(parse_target(suite["target"]))
        place = f"{suite['behind']:g} m behind" if sort == "car" else f"of a {sort.replace('_', ' ')}"
        if spec.get("approach"):
            distances = suite["approach"]["distances"]
            place = f"{min(distances):g} to {max(distances):g} m {'behind' if sort == 'car' else place}"
        data = (
            f"{pair['train_images']} pictures of drives in {pair['train']}, {place}"
            f"{f', and {around} from all around' if around else ''}; metrics: "
            f"{pair['test_images']} in {pair['test']}; suite {suite['name']}, seed {suite['seed']}"
        )
        card = TextureCard(
            spec["attack"],
            spec["carrier"],
            spec["options"],
            line["source"],
            weights[line["source"]],
            suite["target"],
            data,
            run.command,
            int(line["epochs"]),
            {name: line["metrics"][name] for name in METRICS},
            inks=CHARACTERISATION,
        )
        made_for = "" if sort == "car" else f"-{sort.replace('_', '-')}"
        name = f"{attack}-{line['source']}{made_for}-{pair['train'].lower()}"
        if name in textures:
            print(f"{name}: {spec['options']} ships, not {textures[name][1].options}")
        textures[name] = (line, card)
    make_folder(SHIPPED)
    for name, (line, card) in textures.items():
        save_texture(SHIPPED / name, read_image(folder / line["artefacts"]["texture"]), card)
    return sorted(textures)


def main() -> None:
    """Ship, and say what."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--attacks", default="")
    given = parser.parse_args()
    print(json.dumps(ship(given.run, {name for name in given.attacks.split(",") if name}), indent=1))


if __name__ == "__main__":
    main()
