"""Light attacks as cells of the kind `physical`: at an hour, on pictures rendered then, with random settings beside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ssad.bench.kind import Cell, Kind
from ssad.bench.physical_suite import PhysicalSuite, check_lights
from ssad.scenarios.static.physical.noninvasive.kept import LightFolder, LightSpec

CLEAN, RANDOM = "clean", "random"


def light_cells(kind: Kind, suite: PhysicalSuite, weights: Mapping[str, str], device: str) -> Iterator[Cell]:
    """The cells of the lights of a suite: for each hour the clean pictures, then each attack and its controls."""
    check_lights(suite)
    for pair in suite.pairs:
        for detector in suite.detectors:
            rows: list[dict[str, Any]] = [
                {"attack": None, "of": None, "options": {}, "settings": {}, "hour": hour}
                for hour in dict.fromkeys(entry.hour for entry in suite.lights)
            ]
            for entry in suite.lights:
                own = {"of": None, "options": entry.options, "settings": entry.settings, "hour": entry.hour}
                rows.append({"attack": entry.name, **own})
                rows += [
                    {**own, "attack": RANDOM, "of": entry.name, "settings": {}, "number": number}
                    for number in range(suite.seeds)
                ]
            for row in rows:
                source = detector if row["attack"] not in (None, RANDOM) else ""
                light = {"number": 0, **row, "source": source, "pair": pair.model_dump()}
                name = CLEAN if row["attack"] is None else f"{RANDOM} {row['of']}" if row["of"] else row["attack"]
                fields = {
                    "test": pair.test, "train": pair.train, "view": "drive", "detector": detector,
                    "carrier": f"light, {row['hour']}",
                    "attack": name, "source": source, "number": light["number"],
                }  # fmt: skip
                title = "/".join([detector, pair.test, name, row["hour"], _brief(row["options"]), str(light["number"])])
                inputs = suite.target, suite.behind, suite.size, suite.floor, suite.replicates, device
                spec = {"attack": None, "light": light}
                yield kind.make_cell(title, detector, suite.seed, fields, spec, *inputs, weights[detector])


def _brief(options: Mapping[str, Any]) -> str:
    return ",".join(f"{key}={value}" for key, value in options.items()) or "as it is"


def lights_shown(
    cells: Sequence[Cell], suite: PhysicalSuite, kept: LightFolder
) -> dict[str, tuple[str, LightSpec | None]]:
    """The lights of the first detector and pair of towns that are there, by title, with their hours; None: no light."""
    found: dict[str, tuple[str, LightSpec | None]] = {}
    for cell in cells:
        light: Mapping[str, Any] = cell.spec.get("light", {})
        if not light or light["number"] or light["pair"] != suite.pairs[0].model_dump():
            continue
        if cell.system != suite.detectors[0]:
            continue
        spec = None if light["attack"] is None else LightSpec.of_row(light)
        if spec is None or kept.kept(spec).is_file():
            title = f"{cell.fields['attack']}, {light['hour']} {_brief(light['options'])}"
            found.setdefault(title, (light["hour"], spec))
    return found
