"""`ssad run`, and the commands that read a run: report, compare, replay."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ssad.cli import paths
from ssad.cli.options import Device, Dir, Ray, Workers
from ssad.core.errors import ConfigError
from ssad.core.wording import counted


class Video(StrEnum):
    """Video formats that `ssad replay` can write."""

    mp4 = "mp4"
    gif = "gif"


def run(
    suite: Annotated[
        str, typer.Argument(metavar="SUITE", help="Name of a suite (see: ssad list suites) or YAML file.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Results folder: new, empty, or that of the same run.  [default: runs/SUITE]")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the suite; can be repeated."),
    ] = None,
    device: Device = "auto",
    workers: Workers = None,
    ray: Ray = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run failed cells again.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="FIELD=VALUE,...",
            help="Run a slice: cells with these values, such as perturbation=none,fog or name=NAME; slices add up.",
        ),
    ] = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the resolved suite as YAML, and run nothing.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check all input, say what would run and how long it takes; run nothing.")
    ] = False,
    sample: Annotated[
        int, typer.Option(min=0, help="With --dry-run: run so many cells of each system to measure time and disk.")
    ] = 0,
) -> None:
    """Run a suite and write its report. To resume a stopped run, repeat the command.

    Exit code 0: every cell ran. 1: some cells failed; the results give the reasons. 2: invalid input.
    """
    if not (print_config or dry_run):
        paths.check_out(out or Path("runs") / Path(suite).stem, paths.RUN)
    paths.check_named_files(suite, settings or [])
    from rich.console import Console

    from ssad.engine.kind import Resources
    from ssad.experiments.runs import matrices, summary
    from ssad.results import make_plan, run_plan

    if sample and not dry_run:
        raise ConfigError("--sample can only be used with --dry-run")
    if print_config:
        from ssad.core.safeio import dump_yaml
        from ssad.experiments.suites import load_suite

        print(dump_yaml(load_suite(suite, settings or []).model_dump(mode="json")), end="")
        return
    plan = make_plan(suite, settings or [], device=device)
    folder = out or Path("runs") / plan.suite.name
    if dry_run:
        from ssad.cli.forecast import forecast
        from ssad.engine.run import select_cells

        sliced_plan = replace(plan, cells=tuple(select_cells(plan, _selections(only or []))))
        for line in forecast(sliced_plan, folder, Resources(workers, ray, plan.device), sample=sample):
            print(line)
        return
    try:
        results = run_plan(
            plan, folder, Resources(workers, ray, plan.device), retry=retry, only=_selections(only or [])
        )
    except KeyboardInterrupt:
        print(f"stopped; finished cells are kept in {folder}; repeat the command to resume", file=sys.stderr)
        raise typer.Exit(130) from None
    console = Console()
    console.print(summary(folder))
    for matrix in matrices(folder):
        console.print(matrix)
    failures = results.failures
    for row in failures[:5]:
        name = results.names[row["key"]]
        console.print(f"{row['status']}: {name}: {row['reason']}", markup=False, soft_wrap=True)
    if len(failures) > 5:
        console.print(f"... and {len(failures) - 5} more: see {folder / 'results.jsonl'}", markup=False)
    if failures:
        console.print("to run the failed cells again, repeat the command with --retry")
    report([folder])
    raise typer.Exit(1 if failures else 0)


def _selections(texts: list[str]) -> dict[str, list[str]]:
    """Return the values by field, of texts "field=value,value"."""
    selections: dict[str, list[str]] = {}
    for text in texts:
        name, separator, values = text.partition("=")
        if not name or not separator or not values:
            raise ConfigError(f"--only {text}: expected FIELD=VALUE,..., such as perturbation=none,fog")
        selections.setdefault(name, []).append(values)
    return selections


def report(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Results folders of `ssad run`.")],
    markdown: Annotated[
        bool,
        typer.Option("--markdown", help="Print all tables as one Markdown page instead; several DIR are joined."),
    ] = False,
) -> None:
    """Write DIR/report.html and DIR/tables from the results in DIR. Exit code 1: files are missing or were changed.

    With --markdown no file is written: the page goes to standard output, with the commands, versions, weights and
    numbers of cases behind it. Runs of one suite are joined; a cell that failed in one of them may come from another.
    """
    from ssad.engine.store import read_run

    for folder in folders:
        read_run(folder)
    if markdown:
        from ssad.experiments.runs import report_markdown

        print(report_markdown(folders), end="")
        return
    problems = [problem for folder in folders for problem in _report(folder)]
    for problem in problems[:5]:
        print(problem)
    if problems:
        print(
            f"{counted(len(problems), 'file')} changed since the run ended; what is made of them is not to be trusted"
        )
        raise typer.Exit(1)


def _report(folder: Path) -> list[str]:
    """Write the report of a run, and return the problems of its files."""
    from ssad.experiments.runs import write_report
    from ssad.report import check_artefacts

    print(f"report: {write_report(folder)}")
    return check_artefacts(folder)


def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR DIR...", help="Results folders of `ssad run`; all are compared with the first."),
    ],
    pair: Annotated[
        list[str] | None,
        typer.Option(metavar="FIRST=SECOND", help="Compare these systems or detectors; may be repeated."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder.  [default: that of the last DIR]")] = None,
) -> None:
    """Compare runs with the first one, cell by cell: differences with intervals and a test, and what changed.

    One DIR is enough where --pair names two of its systems.
    """
    paths.check_exists(*folders)
    paths.check_out(out, paths.COMPARISON)
    from rich.console import Console

    from ssad.report.compare import write_comparison
    from ssad.report.terminal import comparison_table

    page, comparisons = write_comparison(folders, out or folders[-1], pair or [])
    console = Console()
    for comparison in comparisons:
        for remark in comparison.remarks:
            console.print(remark, markup=False, highlight=False)
        console.print(comparison_table(comparison.table))
        message = f"{comparison.both} cells in both, {comparison.equal} of them equal to the last digit"
        console.print(
            message + f"; {len(comparison.verdicts)} with another outcome" if comparison.verdicts else message
        )
        for sentence in comparison.findings:
            console.print(sentence, markup=False, highlight=False)
    print(f"comparison: {page}")


def replay(
    folder: Dir,
    cell: Annotated[str, typer.Argument(metavar="CELL", help="Key of a cell, the start of one, or SYSTEM/SCENARIO.")],
    out: Annotated[Path | None, typer.Option(help="Output folder.  [default: DIR/replays]")] = None,
    video: Annotated[Video, typer.Option(help="Video format.")] = Video.mp4,
    wear: Annotated[
        Path | None, typer.Option(metavar="ATTACK", help="Also film the drive with this texture or light in it.")
    ] = None,
    wearer: Annotated[
        int | None, typer.Option(min=1, help="Number of the agent that is attacked.  [default: the one longest ahead]")
    ] = None,
    detector: Annotated[str, typer.Option(help="Detector whose boxes the film shows, or none.")] = "yolov5n",
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Also write the drive as MCAP with Foxglove's schemas (extra view).")
    ] = False,
) -> None:
    """Run one cell again, compare it with its record bit by bit, and write a video and the trace, or a picture.

    Drives give a video and the trace; cells of shifts and digital attacks give a picture of one moment, clean and under
    the cell's condition. ATTACK is a folder of `ssad export texture` or `ssad export light`; a light shines at its own
    hour. The film shows what the ego's camera sees, clean and attacked. Cells of kind gap are also filmed as their
    driver saw them, beside the same drive without the perturbation.
    Exit code 1: the new run differs from the record.
    """
    from ssad.engine.store import read_run

    read_run(folder)
    paths.check_exists(wear)
    paths.check_out(out, paths.REPLAYS)
    from ssad.core.images import save_picture
    from ssad.core.safeio import make_folder
    from ssad.core.traces import save_trace
    from ssad.experiments.runs import replay as run_again
    from ssad.report import write_video
    from ssad.report.video import frames, save_frames

    write_film = _film(wear, wearer, detector)  # wrong options fail before the drive, which takes minutes
    if mcap:
        from ssad.experiments.gap.mcap import require_mcap, write_mcap

        require_mcap()
    replayed = run_again(folder, cell)
    stem = make_folder(out or folder / "replays") / replayed.cell.key
    verdict = f"differs: {replayed.difference}" if replayed.difference else "identical"
    if replayed.trace is None or replayed.graph is None:
        print(f"{replayed.cell.key} {replayed.cell.name}: {replayed.compared}, {verdict}")
        if mcap:
            raise ConfigError(f"--mcap: cell {replayed.cell.key} ({replayed.cell.name}) is no drive")
        if write_film is not None:
            raise ConfigError(f"--wear: cell {replayed.cell.key} ({replayed.cell.name}) is no drive")
        if replayed.picture is not None:
            save_picture(stem.with_suffix(".jpg"), replayed.picture())
            print(f"picture: {stem.with_suffix('.jpg')}")
        raise typer.Exit(1 if replayed.difference else 0)
    save_trace(stem.with_suffix(".npz"), replayed.trace)
    video_path = write_video(replayed.trace, replayed.graph, stem.with_suffix(f".{video.value}"))
    print(f"{replayed.cell.key} {replayed.cell.name}: {counted(len(replayed.trace.accel) - 1, 'step')}, {verdict}")
    print(f"video: {video_path}\ntrace: {stem.with_suffix('.npz')}")
    if replayed.film is not None:
        camera_frames, dt = replayed.film
        print(f"camera: {save_frames(camera_frames, stem.with_suffix(f'.camera.{video.value}'), dt=dt)}")
    if mcap:
        top_view_frames = frames(replayed.trace, replayed.graph, size=(640, 360))
        path = write_mcap(
            stem.with_suffix(".mcap"),
            replayed.trace,
            replayed.graph,
            recorded_drive=replayed.perception,
            top_views=top_view_frames,
        )
        print(f"mcap: {path}")
    if write_film is not None:
        print(f"film: {write_film(replayed.trace, replayed.graph, stem.with_suffix(f'.worn.{video.value}'))}")
    raise typer.Exit(1 if replayed.difference else 0)


def _film(wear: Path | None, wearer: int | None, detector: str) -> Callable[[Any, Any, Path], Path] | None:
    """Return a function that films a drive with an attack in it; None without an attack.

    Raises:
        SSADError: There is no such attack or detector.
    """
    if wear is None:
        if wearer is not None:
            raise ConfigError("--wearer says who is attacked: give --wear ATTACK as well")
        return None
    from ssad.detectors import make_detector
    from ssad.experiments.driving.attacked_film import agent_ahead, attacked_frames
    from ssad.rendering.hours import at_hour
    from ssad.rendering.onboard import DAY
    from ssad.report.video import save_frames
    from ssad.scenarios.static.physical.lights.export import load_exported_attack

    attack, film_detector = load_exported_attack(wear), None if detector == "none" else make_detector(detector)
    target_kind = attack.live(1).kind

    def film(trace: Any, graph: Any, path: Path) -> Path:
        agent = agent_ahead(trace, target_kind) if wearer is None else wearer
        if agent is None:
            kind_name = target_kind.name.lower()
            raise ConfigError(
                f"{trace.key}: no {kind_name} is ahead of the ego at any time; name the agent with --wearer"
            )
        weather = at_hour(DAY, attack.hour)
        film_frames = attacked_frames(
            trace, graph, attack.live(agent), detector=film_detector, frame_stride=2, weather=weather
        )
        return save_frames(film_frames, path, dt=2 * trace.dt)

    return film
