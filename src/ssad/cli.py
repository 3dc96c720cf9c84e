"""The command line: one short function per command. Heavy imports are inside them, so that --help is quick."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ssad.core.errors import ConfigError, SSADError, unknown_name
from ssad.core.version import __version__
from ssad.interchange.commands import ExportGroup, register
from ssad.listing import ALIASES, LISTS
from ssad.training.commands import train_app

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
imports = typer.Typer(
    help="Import maps, routes and scenarios of other programs, and logged drives.", no_args_is_help=True
)
app.add_typer(imports, name="import")
exports = typer.Typer(
    help="Export scenarios, or what a run has made, for other programs.", no_args_is_help=True, cls=ExportGroup
)
app.add_typer(exports, name="export")
register(exports, imports)

Dir = Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of `ssad run`.")]
Device = Annotated[str, typer.Option(help="Where to compute: auto, cpu or cuda.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Number of worker processes.  [default: one per core]")]
Ray = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Run on the Ray cluster at ADDRESS; 'local' starts one here.")
]


def show_version(asked: bool) -> None:
    """Print the version and stop, if it is asked for."""
    if asked:
        print(f"ssad {__version__}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=show_version)
    ] = False,
) -> None:
    """SSAD: how safe and robust is an autonomous-driving system in safety-critical scenarios?"""


class Video(StrEnum):
    """Video formats that `ssad replay` can write."""

    mp4 = "mp4"
    gif = "gif"


@app.command()
def run(
    suite: Annotated[
        str, typer.Argument(metavar="SUITE", help="Name of a suite (see: ssad list suites) or YAML file.")
    ],
    out: Annotated[Path | None, typer.Option(help="Results folder.  [default: runs/SUITE]")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the suite; can be repeated."),
    ] = None,
    device: Device = "auto",
    workers: Workers = None,
    ray: Ray = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run failed cells again.")] = False,
) -> None:
    """Run a suite and write its report. To resume a stopped run, repeat the command.

    Exit code 0: every cell ran. 1: some cells failed; the results give the reasons. 2: invalid input.
    """
    from rich.console import Console

    from ssad.bench.kind import Resources
    from ssad.bench.run import run as run_plan
    from ssad.bench.suite import kind_of, load_suite
    from ssad.jobs.machine import pick_device
    from ssad.report.terminal import summary

    chosen = load_suite(suite, settings or [])
    folder = out or Path("runs") / chosen.name
    where = pick_device(device)
    kind = kind_of(chosen.kind)
    plan = kind.plan(chosen, device=where)
    names = {cell.key: cell.name for cell in plan.cells}
    try:
        records = run_plan(plan, folder, Resources(workers, ray, where), retry=retry)
        kind.finish(plan, folder)
    except KeyboardInterrupt:
        print(f"stopped; finished cells are kept in {folder}; repeat the command to resume", file=sys.stderr)
        raise typer.Exit(130) from None
    console = Console()
    console.print(summary(folder))
    failed = [r for r in records if r["status"] != "ok"]
    for record in failed[:5]:
        console.print(f"{record['status']}: {names[record['key']]}: {record['reason']}", markup=False, soft_wrap=True)
    if len(failed) > 5:
        console.print(f"... and {len(failed) - 5} more: see {folder / 'results.jsonl'}", markup=False)
    if failed:
        console.print("to run the failed cells again, repeat the command with --retry")
    report(folder)
    raise typer.Exit(1 if failed else 0)


@app.command()
def report(folder: Dir) -> None:
    """Write DIR/report.html and DIR/tables from the results in DIR. Exit code 1: files are missing or were changed."""
    from ssad.jobs.store import read_run
    from ssad.report import check_artefacts, write_report

    read_run(folder)
    print(f"report: {write_report(folder)}")
    problems = check_artefacts(folder)
    for problem in problems[:5]:
        print(problem)
    if problems:
        print(f"{len(problems)} files are not as the run left them; what is made of them is not to be trusted")
        raise typer.Exit(1)


@app.command()
def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR DIR...", help="Results folders of `ssad run`; all are compared with the first."),
    ],
    out: Annotated[Path | None, typer.Option(help="Output folder.  [default: that of the last DIR]")] = None,
) -> None:
    """Compare runs with the first one, cell by cell: differences with intervals and a test, and what changed."""
    from rich.console import Console

    from ssad.report.compare import write_comparison
    from ssad.report.terminal import comparison_table

    page, found = write_comparison(folders, out or folders[-1])
    console = Console()
    for each in found:
        console.print(comparison_table(each.table))
        told = f"{each.both} cells in both, {each.equal} of them equal to the last digit"
        console.print(told + f"; {len(each.verdicts)} with another outcome" if each.verdicts else told)
        if each.left_out:
            console.print(f"left out, since only one of them has it: {', '.join(each.left_out)}")
    print(f"comparison: {page}")


@app.command()
def replay(
    folder: Dir,
    cell: Annotated[str, typer.Argument(metavar="CELL", help="Key of a cell, the start of one, or SYSTEM/SCENARIO.")],
    out: Annotated[Path | None, typer.Option(help="Output folder.  [default: DIR/replays]")] = None,
    video: Annotated[Video, typer.Option(help="Video format.")] = Video.mp4,
    wear: Annotated[
        Path | None, typer.Option(metavar="ATTACK", help="Also film the drive with this texture or light on a car.")
    ] = None,
    wearer: Annotated[
        int | None, typer.Option(min=1, help="Number of the agent that is attacked.  [default: the car nearest ahead]")
    ] = None,
    detector: Annotated[str, typer.Option(help="Detector whose boxes the film shows, or none.")] = "yolov5n",
) -> None:
    """Run one cell again, compare it with its record bit by bit, and write a video and the trace, or a picture.

    Drives give a video and the trace; cells of shifts and digital attacks give a picture of one moment, clean and under
    the cell's condition. ATTACK is a folder of `ssad export texture` or `ssad export light`; a light shines at its own
    hour. The film shows what the ego's camera sees, clean and attacked. Cells of kind gap are also filmed as their
    driver saw them, beside the same drive without the perturbation.
    Exit code 1: the new run differs from the record.
    """
    from ssad.bench.replay import replay as run_again
    from ssad.core.images import save_picture
    from ssad.core.safeio import make_folder
    from ssad.core.traces import save_trace
    from ssad.report import write_video
    from ssad.report.video import save_frames

    film_of = _film(wear, wearer, detector)  # whatever is wrong with it ends before the drive
    found = run_again(folder, cell)
    target = make_folder(out or folder / "replays") / found.cell.key
    verdict = f"differs: {found.difference}" if found.difference else "identical"
    if found.trace is None or found.graph is None:
        print(f"{found.cell.key} {found.cell.name}: {found.compared}, {verdict}")
        if film_of is not None:
            raise ConfigError(f"--wear: cell {found.cell.key} ({found.cell.name}) is no drive")
        if found.picture is not None:
            save_picture(target.with_suffix(".jpg"), found.picture())
            print(f"picture: {target.with_suffix('.jpg')}")
        raise typer.Exit(1 if found.difference else 0)
    save_trace(target.with_suffix(".npz"), found.trace)
    film = write_video(found.trace, found.graph, target.with_suffix(f".{video.value}"))
    print(f"{found.cell.key} {found.cell.name}: {len(found.trace.accel) - 1} steps, {verdict}")
    print(f"video: {film}\ntrace: {target.with_suffix('.npz')}")
    if found.film is not None:
        frames, dt = found.film
        print(f"camera: {save_frames(frames, target.with_suffix(f'.camera.{video.value}'), dt=dt)}")
    if film_of is not None:
        print(f"film: {film_of(found.trace, found.graph, target.with_suffix(f'.worn.{video.value}'))}")
    raise typer.Exit(1 if found.difference else 0)


def _film(wear: Path | None, wearer: int | None, detector: str) -> Callable[[Any, Any, Path], Path] | None:
    """What films a drive with an attack on a car; None without one. SSADError: no such attack or detector."""
    if wear is None:
        if wearer is not None:
            raise ConfigError("--wearer says who is attacked: give --wear ATTACK as well")
        return None
    from ssad.detectors import make_detector
    from ssad.recording.attacked_film import attacked_frames, first_car
    from ssad.recording.light_export import load_worn
    from ssad.recording.lit_clips import at_hour
    from ssad.recording.loop_sensors import DAY
    from ssad.report.video import save_frames

    worn, judge = load_worn(wear), None if detector == "none" else make_detector(detector)
    worn.live(1)

    def film(trace: Any, graph: Any, path: Path) -> Path:
        agent = first_car(trace) if wearer is None else wearer
        if agent is None:
            raise ConfigError(f"{trace.key}: no car is ahead of the ego at any time; name the agent with --wearer")
        weather = at_hour(DAY, worn.hour)
        shown = attacked_frames(trace, graph, worn.live(agent), detector=judge, every=2, weather=weather)
        return save_frames(shown, path, dt=2 * trace.dt)

    return film


@exports.command("texture")
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
    from ssad.bench.texture_export import export_cell_texture

    for path in export_cell_texture(folder, cell, out, dots=dots):
        print(path)


@exports.command("light")
def export_light(
    folder: Dir,
    cell: Annotated[
        str, typer.Argument(metavar="CELL", help="Key of a cell of a physical run, the start of one, or its name.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for light.json, and a projector's picture.")],
) -> None:
    """Write the settings of a light attack, and what a projector shows."""
    from ssad.bench.texture_export import export_cell_light

    for path in export_cell_light(folder, cell, out):
        print(path)


@app.command()
def shift(
    source: Annotated[Path, typer.Argument(metavar="DATAROOT", help="nuScenes folder, or an image file.")],
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Folder for the shifted nuScenes roots, or FILE.png for a contact sheet."),
    ],
    shifts: Annotated[
        str, typer.Option(help="Comma-separated names (ssad list shifts), or all: the paper's 11.")
    ] = "all",
    severity: Annotated[str, typer.Option(help="Comma-separated severities from 1 to 5, or random.")] = "random",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    calibration: Annotated[
        str, typer.Option(help="physical: severities in units. paper: the published severities, image by image.")
    ] = "physical",
    labels: Annotated[
        str, typer.Option(help="Boxes in the annotation table: original, or transformed with the objects.")
    ] = "original",
    version: Annotated[
        str | None, typer.Option(help="Dataset version, such as v1.0-mini.  [default: the only one in DATAROOT]")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only the scenes of this split, such as mini_val.")] = None,
    scenes: Annotated[
        str, typer.Option(help="Only these scenes, comma-separated. A contact sheet shows one scene.")
    ] = "",
    sweeps: Annotated[bool, typer.Option(help="Also shift the frames between keyframes.")] = True,
    lidar: Annotated[bool, typer.Option(help="Also shift the LiDAR points.")] = True,
    quality: Annotated[int, typer.Option(min=1, max=100, help="JPEG quality.")] = 95,
    subsampling: Annotated[
        str, typer.Option(help="JPEG chroma subsampling: auto (444 for sensor noise, else 420), 444, 422 or 420.")
    ] = "auto",
    workers: Workers = None,
    ray: Ray = None,
    channel: Annotated[str, typer.Option(help="Camera that a contact sheet shows.")] = "CAM_FRONT",
    box: Annotated[
        list[str] | None,
        typer.Option(metavar="X0,Y0,X1,Y1", help="2D box of an object in the image file, pixels; can be repeated."),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Write nothing; compare every file in OUT with the manifests.")
    ] = False,
) -> None:
    """Apply distribution shifts to a nuScenes folder (nuScenes-N), or to one image as a contact sheet.

    To resume, repeat the command. Exit code 1: some files failed, or --verify found files that differ.
    """
    from ssad.toolbox.commands import shift_folder, verify_folder, write_contact_sheets

    if verify:
        raise typer.Exit(verify_folder(out))
    names = [name.strip() for name in shifts.split(",") if name.strip()]
    listed = [name.strip() for name in scenes.split(",") if name.strip()]
    if source.is_file() or out.suffix.lower() in (".png", ".jpg", ".jpeg"):
        write_contact_sheets(
            source,
            out,
            version=version,
            channel=channel,
            split=split,
            scenes=listed,
            boxes=box or [],
            severity=severity,
            seed=seed,
            calibration=calibration,
        )
        return
    code = shift_folder(
        source,
        out,
        shifts=names,
        severity=severity,
        version=version,
        split=split,
        scenes=listed,
        workers=workers,
        ray=ray,
        settings={
            "seed": seed, "calibration": calibration, "labels": labels, "sweeps": sweeps, "lidar": lidar,
            "quality": quality, "subsampling": subsampling,
        },
    )  # fmt: skip
    raise typer.Exit(code)


@app.command()
def score(
    results: Annotated[Path, typer.Argument(metavar="RESULTS.json", help="Detections in the nuScenes results format.")],
    dataroot: Annotated[Path, typer.Option(help="nuScenes or nuScenes-N folder.")],
    version: Annotated[str, typer.Option(help="Dataset version, such as v1.0-trainval.")],
    split: Annotated[str, typer.Option(help="val, mini_val, or a split that the folder's splits.json defines.")],
    file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers to this file.")
    ] = None,
    intervals: Annotated[int, typer.Option(min=0, help="Bootstrap replicates for 95 % intervals; 0: none.")] = 0,
) -> None:
    """Compute mAP, NDS and the true-positive errors of the official nuScenes evaluation.

    A shifted folder is first checked against its manifest, so that clean data cannot be scored as shifted.
    """
    from rich.console import Console

    from ssad.evaluation.score import score_results, tables, write_summary
    from ssad.toolbox.commands import checked

    found = score_results(
        results, dataroot=dataroot, version=version, split=split, replicates=intervals, check=checked(dataroot)
    )
    if file is not None:
        write_summary(file, found)
    console = Console()
    for table in tables(found):
        console.print(table)


@app.command()
def record(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the dataset.")],
    towns: Annotated[
        str, typer.Option(help="Comma-separated towns (see: ssad list towns).")
    ] = "Twinford,Crossgate,Oldmarket,Larkhill",
    held_out: Annotated[str, typer.Option(help="Towns of the split val; all others are train.")] = "Oldmarket,Larkhill",
    scenes: Annotated[int, typer.Option(min=1, help="Scenes per town.")] = 2,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of a scene, s.")] = 20.0,
    width: Annotated[int, typer.Option(min=64, help="Image width in pixels (16:9).")] = 1600,
    sweeps: Annotated[int, typer.Option(min=0, max=4, help="Frames between two keyframes.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    clips: Annotated[
        str | None,
        typer.Option(help="Record images of one target car with COCO annotations instead: drive or orbit."),
    ] = None,
    streets: Annotated[
        str, typer.Option(help="town: the town's own buildings. any: new ones for each drive, for training data.")
    ] = "town",
    images: Annotated[
        str, typer.Option(help="With --clips: images per town, one number for each town or one for all.")
    ] = "600,400,400,400",
    target: Annotated[
        str | None,
        typer.Option(
            help="With --clips: the target car, STYLE[:PAINT[:SEED]]; with orbit also stop_sign[:STYLE[:SEED]].  "
            "[default: another car in each part]"
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="Where to render: auto, cpu or cuda.")] = "cpu",
    workers: Workers = None,
    ray: Ray = None,
) -> None:
    """Record drives with the nuScenes sensors as a dataset in the nuScenes schema. To resume, repeat the command."""
    from rich.console import Console
    from rich.progress import Progress

    from ssad.jobs.machine import pick_device
    from ssad.recording.nuscenes_recorder import Recording, record_nuscenes

    def names(text: str) -> tuple[str, ...]:
        return tuple(name.strip() for name in text.split(",") if name.strip())

    idle = ("scenes", "seconds", "width", "sweeps") if clips is not None else ("images", "target")
    for name in idle:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise ConfigError(f"--{name} {'cannot be used' if clips is not None else 'can only be used'} with --clips")
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("record", total=None)

        def progress(done: int, of: int) -> None:
            bar.update(task, completed=done, total=of)

        if clips is not None:
            from ssad.recording.clip_recorder import record_clips
            from ssad.recording.clips import Clips, pair_images
            from ssad.recording.target import parse_target

            pairs = pair_images(names(towns), names(images))
            todo = Clips(
                out, pairs, names(held_out), clips, target=parse_target(target) if target else None, seed=seed,  # type: ignore[arg-type]
                device=pick_device(device), streets=streets,
            )  # fmt: skip
            record_clips(todo, workers=workers, ray=ray, progress=progress)
            text = f"{out}: {sum(count for _, count in pairs)} images, annotations train.json, test.json and all.json"
        else:
            drives = Recording(
                out, names(towns), names(held_out), scenes=scenes, seconds=seconds, width=width, sweeps=sweeps,
                seed=seed, device=pick_device(device), streets=streets,
            )  # fmt: skip
            record_nuscenes(drives, workers=workers, ray=ray, progress=progress)
            text = f"{out}: {len(drives.towns) * scenes} scenes, version {drives.version}, splits train and val"
    print(text)


app.add_typer(train_app, name="train")


@app.command("list")
def list_names(
    what: Annotated[str | None, typer.Argument(metavar="[WHAT]", help=f"One of: {', '.join(LISTS)}.")] = None,
) -> None:
    """List the names that other commands and suites accept. Without WHAT: all lists, scenarios by set and class."""
    chosen = ALIASES.get(what or "", what)
    if chosen is not None and chosen not in LISTS:
        raise unknown_name("list", str(what), [*LISTS, *ALIASES])
    for name, rows in LISTS.items():
        if chosen not in (None, name):
            continue
        found = rows()
        if chosen is None:
            print(f"{name}:")
            if name == "scenarios":  # hundreds of single ones: only when asked for
                found = {key: text for key, text in found.items() if text.startswith(("set", "class"))}
        width = max((len(key) for key in found), default=0)
        for key, text in found.items():
            print(f"{'  ' if chosen is None else ''}{key:<{width}}  {text}".rstrip())


@imports.command("map")
def import_map(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.xodr", help="OpenDRIVE file, or a town as SSAD stores it (.npz).")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the town.  [default: name of the file]")] = None,
) -> None:
    """Import an OpenDRIVE map as a town. Needs the extra `carla` (Python 3.11 or 3.12)."""
    from ssad.core.safeio import home
    from ssad.roads import import_map as bake
    from ssad.roads import load_town, town_names

    label = name or file.stem
    if town_names().get(label) == "built-in":
        raise ConfigError(f"'{label}' is a built-in town; choose another name with --name")
    path = bake(file, label, home())
    print(f"town {label}: {len(load_town(label).kind)} lanes, written to {path}")


@imports.command("routes")
def import_routes(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of SafeBench, FREA or leaderboard routes.")],
    name: Annotated[str | None, typer.Option(help="Name of the set.  [default: name of the folder]")] = None,
) -> None:
    """Import a folder of routes as a set of scenarios, for the key `scenarios` of a suite."""
    from ssad.core.safeio import home
    from ssad.scenarios.dynamic import import_routes as read
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.sets import BUILT_IN_SETS

    label = name or folder.resolve().name
    if not label.replace("-", "").replace("_", "").isalnum():
        raise ConfigError(f"'{label}' cannot name a set; choose a name of letters, digits, _ and - with --name")
    if label in BUILT_IN_SETS:
        raise ConfigError(f"'{label}' is a built-in set; choose another name with --name")
    scenarios = read(folder)
    path = home() / "scenarios" / f"{label}.yaml"
    save_scenarios(path, scenarios)
    towns = ", ".join(sorted({s.town for s in scenarios}))
    print(f"set {label}: {len(scenarios)} scenarios on {towns}, written to {path}")


@imports.command("drive")
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
    from ssad.roads import import_map as store
    from ssad.roads import town_names
    from ssad.scenarios.dynamic import save_scenarios

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


@app.command()
def doctor() -> None:
    """Check this machine: what works, what is missing. Exit code 1: something that every run needs is broken."""
    from ssad.doctor import examine

    broken = False
    for finding in examine():
        broken |= finding.state == "broken"
        print(f"{finding.state:<8} {finding.what:<12} {finding.detail}")
    raise typer.Exit(1 if broken else 0)


def main() -> None:
    """Entry point: an error that the user can fix becomes one line and exit code 2."""
    # click's UsageError, which typer does not export
    usage_error: Any = typer.BadParameter.__mro__[1]
    try:
        code = app(standalone_mode=False)
    except SSADError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        sys.exit(130)
    except usage_error as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # its message is the help
            print(error.format_message())
            sys.exit(2)
        command = error.ctx.command_path if error.ctx is not None else "ssad"
        print(f"error: {error.format_message()} (see: {command} --help)", file=sys.stderr)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)
