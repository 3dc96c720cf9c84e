"""The command line: one thin function a verb. Heavy imports are inside, so that --help is quick."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ssad.core.errors import ConfigError, SSADError, unknown_name

app = typer.Typer(
    help="SSAD: how safe and robust is an autonomous-driving system in safety-critical scenarios?",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
imports = typer.Typer(help="Bring in OpenDRIVE maps and SafeBench / FREA / leaderboard routes.", no_args_is_help=True)
app.add_typer(imports, name="import")

Dir = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `ssad run` wrote.")]


class Video(StrEnum):
    """Kinds of video that `ssad replay` writes."""

    mp4 = "mp4"
    gif = "gif"


@app.command()
def run(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="Name (see: ssad list suites) or YAML file.")],
    out: Annotated[Path | None, typer.Option(help="Results folder.  [default: runs/SUITE]")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a key of the suite.")
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.  [default: one a core]")] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Work on a Ray cluster (local: start one).")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run again what failed.")] = False,
) -> None:
    """Run a suite and write its report; run again to resume.

    Exit code 0: all of it ran; 1: some failed (they are in the results with the reason); 2: wrong input.
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
        print(f"stopped; what is done is kept in {folder}: the same command goes on from there", file=sys.stderr)
        raise typer.Exit(130) from None
    console = Console()
    console.print(summary(folder))
    failed = [r for r in records if r["status"] != "ok"]
    for record in failed[:5]:
        console.print(f"{record['status']}: {names[record['key']]}: {record['reason']}", markup=False, soft_wrap=True)
    if len(failed) > 5:
        console.print(f"... and {len(failed) - 5} more: see {folder / 'results.jsonl'}", markup=False)
    if failed:
        console.print("what failed is kept as it is; to try it again: the same command with --retry")
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
def replay(
    folder: Dir,
    cell: Annotated[str, typer.Argument(metavar="CELL", help="Key, start of a key, or system/scenario.")],
    out: Annotated[Path | None, typer.Option(help="Where to write.  [default: DIR/replays]")] = None,
    video: Annotated[Video, typer.Option(help="Kind of video.")] = Video.mp4,
) -> None:
    """Run one cell again, compare it bit for bit with the record, and write its video and recording.

    Exit code 1 when the two differ.
    """
    from ssad.bench.replay import replay as run_again
    from ssad.core.safeio import make_folder
    from ssad.core.traces import save_trace
    from ssad.report import write_video

    found = run_again(folder, cell)
    target = make_folder(out or folder / "replays") / found.cell.key
    save_trace(target.with_suffix(".npz"), found.trace)
    film = write_video(found.trace, found.graph, target.with_suffix(f".{video.value}"))
    verdict = f"differs: {found.difference}" if found.difference else "identical"
    print(f"{found.cell.key} {found.cell.name}: {len(found.trace.accel) - 1} steps, {verdict}")
    print(f"video: {film}\nrecording: {target.with_suffix('.npz')}")
    raise typer.Exit(1 if found.difference else 0)


