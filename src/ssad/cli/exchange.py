"""`ssad import` of maps, routes and drives, and `ssad export` of artefacts of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssad.cli import paths
from ssad.cli.importing import Strict, check_yaml, show_report, store_town
from ssad.cli.options import Dir
from ssad.core.errors import ConfigError, FormatError
from ssad.core.wording import counted

if TYPE_CHECKING:
    from ssad.world.roads.lanelet2 import Lanelet2Options


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
    from ssad.engine.store import read_run

    read_run(folder)
    paths.check_out(out, paths.EXPORTED_TEXTURE, option="OUT")
    from ssad.experiments.perception.physical.kind import attacks_and_cell
    from ssad.experiments.perception.physical.target_export import export_shown_texture

    attacks, attack_cell = attacks_and_cell(folder, cell)
    for path in export_shown_texture(attacks, attack_cell.spec, out, name=attack_cell.name, dots=dots):
        print(path)


def export_light(
    folder: Dir,
    cell: Annotated[
        str, typer.Argument(metavar="CELL", help="Key of a cell of a physical run, the start of one, or its name.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for light.json, and a projector's picture.")],
) -> None:
    """Write the settings of a light attack, and the picture that a projector shows."""
    from ssad.engine.store import read_run

    read_run(folder)
    paths.check_out(out, paths.EXPORTED_LIGHT, option="OUT")
    from ssad.experiments.perception.physical.kind import attacks_and_cell
    from ssad.experiments.perception.physical.target_export import export_shown_light

    attacks, attack_cell = attacks_and_cell(folder, cell)
    for path in export_shown_light(attacks, attack_cell.spec, out, name=attack_cell.name):
        print(path)


def import_map(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="OpenDRIVE file (.xodr), Lanelet2 map (.osm), or a town as SSAD stores it (.npz)."
        ),
    ],
    name: Annotated[str | None, typer.Option(help="Name of the town.  [default: name of the file]")] = None,
    strict: Strict = False,
    turn_on_red: Annotated[
        bool | None,
        typer.Option(
            "--turn-on-red/--no-turn-on-red",
            help="Whether turns to the near side are allowed on red.  [default: by rule of the road and country]",
        ),
    ] = None,
    uncontrolled: Annotated[
        str,
        typer.Option(
            metavar="keep|slow|signals",
            help="Junctions where ways meet without lights and signs: as in the file, 50 km/h across them, or that and "
            "traffic lights.",
        ),
    ] = "keep",
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON",
            help="Lanelet2: latitude and longitude of the town's origin.  [default: middle of the map]",
        ),
    ] = None,
    projection: Annotated[
        str | None,
        typer.Option(
            metavar="utm|local",
            help="Lanelet2: UTM, or transverse Mercator around the origin.  [default: local_x and local_y, else UTM]",
        ),
    ] = None,
    left_hand: Annotated[
        bool | None,
        typer.Option("--left-hand/--right-hand", help="Lanelet2: side that traffic keeps to.  [default: by the map]"),
    ] = None,
) -> None:
    """Import an OpenDRIVE map (1.4 to 1.8) or a Lanelet2 map as a town; say what is left out and what is doubtful.

    A page with this report and a picture from above is written too.
    """
    paths.check_exists(file)
    from rich.console import Console

    from ssad.core.import_report import ImportReport
    from ssad.core.safeio import home_folder
    from ssad.world.roads import import_map as bake
    from ssad.world.roads import load_town, town_names
    from ssad.world.roads.import_page import import_page_path

    town_name = name or file.stem
    if town_names().get(town_name) == "built-in":
        raise ConfigError(f"'{town_name}' is a built-in town; choose another name with --name")
    if uncontrolled not in ("keep", "slow", "signals"):
        raise ConfigError(f"--uncontrolled {uncontrolled}: choose keep, slow or signals")
    report = ImportReport(str(file))
    lanelet2 = _lanelet2_options(origin, projection, left_hand)
    # The line of progress stands on terminals alone, so that an error is the only line of a log.
    with Console(stderr=True).status(f"reading {file.name}") as status:
        path = bake(
            file,
            town_name,
            home_folder(),
            report=report,
            strict=strict,
            turn_on_red=turn_on_red,
            uncontrolled=uncontrolled,  # type: ignore[arg-type]
            progress=status.update,
            lanelet2=lanelet2,
        )
    print(report.text(f"town {town_name}: {counted(len(load_town(town_name).kind), 'lane')}, written to {path}"))
    print(f"a picture from above is in {import_page_path(home_folder(), town_name)}")


def _lanelet2_options(origin: str | None, projection: str | None, left_hand: bool | None) -> Lanelet2Options | None:
    """Return the options of a Lanelet2 map; None if no option is given."""
    from ssad.world.roads.lanelet2 import Lanelet2Options

    if origin is None and projection is None and left_hand is None:
        return None
    if projection not in (None, "utm", "local"):
        raise ConfigError(f"--projection {projection}: choose utm or local")
    place = None
    if origin is not None:
        try:
            latitude, longitude = (float(number) for number in origin.split(","))
        except ValueError:
            raise ConfigError(f"--origin {origin}: give latitude and longitude, such as 49.01,8.43") from None
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise ConfigError(f"--origin {origin}: latitudes end at 90 degrees, longitudes at 180")
        place = (latitude, longitude)
    return Lanelet2Options(place, projection, left_hand)  # type: ignore[arg-type]


def import_routes(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Routes of SafeBench, FREA (or a checkout) or leaderboard 1.0.")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the set.  [default: name of the folder]")] = None,
    strict: Strict = False,
) -> None:
    """Import a folder of routes as a set of scenarios, for the key `scenarios` of a suite; name what is left out."""
    from ssad.core.import_report import ImportReport
    from ssad.core.safeio import home_folder
    from ssad.scenarios.dynamic import import_routes as read
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.sets import BUILT_IN_SETS
    from ssad.world.roads import is_town

    set_name = name or folder.resolve().name
    if not set_name.replace("-", "").replace("_", "").isalnum():
        raise ConfigError(f"'{set_name}' cannot name a set; choose a name of letters, digits, _ and - with --name")
    if set_name in BUILT_IN_SETS:
        raise ConfigError(f"'{set_name}' is a built-in set; choose another name with --name")
    report = ImportReport(str(folder))
    scenarios = read(folder, report=report)
    if strict:
        report.refuse_doubts(FormatError)
    path = home_folder() / "scenarios" / f"{set_name}.yaml"
    save_scenarios(path, scenarios)
    towns = sorted({scenario.town for scenario in scenarios})
    if missing := [town for town in towns if not is_town(town)]:
        report.note(f"before they can run, import the maps of {', '.join(missing)}: ssad import map FILE")
    show_report(
        report, f"set {set_name}: {counted(len(scenarios), 'scenario')} on {', '.join(towns)}, written to {path}", path
    )


def import_drive(
    root: Annotated[Path, typer.Argument(metavar="DATAROOT", help="nuScenes root folder.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    scene: Annotated[str, typer.Option(help="Name or token of the scene.")],
    version: Annotated[str | None, typer.Option(help="Version.  [default: the only one]")] = None,
    on: Annotated[
        str | None,
        typer.Option("--map", metavar="MAP", help="Town, or map file, of the place.  [default: logged paths]"),
    ] = None,
    strict: Strict = False,
) -> None:
    """Turn a logged drive in the nuScenes schema into a scenario: the ego is driven anew, all others as logged.

    Where no town is known, lanes are made of the paths that were driven, and stored as a town beside OUT.yaml too.
    """
    paths.check_exists(root)
    from ssad.core.import_report import ImportReport
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.interchange.drive_log import scenario_of_drive
    from ssad.scenarios.dynamic import save_scenarios

    check_yaml(out)
    report = ImportReport(str(root))
    with NuScenes(root, version) as data:
        imported_drive = scenario_of_drive(data, scene, town=out.stem, map_name=on, report=report)
    if strict:
        report.refuse_doubts(FormatError)
    town = imported_drive.scenario.town
    if not imported_drive.is_known_town:
        store_town(imported_drive.graph, town, beside=out)
    save_scenarios(out, imported_drive.scenario)
    scenario = imported_drive.scenario
    show_report(
        report, f"scenario {scenario.name}: {counted(len(scenario.actors), 'actor')} in {town}; written to {out}", out
    )
