"""Runs on disk with the methods of their kind: the plan, a cell run again, the report, the terminal's table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from ssad.core import safeio
from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.core.folders import check_tree
from ssad.engine.kind import Kind, Plan, Replay
from ssad.engine.replay import replay_cell
from ssad.engine.run import run_json
from ssad.engine.store import read_run
from ssad.experiments.suites import kind_of
from ssad.report.join import join_runs
from ssad.report.load import Run, load_run, read_as_kind
from ssad.report.markdown import run_markdown
from ssad.report.matrix import run_matrices, sweep_tables, terminal_matrices
from ssad.report.pages import TABLE_HASH, table_hash
from ssad.report.tables import write_tables
from ssad.report.terminal import TerminalTable, terminal_table
from ssad.report.verdict import complete_verdict


def read_plan(folder: str | Path) -> Plan:
    """Return the plan of a folder that holds a run.

    Raises:
        ConfigError: Code or inputs have changed since.
        StoreError: The folder holds no run, or something in it leads out of it.
    """
    header = read_run(folder)
    check_tree(folder)
    try:
        kind = kind_of(str(header["suite"]["kind"]))
        suite, device = kind.suite.model_validate(header["suite"]), str(header["versions"]["device"])
    except (KeyError, TypeError, ValidationError) as error:
        problem = f"no key {error}" if isinstance(error, KeyError) else "its suite is of another version of SSAD"
        raise StoreError(f"{folder}/run.json: not what ssad run writes: {problem}; run the suite again") from None
    plan = kind.plan(suite, device=device, check=False)
    current_header = run_json(plan)
    if current_header["identity"] != header["identity"]:
        problem = (
            ", ".join(name for name in ("code", *plan.inputs) if current_header[name] != header.get(name))
            or "scenarios"
        )
        raise ConfigError(f"{folder}: {problem} changed since this run was made; run the suite again to compare")
    return plan


def replay(folder: str | Path, name: str) -> Replay:
    """Run one cell of a results folder again, alone, and compare it with its record.

    Args:
        folder: Results folder.
        name: Key of the cell, the unique start of one, or its name, such as "blind/StraightObstacle/00".

    Raises:
        StoreError: It was not recorded.
        ConfigError: There is no such cell, its kind has no replay, or code or inputs have changed since.
    """
    return replay_cell(read_plan(folder), folder, name)


def kind_of_run(run: Run) -> Kind:
    """The kind of a run, which knows its page; a plain `Kind` where it is not installed.

    A results folder may come from anywhere, so a kind that it names as "module:Class" is not imported: its page is the
    plain one unless the caller has the kind at hand, as `ssad run` does.
    """
    name = str(run.suite.get("kind") or run.kind)
    if ":" in name:
        return Kind()
    try:
        return kind_of(name)
    except SSADError:
        return Kind()


def write_report(folder: Path | str, kind: Kind | None = None) -> Path:
    """Write DIR/report.html and DIR/tables/*.csv|md|tex from the records in DIR.

    Missing or altered artefacts are named on the page.

    Args:
        folder: Results folder.
        kind: Kind of the run, which makes the page; None: the one that the run names.

    Returns:
        Path of the page.

    Raises:
        StoreError: The folder holds no run, has no results, or cannot be written.
    """
    run = load_run(folder)
    with read_as_kind(run):
        page, tables = (kind or kind_of_run(run)).page(run)
        all_tables = [*tables, *sweep_tables(run)]
    write_tables(run.folder, all_tables)
    page = page.replace(TABLE_HASH, table_hash(tables[0]) if tables else "none")
    path = run.folder / "report.html"
    safeio.write_atomic(path, page)
    return path


def report_markdown(folders: Sequence[Path | str]) -> str:
    """Return all tables of a run, or of several runs of one suite that are joined, as a Markdown page.

    Args:
        folders: Results folders.

    Raises:
        StoreError: A folder holds no run, or has no results.
        ConfigError: The runs cannot be joined.
    """
    run = join_runs([load_run(folder) for folder in folders])
    kind = kind_of_run(run)
    with read_as_kind(run):
        _, tables = kind.page(run)
        return run_markdown(run, [*tables, *run_matrices(run)], complete_verdict(run, kind.verdict(run)))


def summary(folder: Path | str, kind: Kind | None = None) -> TerminalTable:
    """Main table of a run for the terminal: n and interval of the first metric, the values of the others.

    Args:
        folder: Results folder.
        kind: Kind of the run; None: the one that the run names.

    Raises:
        StoreError: The folder holds no run with results.
    """
    run = load_run(folder)
    with read_as_kind(run):
        return terminal_table(run, (kind or kind_of_run(run)).summary(run))


def matrices(folder: Path | str) -> list[TerminalTable]:
    """Return the matrices of a run with a sweep for the terminal; empty: it has no sweep.

    Raises:
        StoreError: The folder holds no run with results.
    """
    run = load_run(folder)
    with read_as_kind(run):
        return terminal_matrices(run)