@app.command()
def shift(
    source: Annotated[Path, typer.Argument(metavar="DATAROOT", help="nuScenes folder, or a picture of your own.")],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="Folder for one nuScenes root a shift and severity; FILE.png: a contact sheet."
        ),
    ],
    shifts: Annotated[
        str, typer.Option(help="Names with commas between them (see: ssad list shifts), or all.")
    ] = "all",
    severity: Annotated[str, typer.Option(help="1 to 5, with commas between them, or random.")] = "random",
    seed: Annotated[int, typer.Option(min=0, help="Root of all random numbers.")] = 0,
    calibration: Annotated[
        str, typer.Option(help="physical, or paper: the published figures, image by image.")
    ] = "physical",
    labels: Annotated[
        str, typer.Option(help="Boxes in the tables: original, or transformed with the objects.")
    ] = "original",
    version: Annotated[str | None, typer.Option(help="Such as v1.0-mini.  [default: the only one]")] = None,
    split: Annotated[str | None, typer.Option(help="Only the scenes of a split, such as mini_val.")] = None,
    scenes: Annotated[
        str, typer.Option(help="Only these scenes, with commas between them; a contact sheet is of one.")
    ] = "",
    sweeps: Annotated[bool, typer.Option(help="Shift the files between key frames too.")] = True,
    lidar: Annotated[bool, typer.Option(help="Shift the LiDAR too.")] = True,
    quality: Annotated[int, typer.Option(min=1, max=100, help="Of JPEG files.")] = 95,
    subsampling: Annotated[str, typer.Option(help="auto (444 for sensor noise, else 420), 444, 422 or 420.")] = "auto",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.  [default: one a core]")] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Work on a Ray cluster (local: start one).")
    ] = None,
    channel: Annotated[str, typer.Option(help="Camera of a contact sheet.")] = "CAM_FRONT",
    box: Annotated[list[str] | None, typer.Option(metavar="X0,Y0,X1,Y1", help="An object in your picture.")] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Only compare OUT with its manifests, file by file.")
    ] = False,
) -> None:
    """Distribution shifts: a nuScenes folder into nuScenes-N, or a contact sheet of one picture.

    Run the same command again to go on after a stop. Exit code 1: some files failed, or are not as the manifest says.
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
    results: Annotated[Path, typer.Argument(metavar="RESULTS.json", help="Detections in the official format.")],
    dataroot: Annotated[Path, typer.Option(help="nuScenes or nuScenes-N folder.")],
    version: Annotated[str, typer.Option(help="Such as v1.0-trainval.")],
    split: Annotated[str, typer.Option(help="Such as val, mini_val, or one of the folder's splits.json.")],
    file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers there.")] = None,
    intervals: Annotated[int, typer.Option(min=0, help="Bootstrap replicates over scenes for 95 % intervals.")] = 0,
) -> None:
    """mAP, NDS and the TP errors, as the official nuScenes evaluation gives them.

    A shifted folder is checked against its manifest first, so that clean data are not scored as shifted.
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
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Root of the data set.")],
    towns: Annotated[
        str, typer.Option(help="Towns with commas between them.")
    ] = "Twinford,Crossgate,Oldmarket,Larkhill",
    held_out: Annotated[str, typer.Option(help="Towns of the split val; the others are train.")] = "Oldmarket,Larkhill",
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each town.")] = 2,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of a scene.")] = 20.0,
    width: Annotated[int, typer.Option(min=64, help="Width of the pictures (16:9).")] = 1600,
    sweeps: Annotated[int, typer.Option(min=0, max=4, help="Frames between key frames.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Root of all random numbers.")] = 0,
    clips: Annotated[
        str | None, typer.Option(help="Instead of it pictures of one car for 2D detection, COCO: drive or orbit.")
    ] = None,
    streets: Annotated[
        str, typer.Option(help="town: what always stands there; any: built anew for each drive, for training.")
    ] = "town",
    images: Annotated[str, typer.Option(help="With --clips: pictures of each of the towns.")] = "600,400,400,400",
    style: Annotated[str | None, typer.Option(help="With --clips: body of the target car (default: any).")] = None,
    device: Annotated[str, typer.Option(help="Where pictures are rendered: cpu or cuda.")] = "cpu",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.  [default: one a core]")] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Work on a Ray cluster (local: start one).")
    ] = None,
) -> None:
    """Drives in the world, seen by the nuScenes rig: a data set in the nuScenes schema. Run again to go on."""
    from rich.console import Console
    from rich.progress import Progress

    from ssad.jobs.machine import pick_device
    from ssad.recording.nuscenes_recorder import Recording, record_nuscenes

    def names(text: str) -> tuple[str, ...]:
        return tuple(name.strip() for name in text.split(",") if name.strip())

    idle = ("scenes", "seconds", "width", "sweeps") if clips is not None else ("images", "style")
    for name in idle:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise ConfigError(f"--{name} {'does not go' if clips is not None else 'goes only'} with --clips")
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("record", total=None)

        def progress(done: int, of: int) -> None:
            bar.update(task, completed=done, total=of)

        if clips is not None:
            from ssad.recording.clip_recorder import Clips, pair_images, record_clips

            pairs = pair_images(names(towns), names(images))
            todo = Clips(
                out, pairs, names(held_out), clips, style=style, seed=seed, device=pick_device(device), streets=streets,  # type: ignore[arg-type]
            )  # fmt: skip
            record_clips(todo, workers=workers, ray=ray, progress=progress)
            text = f"{out}: {sum(count for _, count in pairs)} pictures, annotations train, test and all"
        else:
            drives = Recording(
                out, names(towns), names(held_out), scenes=scenes, seconds=seconds, width=width, sweeps=sweeps,
                seed=seed, device=pick_device(device), streets=streets,
            )  # fmt: skip
            record_nuscenes(drives, workers=workers, ray=ray, progress=progress)
            text = f"{out}: {len(drives.towns) * scenes} scenes, version {drives.version}, splits train and val"
    print(text)


