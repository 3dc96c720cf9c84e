"""What a kind of experiment brings, and the plan of a run.

A kind says what its cells are (`plan`), how a worker executes some of them (`execute`), and which columns its records
have. Everything else is the engine's: processes, time-outs, resume, retry, progress, the store, tables.
"""

from __future__ import annotations

import difflib
from abc import ABC
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, PrivateAttr
from rich.console import Console

from ssad.core import safeio, schema
from ssad.core.errors import ConfigError, SSADError
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import label_of
from ssad.core.seeding import digest
from ssad.core.source import source_version
from ssad.core.types import U8, EpisodeTrace
from ssad.report import default
from ssad.report.load import Run
from ssad.report.tables import Table

Names = schema.Names


class SuiteBase(schema.Schema):
    """What suites of every kind say.

    Attributes:
        kind: the kind of experiment (`ssad list kinds`).
        name: of the suite, and of the results folder if none is given.
        title, description: what people read.
        seed: root of all random numbers.
        timeout_s: seconds that one cell may take.
        chunk: cells that run as one batch, where they can (results do not depend on it).
        reference: the published table that the report shows beside this one.
    """

    kind: str
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    description: str = ""
    seed: int = Field(default=0, ge=0)
    timeout_s: float = Field(default=3600.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=1, ge=1, le=4096)
    reference: str | None = None
    _origin: str = PrivateAttr(default="")  # the name or file that it was loaded from
    _stock: dict[str, Any] | None = PrivateAttr(default=None)  # the values of that file, before any `--set`

    def beside(self, path: Path) -> Self:
        """The suite with the files that it names found: in the working folder, else beside the suite's own file."""
        return self


@dataclass(frozen=True)
class Column:
    """A metric of a kind's records: its name in them, what it is, its unit, and which way is better ("": neither)."""

    name: str
    title: str = ""
    unit: str = ""
    better: Literal["higher", "lower", ""] = ""


@dataclass(frozen=True)
class Cell:
    """One row of the results: the smallest thing that is run, kept, retried and counted.

    Attributes:
        key: hash of all that the result depends on; made by `make_cell`.
        name: what people call it, such as "blind/StraightObstacle/00".
        system: what is put to the test; cells of one system may run as one batch.
        seed: its random numbers.
        fields: columns of its record that tell it from other cells.
        spec: plain data, all that a worker needs.
    """

    key: str
    name: str
    system: str
    seed: int
    fields: Mapping[str, Any]
    spec: Mapping[str, Any]


@dataclass(frozen=True)
class Plan:
    """Everything that a run will do, known and checked before anything is written.

    Attributes:
        kind: the kind.
        suite: the resolved suite.
        device: cpu or cuda.
        cells: in the order of the tables.
        inputs: what the results depend on besides source and suite, by name: versions of systems, towns, weights, data.
        versions: of what else decides results, beside those of the packages.
        details: what else the kind's own methods want to know; not written.
    """

    kind: Kind
    suite: Any
    device: str
    cells: tuple[Cell, ...]
    inputs: Mapping[str, Any]
    versions: Mapping[str, str] = field(default_factory=dict)
    details: Any = None


@dataclass(frozen=True)
class Resources:
    """What a run may use: processes of this machine (None: one a core) or a Ray cluster, a device, a place to talk."""

    workers: int | None = None
    ray: str | None = None
    device: str = "cpu"
    console: Console = field(default_factory=lambda: Console(stderr=True))


@dataclass(frozen=True)
class Job:
    """What the workers of a run know besides the cells: the results folder, the device, and the kind's settings."""

    folder: Path
    device: str
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Replay:
    """A cell run again.

    Attributes:
        cell: The cell.
        difference: None if the result is equal to the bit, else where the two differ.
        trace: What happened in the drive; None for a cell that is no drive.
        graph: The town of the drive.
        compared: What was compared, in words.
        picture: Makes a picture of what the system was shown and found, clean and under the cell's condition.
        film: Frames [H, W, 3] of what the driver saw, with the s from one to the next; None: there are none.
        seen: What the driver saw, found and believed; None: it does not perceive.
    """

    cell: Cell
    difference: str | None
    trace: EpisodeTrace | None = None
    graph: LaneGraph | None = None
    compared: str = ""
    picture: Callable[[], U8] | None = None
    film: tuple[Iterator[U8], float] | None = None
    seen: Any = None


