"""Commands of `ssad export SCENARIO... OUT` and of the imports of other formats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from ssad.cli import paths
from ssad.core.errors import ConfigError, FormatError
from ssad.core.wording import counted

if TYPE_CHECKING:
    from ssad.core.import_report import ImportReport
    from ssad.core.lane_graph import LaneGraph

Strict = Annotated[bool, typer.Option("--strict", help="Refuse a file with anything doubtful.")]


class Format(StrEnum):
    """Formats to which scenarios can be exported."""

    openscenario = "openscenario"
    leaderboard = "leaderboard"
    leaderboard1 = "leaderboard1"
    commonroad = "commonroad"


class ExportGroup(TyperGroup):
    """Commands of `ssad export`; arguments that begin with none of them are scenarios."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the name of the command for scenarios if it was left out."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["scenarios", *args]
        return super().parse_args(ctx, args)


def register(exports: typer.Typer, imports: typer.Typer) -> None:
    """Add the commands of this module to `ssad export` and `ssad import`."""
    exports.command("scenarios")(export_scenarios)
    imports.command("openscenario")(import_openscenario)
    imports.command("leaderboard")(import_leaderboard)
    imports.command("commonroad")(import_commonroad)
    imports.command("scenic")(import_scenic)


def export_scenarios(
    scenarios: Annotated[
        list[str], typer.Argument(metavar="SCENARIO...", help="Sets, classes, names or YAML files of scenarios.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    to: Annotated[Format, typer.Option("--format", help="Format.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episodes: of their random traffic.")] = 0,
    system: Annotated[
        str, typer.Option(help="Drives the ego while others' trajectories are recorded (commonroad).")
    ] = "autopilot",
) -> None:
    """Write scenarios for other programs, with the maps of their towns, and say what is not carried over.

    The word `scenarios` may be left out: ssad export precrash OUT --format openscenario
    """
    paths.check_out(out, paths.EXPORTED_SCENARIOS, option="OUT")
    from ssad.interchange.export import export_commonroad, export_openscenario
    from ssad.interchange.leaderboard import export_leaderboard, export_leaderboard1
    from ssad.scenarios.dynamic import load_scenarios

    selected = [scenario for reference in scenarios for scenario in load_scenarios(reference)]
    writers: dict[Format, Callable[..., tuple[list[Path], list[str]]]] = {
        Format.openscenario: export_openscenario,
        Format.leaderboard: export_leaderboard,
        Format.leaderboard1: export_leaderboard1,
        Format.commonroad: partial(export_commonroad, system=system),
    }
    files, omissions = writers[to](selected, out, seed=seed)
    print(f"{counted(len(selected), 'scenario')}: {counted(len(files), 'file')} written to {out}")
    print_counted("not carried over", omissions)


def import_openscenario(
    file: Annotated[Path, typer.Argument(metavar="FILE.xosc", help="OpenSCENARIO XML file.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    on: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Town, or OpenDRIVE file.  [default: the file's own]")
    ] = None,
    values: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Value of a parameter of the file.")
    ] = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="Scenarios to draw from a distribution.  [default: all]")
    ] = None,
    strict: Strict = False,
) -> None:
    """Turn an OpenSCENARIO XML file (1.0 to 1.3) into scenarios, and say what it does not carry over.

    A file of a ParameterValueDistribution becomes a set: one scenario for each set of values. The map beside the file
    is imported with it.
    """
    paths.check_exists(file)
    from ssad.core.errors import FormatError
    from ssad.interchange.openscenario_distributions import assigned_values
    from ssad.interchange.openscenario_reader import read_openscenario_set
    from ssad.scenarios.dynamic import save_scenarios

    check_yaml(out)
    imported = read_openscenario_set(file, map_name=on, assigned=assigned_values(values or []), count=count)
    if strict:
        imported.report.refuse_doubts(FormatError)
    scenarios = imported.scenarios
    save_scenarios(out, scenarios if len(scenarios) > 1 else scenarios[0])
    towns = ", ".join(sorted({scenario.town for scenario in scenarios}))
    if len(scenarios) > 1:
        first_line = f"{counted(len(scenarios), 'scenario')} in {towns}; written to {out}"
    else:
        first_line = (
            f"scenario {scenarios[0].name}: {counted(len(scenarios[0].actors), 'actor')} in {towns}; written to {out}"
        )
    show_report(imported.report, first_line, out)


