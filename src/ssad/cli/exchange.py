"""`ssad import` of maps, routes and drives, and `ssad export` of what a run has made."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from ssad.cli.options import Dir
from ssad.core.errors import ConfigError


def export_texture(
    folder: Dir,
    cell: Annotated[
        str, typer.Argument(metavar="CELL", help="Key of a cell of a physical run, the start of one, or its name.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="Folder for print.png, atlas.png, target.obj and texture.json.")
    ],
    dots: Annotated[int, typer.Option(min=1, help="Dots per metre of print.png.")] = 1000,
) -> None:
    """Write the texture of a physical attack at true size, and the target as OBJ that wears it."""
    from ssad.experiments.perception.physical.kind import shown_by
    from ssad.experiments.perception.physical.target_export import export_shown_texture

    attacks, found = shown_by(folder, cell)
    for path in export_shown_texture(attacks, found.spec, out, name=found.name, dots=dots):
        print(path)


def export_light(
    folder: Dir,
    cell: Annotated[
        str, typer.Argument(metavar="CELL", help="Key of a cell of a physical run, the start of one, or its name.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for light.json, and a projector's picture.")],
) -> None:
    """Write the settings of a light attack, and what a projector shows."""
    from ssad.experiments.perception.physical.kind import shown_by
    from ssad.experiments.perception.physical.target_export import export_shown_light

    attacks, found = shown_by(folder, cell)
    for path in export_shown_light(attacks, found.spec, out, name=found.name):
        print(path)


def import_map(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.xodr", help="OpenDRIVE file, or a town as SSAD stores it (.npz).")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the town.  [default: name of the file]")] = None,
) -> None:
    """Import an OpenDRIVE map as a town. Needs the extra `carla` (Python 3.11 or 3.12)."""
    from ssad.core.safeio import home
    from ssad.world.roads import import_map as bake
    from ssad.world.roads import load_town, town_names

    label = name or file.stem
    if town_names().get(label) == "built-in":
        raise ConfigError(f"'{label}' is a built-in town; choose another name with --name")
    path = bake(file, label, home())
    print(f"town {label}: {len(load_town(label).kind)} lanes, written to {path}")


def import_routes(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Routes of SafeBench, FREA (or a checkout) or leaderboard 1.0.")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the set.  [default: name of the folder]")] = None,
) -> None:
    """Import a folder of routes as a set of scenarios, for the key `scenarios` of a suite; name what is left out."""
    from ssad.core.safeio import home
    from ssad.scenarios.dynamic import import_routes as read
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.sets import BUILT_IN_SETS
    from ssad.world.roads import is_town

    label = name or folder.resolve().name
    if not label.replace("-", "").replace("_", "").isalnum():
        raise ConfigError(f"'{label}' cannot name a set; choose a name of letters, digits, _ and - with --name")
    if label in BUILT_IN_SETS:
        raise ConfigError(f"'{label}' is a built-in set; choose another name with --name")
    left_out: list[str] = []
    scenarios = read(folder, left_out=left_out)
    path = home() / "scenarios" / f"{label}.yaml"
    save_scenarios(path, scenarios)
    towns = sorted({s.town for s in scenarios})
    print(f"set {label}: {len(scenarios)} scenarios on {', '.join(towns)}, written to {path}")
    if missing := [town for town in towns if not is_town(town)]:
        print(f"before they can run, import the maps of {', '.join(missing)}: ssad import map FILE.xodr")
    counted = Counter(re.sub(r": entry \d+", "", line) for line in left_out)
    for line, count in counted.items():
        print(f"left out or not read: {line}{f' ({count} entries)' if count > 1 else ''}")


def import_drive(
    root: Annotated[Path, typer.Argument(metavar="DATAROOT", help="nuScenes root folder.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    scene: Annotated[str, typer.Option(help="Name or token of the scene.")],
    version: Annotated[str | None, typer.Option(help="Version.  [default: the only one]")] = None,
    on: Annotated[
        str | None,
        typer.Option("--map", metavar="MAP", help="Town, or OpenDRIVE file, of the place.  [default: logged paths]"),
    ] = None,
) -> None:
    """Turn a logged drive in the nuScenes schema into a scenario: the ego is driven anew, all others as logged.

    Where no town is known, lanes are made of the paths that were driven, and stored as a town beside OUT.yaml too.
    """
    from ssad.core.lane_graph import save_graph
    from ssad.core.safeio import home
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.interchange.drive_log import scenario_of_drive
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.world.roads import import_map as store
    from ssad.world.roads import town_names

    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a scenario file ends in .yaml")
    with NuScenes(root, version) as data:
        drive = scenario_of_drive(data, scene, town=out.stem, map_name=on)
    town = drive.scenario.town
    if not drive.known:
        if town_names().get(town) == "built-in":
            raise ConfigError(f"'{town}' is a built-in town; choose another name for {out}")
        save_graph(drive.graph, out.with_suffix(".npz"))
        store(out.with_suffix(".npz"), town, home())
    save_scenarios(out, drive.scenario)
    left = ", ".join(f"{count} {what}" for what, count in sorted(drive.left_out.items()))
    print(
        f"scenario {drive.scenario.name}: {len(drive.scenario.actors)} actors in {town}"
        f"{f'; left out: {left}' if left else ''}; written to {out}"
    )