train_app = typer.Typer(no_args_is_help=True, help="Train a detector (more to come).")
app.add_typer(train_app, name="train")


@train_app.command("detector")
def train_detector(
    recipe: Annotated[str, typer.Argument(metavar="RECIPE", help="Name of a recipe (see: ssad list recipes).")],
    data: Annotated[
        Path,
        typer.Option(help="Root of a data set in the nuScenes schema (3D), or a folder of `ssad record --clips` (2D)."),
    ],
    more: Annotated[list[Path] | None, typer.Option(help="2D: more folders of clips.")] = None,
    val_data: Annotated[
        Path | None, typer.Option(help="3D: another data set to validate on (default: that of --data).")
    ] = None,
    out: Annotated[Path, typer.Option(help="Checkpoint, log, curves, weights; run again to go on.")] = Path("training"),
    split: Annotated[str, typer.Option(help="Split to learn from.")] = "train",
    val: Annotated[str, typer.Option(help="Split to validate on.")] = "val",
    change: Annotated[
        list[str] | None, typer.Option("--set", help="A value of the recipe: --set epochs=3 --set lr=0.001.")
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="Start from these weights.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    gpus: Annotated[int, typer.Option(min=1, help="GPUs to share the work, one process each.")] = 1,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after the epoch in which this time is over.")
    ] = None,
) -> None:
    """Train a detector; validates on towns that it does not learn from."""
    from ssad.training.detector import Plan, parse_changes, run_training

    plan = Plan(
        recipe, (data, *(more or [])), out, split, val, parse_changes(change or []), weights=weights, device=device,
        gpus=gpus, seconds=seconds, val_data=val_data,
    )  # fmt: skip
    for line in run_training(plan, say=lambda text: print(text, flush=True)):
        print(line)


def _scenario_list() -> dict[str, str]:
    from ssad.scenarios.dynamic import SCENARIOS, load_scenarios, set_names

    sets = {name: load_scenarios(name) for name in set_names()}
    rows = {name: f"set of {len(found)}" for name, found in sets.items()}
    rows |= {name: f"class, {sum(s.type == name for s in sets['precrash'])} pre-crash" for name in SCENARIOS}
    return rows | {s.name: f"{s.type} in {s.town}" for found in sets.values() for s in found}


def _system_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.drivers import SYSTEMS

    return names("system", SYSTEMS) | {"module:object": "a driving system of your own, see README"}


def _town_list() -> dict[str, str]:
    from ssad.roads import town_names

    return town_names()


def _suite_list() -> dict[str, str]:
    from ssad.bench.suite import load_suite, suite_files

    return {name: load_suite(name).title for name in suite_files()}


def _shift_list() -> dict[str, str]:
    from ssad.scenarios.static.shifts.spec import SHIFTS

    return {name: f"{family}: {text}" for name, (family, text) in SHIFTS.items()}