def import_leaderboard(
    file: Annotated[Path, typer.Argument(metavar="ROUTES.xml", help="Routes of leaderboard 2.0 or Bench2Drive.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    strict: Strict = False,
) -> None:
    """Turn routes of leaderboard 2.0 or Bench2Drive into scenarios; `ssad import routes` reads leaderboard 1.0.

    Routes without scenarios become free drives in natural traffic. Their towns must be imported before they are driven.
    """
    paths.check_exists(file)
    from rich.console import Console

    from ssad.core.import_report import ImportReport
    from ssad.engine.progress import LiveProgress
    from ssad.interchange.leaderboard import read_leaderboard
    from ssad.scenarios.dynamic import save_scenarios

    check_yaml(out)
    report = ImportReport(str(file))
    with LiveProgress("import", 1, 0, console=Console(stderr=True), unit="routes") as progress:
        imported = read_leaderboard(file, report=report, progress=progress.show)
    if strict:
        report.refuse_doubts(FormatError)
    save_scenarios(out, imported)
    towns = ", ".join(sorted({scenario.town for scenario in imported}))
    show_report(report, f"{counted(len(imported), 'scenario')} on {towns}; written to {out}", out)


def import_commonroad(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CommonRoad XML file, 2020a or 2018b, or protobuf.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    on: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Town, or OpenDRIVE file.  [default: its lanelets]")
    ] = None,
    strict: Strict = False,
) -> None:
    """Turn a CommonRoad file into a scenario; say what is left out and what is doubtful.

    XML 2018b and protobuf need the extra `commonroad`. Lanelets that are no town's yet are stored as a town beside
    OUT.yaml too.
    """
    paths.check_exists(file)
    from ssad.core.import_report import ImportReport
    from ssad.interchange.commonroad_reader import read_commonroad
    from ssad.scenarios.dynamic import save_scenarios

    check_yaml(out)
    report = ImportReport(str(file))
    imported = read_commonroad(file, town=out.stem, map_name=on, report=report)
    if strict:
        report.refuse_doubts(FormatError)
    town = imported.scenario.town
    if not imported.is_known_town:
        store_town(imported.graph, town, beside=out)
    save_scenarios(out, imported.scenario)
    scenario = imported.scenario
    show_report(
        report, f"scenario {scenario.name}: {counted(len(scenario.actors), 'actor')} in {town}; written to {out}", out
    )


def import_scenic(
    file: Annotated[Path, typer.Argument(metavar="FILE.scenic", help="Scenic program. It is code: it is run.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="Scenario file to write.")],
    on: Annotated[
        str | None, typer.Option("--map", metavar="TOWN", help="Town.  [default: named as the program's map]")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Samples.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first sample; each has one more.")] = 0,
    steps: Annotated[int, typer.Option(min=1, max=10_000, help="Most steps of a simulation, 0.1 s each.")] = 300,
    strict: Strict = False,
) -> None:
    """Simulate samples of a Scenic program here, and turn what happens into scenarios. Needs the extra `scenic`.

    The ego is driven anew; all others repeat what the program had them do. Samples that fail are doubtful.
    """
    from ssad.core.errors import MissingExtraError, SSADError
    from ssad.core.import_report import ImportReport
    from ssad.interchange.scenic_programs import load_program, sample
    from ssad.scenarios.dynamic import save_scenarios

    check_yaml(out)
    program = load_program(file, on)
    report = ImportReport(str(file))
    sampled = []
    for sample_seed in range(seed, seed + count):
        try:
            program_sample = sample(program, sample_seed, steps=steps, report=report)
        except MissingExtraError:
            raise
        except SSADError as error:
            if count == 1:
                raise
            report.doubt(f"not sampled: {error}")
            continue
        sampled.append(program_sample.scenario)
    if not sampled:
        raise ConfigError(next(iter(report.doubts)).removeprefix("not sampled: "))
    if strict:
        report.refuse_doubts(FormatError)
    report.contents.append(f"{len(sampled)} of {count} samples, seeds {seed} to {seed + count - 1}")
    save_scenarios(out, sampled)
    show_report(report, f"{counted(len(sampled), 'scenario')} in {program.town}; written to {out}", out)


def check_yaml(out: Path) -> None:
    """Raise ConfigError if a scenario file does not end in .yaml."""
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a scenario file ends in .yaml")


def show_report(report: ImportReport, first_line: str, out: Path) -> None:
    """Print the report of an import, and write it beside the result, there with every place that it names.

    Args:
        report: The report. Its doubts are refused earlier, before anything is written.
        first_line: Name and place of the result.
        out: The result, such as a scenario file.
    """
    from ssad.core.import_report import report_path
    from ssad.core.safeio import write_atomic

    print(report.text(first_line))
    write_atomic(report_path(out), f"{report.text(f'import of {report.source}', examples=None)}\n")
    print(f"this report is in {report_path(out)}")


def store_town(graph: LaneGraph, town: str, *, beside: Path) -> None:
    """Store the lanes of an imported scenario as a town, and in a file beside that of the scenario.

    Raises:
        ConfigError: A built-in town has this name.
    """
    from ssad.core.lane_graph import save_graph
    from ssad.core.safeio import home_folder
    from ssad.world.roads import import_map, town_names

    if town_names().get(town) == "built-in":
        raise ConfigError(f"'{town}' is a built-in town; choose another name for {beside}")
    path = beside.with_suffix(".npz")
    save_graph(graph, path)
    import_map(path, town, home_folder())


def print_counted(heading: str, lines: Sequence[str]) -> None:
    """Print lines under a heading, each once, with how often it came."""
    line_counts = {line: lines.count(line) for line in lines}
    for line, count in line_counts.items():
        print(f"{heading}: {line}{f' ({count} scenarios)' if count > 1 else ''}")