class CellError(SSADError):
    """Why a cell has no result, in words for the record."""


class Kind(ABC):
    """A kind of experiment. It has no state: workers get it by the name of its class.

    Attributes:
        name: in suites (`kind: NAME`) and in run.json; the report looks for a section of that name.
        suite: the schema of its suites.
        columns: the metrics of its records.
        factors: fields of a record that make a row of the default table, from coarse to fine.
        patience: crashes and time-outs of one system after which its other cells are not tried any more (None: all
            are tried); for systems of which one hanging call says all.
    """

    name: ClassVar[str]
    suite: ClassVar[type[SuiteBase]]
    columns: ClassVar[tuple[Column, ...]]
    factors: ClassVar[tuple[str, ...]]
    patience: ClassVar[int | None] = None

    def plan(self, suite: Any, *, device: str = "cpu", check: bool = True) -> Plan:
        """Resolve a suite: by default, what `cells` says of it.

        Args:
            suite: The suite.
            device: Where its cells run.
            check: Whether to check all input, so that errors show up here and not in a record.

        Raises:
            ConfigError: The input is wrong.
            FormatError: The input is wrong.
        """
        return Plan(self, suite, device, tuple(self.cells(suite)), {})

    def cells(self, suite: Any) -> Iterable[Cell]:
        """The cells of a suite; a kind brings this or `plan`."""
        raise NotImplementedError

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        """In a worker: results of some cells by key; by default of one after another. What goes wrong raises.

        Alone, a cell then fails with that reason; of several, each is run again alone.
        """
        return {cell.key: self.result(cell, job) for cell in cells}

    def result(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """In a worker: the result of a cell; a kind brings this or `execute`.

        A result is plain data: metrics (name -> number, None where it was not measured); n; artefacts (name -> path in
        the folder, or list of them; on disk when this returns); case and cluster (see docs/metrics.md); episode (a
        line for episodes.jsonl); and whatever else the record shall have.
        """
        raise NotImplementedError

    def start(self, job: Job) -> None:  # noqa: B027  nothing to do by default
        """In a worker, once: what no cell's time-out shall pay for."""

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """In the main process, before cells run: make data.

        Args:
            plan: The cells of the run.
            folder: Results folder.
            resources: What the run may use.
            retry: Cells that failed before and are tried again.

        Returns:
            Settings of the `Job`, plain data.
        """
        return {}

    def workers(self, plan: Plan, asked: int | None) -> int | None:
        """How many may work at once.

        Args:
            plan: The cells of the run.
            asked: What the user wants; None: what the machine allows.

        Returns:
            The same, or less.
        """
        return asked

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        """Cells in groups that `execute` is given at once: alike, of one system, and fewer where workers would idle."""
        return grouped(cells, plan.suite.chunk, workers=workers, by=self.alike)

    def alike(self, cell: Cell) -> Hashable:
        """Cells for which this is equal can run as one batch; they share a system."""
        return cell.system

    def order(self, cell: Cell) -> float:
        """Cells of a lower number run earlier."""
        return 0.0

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Work that cells of different systems can share and that is done before them.

        Args:
            cell: A cell that needs the work.
            job: What the workers of the run know.

        Returns:
            Name -> plain data; what already exists may be left out.
        """
        return {}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """In a worker: do a piece of shared work for some systems, and leave its result in the folder.

        If this fails, only time is lost: `execute` must be able to do without it, and it is the failure of `execute`
        that counts.

        Args:
            name: Name of the piece.
            data: Its data; see `pieces`.
            systems: Systems to do it for.
            job: What the workers of the run know.
        """
        raise CellError(f"the kind {self.name} names pieces of work, but not how they are made")

    def finish(self, plan: Plan, folder: Path) -> None:  # noqa: B027  nothing to do by default
        """In the main process, when all cells have run: pictures for the report."""

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Run a finished cell again, alone, and compare it with its record.

        Raises:
            ConfigError: the kind's cells cannot be replayed.
        """
        raise ConfigError(f"{folder}: cells of kind '{self.name}' cannot be replayed")

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """In the main process: the page of a run as HTML, and its tables; by default the columns by the factors.

        A kind of your own renders a template of its own with `ssad.report.pages.render`, or leaves this out.
        """
        return default.section(run, verdict=self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Main table of a run, for the terminal and for pages that link to the run."""
        return default.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Findings of a run in sentences, the most important first; empty: none can be drawn."""
        return []

    @cached_property
    def code(self) -> str:
        """12 hex digits over the source that results depend on, as it was when first asked for."""
        return source_version(type(self).__module__, without=self.presentation())

    @classmethod
    def presentation(cls) -> tuple[str, ...]:
        """Modules that present results and decide none: the report, and `page` and `verdict` beside the kind.

        They are no part of a cell's key, so that a page can be changed without running anything again.
        """
        package = cls.__module__.rpartition(".")[0]
        return ("ssad.report", *(f"{package}.{name}" for name in ("page", "verdict") if package))

    def make_cell(
        self, name: str, system: str, seed: int, fields: Mapping[str, Any], spec: Mapping[str, Any], *inputs: object
    ) -> Cell:
        """A cell with its key. inputs: versions of what it depends on besides the source and its own description.

        A system with a label (`ssad.core.registry.Reference`) is called by it in the cell's name and fields.
        """
        label = label_of(system)
        if label != system:
            name = name.replace(system, label, 1)
            fields = {key: label if value == system else value for key, value in fields.items()}
        described = safeio.parse_json(safeio.dump_json({"fields": dict(fields), "spec": dict(spec)}))
        key = digest("cell", self.name, self.code, safeio.dump_json(described), system, seed, *inputs)
        return Cell(key[:16], name, system, seed, described["fields"], described["spec"])


def check_distinct(suite: SuiteBase, key: str, names: Sequence[object]) -> None:
    """ConfigError: a name, or the label of two, appears twice under a key of a suite."""
    called = [label_of(name) if isinstance(name, str) else name for name in names]
    twice = next((name for name in called if called.count(name) > 1), None)
    if twice is None:
        return
    hint = f" ('{twice}'); tell two of a name apart by a label, {twice}@first" if key == "systems" else ""
    raise ConfigError(f"suite {suite.name}: {key}: a name appears twice{hint}")


def grouped(cells: Sequence[Cell], chunk: int, *, workers: int, by: Callable[[Cell], Hashable]) -> list[list[Cell]]:
    """Batches of cells with a value in common, of `chunk` at most, and smaller where cells are few for the workers."""
    size = max(1, min(chunk, -(-len(cells) // workers)))
    groups: dict[Hashable, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(by(cell), []).append(cell)
    return [group[k : k + size] for group in groups.values() for k in range(0, len(group), size)]


def find_cell(cells: Sequence[Cell], text: str) -> Cell:
    """The one cell whose key begins with `text`, or that is called `text` ("blind/StraightObstacle/00").

    Raises:
        ConfigError: there is none, or more than one.
    """
    found = [c for c in cells if c.name == text] or [c for c in cells if text and c.key.startswith(text)]
    if len(found) == 1:
        return found[0]
    if found:
        shown = ", ".join(f"{c.key} ({c.name})" for c in found[:3])
        raise ConfigError(f"'{text}' means {len(found)} cells: {shown} ...; give more of the key")
    close = difflib.get_close_matches(text, [c.name for c in cells], n=3, cutoff=0.0)
    raise ConfigError(f"no cell '{text}' in this run; closest: {', '.join(close)}")