def _detector_list() -> dict[str, str]:
    from ssad.detectors import SHIPPED, detector_names

    def about(name: str, where: str) -> str:
        if where.startswith("ssad."):
            kind = "3D" if "fcos3d" in name or "pgd" in name else "2D"
            return f"{kind}, weights shipped" if (SHIPPED / f"{name}.json").is_file() else f"{kind}, no weights shipped"
        return where

    rows = {name: about(name, where) for name, where in detector_names().items()}
    return rows | {"module:object": "a detector of your own, see docs/detectors.md"}


def _recipe_list() -> dict[str, str]:
    from ssad.training.recipe import RECIPES

    return {
        name: f"{r.detector}: {r.epochs} epochs, batch {r.batch}, {r.optimizer}, lr {r.lr:g}"
        for name, r in RECIPES.items()
    }


KINDS = {
    "suites": _suite_list,
    "scenarios": _scenario_list,
    "systems": _system_list,
    "detectors": _detector_list,
    "recipes": _recipe_list,
    "shifts": _shift_list,
    "towns": _town_list,
}
ALIASES = {"agents": "systems"}


@app.command("list")
def list_names(
    kind: Annotated[
        str | None, typer.Argument(metavar="[KIND]", help="suites, scenarios, systems, detectors, recipes, ...")
    ] = None,
) -> None:
    """List what can be named: suites, scenarios, systems (agents), detectors, recipes, shifts, towns."""
    chosen = ALIASES.get(kind or "", kind)
    if chosen is not None and chosen not in KINDS:
        raise unknown_name("kind", str(kind), [*KINDS, *ALIASES])
    for name, rows in KINDS.items():
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
    file: Annotated[Path, typer.Argument(metavar="FILE.xodr", help="OpenDRIVE map.")],
    name: Annotated[str | None, typer.Option(help="Name of the town.  [default: that of the file]")] = None,
) -> None:
    """Turn an OpenDRIVE map into a town (needs the extra `carla`)."""
    from ssad.core.safeio import home
    from ssad.roads import import_map as bake
    from ssad.roads import load_town, town_names

    label = name or file.stem
    if town_names().get(label) == "built-in":
        raise ConfigError(f"'{label}' is the name of a built-in town; choose another with --name")
    path = bake(file, label, home())
    print(f"town {label}: {len(load_town(label).kind)} lanes, written to {path}")


@imports.command("routes")
def import_routes(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="SafeBench, FREA or leaderboard routes.")],
    name: Annotated[str | None, typer.Option(help="Name of the set.  [default: that of the folder]")] = None,
) -> None:
    """Turn a folder of routes into a set of scenarios that suites can name."""
    from ssad.core.safeio import home
    from ssad.scenarios.dynamic import import_routes as read
    from ssad.scenarios.dynamic import save_scenarios

    label = name or folder.resolve().name
    if not label.replace("-", "").replace("_", "").isalnum():
        raise ConfigError(f"'{label}' cannot name a set of scenarios; use letters, digits, _ and - with --name")
    if label in ("precrash", "natural"):
        raise ConfigError(f"'{label}' is the name of a built-in set; choose another with --name")
    scenarios = read(folder)
    path = home() / "scenarios" / f"{label}.yaml"
    save_scenarios(path, scenarios)
    towns = ", ".join(sorted({s.town for s in scenarios}))
    print(f"set {label}: {len(scenarios)} scenarios on {towns}, written to {path}")


@app.command()
def doctor() -> None:
    """Say what works on this machine and what is missing. Exit code 1 when nothing can run."""
    from ssad.doctor import examine

    broken = False
    for finding in examine():
        broken |= finding.state == "broken"
        print(f"{finding.state:<8} {finding.what:<12} {finding.detail}")
    raise typer.Exit(1 if broken else 0)


def main() -> None:
    """Entry point: an error that the user can mend becomes one line and exit code 2."""
    # click's UsageError, which typer carries along under a name of its own
    usage_error: Any = typer.BadParameter.__mro__[1]
    try:
        code = app(standalone_mode=False)
    except SSADError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        sys.exit(130)
    except usage_error as error:
        command = error.ctx.command_path if error.ctx is not None else "ssad"
        print(f"error: {error.format_message()} (see: {command} --help)", file=sys.stderr)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
