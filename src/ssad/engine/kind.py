"""Interface of a kind of experiment, and the plan of a run.

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
from ssad.core.run_records import UNIT_LIMITS, ValueLimits
from ssad.core.seeding import digest
from ssad.core.source import source_version
from ssad.core.types import U8, EpisodeTrace
from ssad.core.wording import counted
from ssad.report import default
from ssad.report.load import Run
from ssad.report.tables import Table

Names = schema.Names


class SuiteBase(schema.Schema):
    """Keys that suites of every kind have.

    Attributes:
        kind: Kind of experiment (`ssad list kinds`).
        name: Name of the suite, and of the results folder if none is given.
        title: Title of the report.
        description: Text of the report.
        seed: Root of all random numbers.
        timeout_s: Seconds that one cell may take.
        chunk: Cells that run as one batch, where they can (results do not depend on it).
        reference: Published table that the report shows beside this one.
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
        """Return the suite with its files resolved: in the working folder, else beside the suite's own file."""
        return self

    def error(self, location: Sequence[str | int], message: str) -> ConfigError:
        """Return an error of a key that shows when scenarios or data are read.

        It names the line of the key where the suite comes from a file that has it.
        """
        path = Path(self._origin)
        if path.is_file():
            document = safeio.read_yaml_document(path)
            if tuple(location) in document.lines:
                return document.error(location, message)
        return ConfigError(f"suite {self.name}: {safeio.format_location(location)}: {message}")


@dataclass(frozen=True)
class Column:
    """A metric of a kind's records.

    Attributes:
        name: Its key in `metrics`.
        title: Title of the column.
        unit: Unit of the values.
        better: Which way is better; "": neither.
        limits: Least and greatest possible value, such as `ssad.core.run_records.SHARE`; None: that of the unit
            (`UNIT_LIMITS`) with either sign, if the unit has one. A result beyond them fails.
        clock: Whether the machine's clock decides the value, so that equal runs have different ones: it is in no hash.
    """

    name: str
    title: str = ""
    unit: str = ""
    better: Literal["higher", "lower", ""] = ""
    limits: ValueLimits = (None, None)
    clock: bool = False

    @property
    def value_limits(self) -> ValueLimits:
        """Least and greatest possible value; None: no limit."""
        low, high = self.limits
        size = UNIT_LIMITS.get(self.unit)
        if size is None:
            return low, high
        return -size if low is None else low, size if high is None else high


@dataclass(frozen=True)
class Cell:
    """One row of the results: the smallest unit that is run, kept, retried and counted.

    Attributes:
        key: Hash of all that the result depends on; made by `make_cell`.
        name: Readable name, such as "blind/StraightObstacle/00".
        system: System under test; cells of one system may run as one batch.
        seed: Seed of its random numbers.
        fields: Columns of its record that tell it from other cells.
        spec: Plain data, all that a worker needs.
    """

    key: str
    name: str
    system: str
    seed: int
    fields: Mapping[str, Any]
    spec: Mapping[str, Any]


@dataclass(frozen=True)
class Plan:
    """All cells of a run, resolved and checked before anything is written.

    Attributes:
        kind: Kind of experiment.
        suite: Resolved suite.
        device: cpu or cuda.
        cells: Cells in the order of the tables.
        inputs: Inputs of the results besides source and suite, by name: versions of systems, towns, weights, data.
        versions: Versions that decide results, beside those of the packages.
        details: Further data for the kind's own methods; not written.
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
    """Resources of a run: local processes (None: one a core) or a Ray cluster, a device, a console for progress."""

    workers: int | None = None
    ray: str | None = None
    device: str = "cpu"
    console: Console = field(default_factory=lambda: Console(stderr=True))


@dataclass(frozen=True)
class Job:
    """Data that the workers of a run share: the results folder, the device, and the kind's settings."""

    folder: Path
    device: str
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Replay:
    """A cell run again.

    Attributes:
        cell: The cell.
        difference: First difference from the record, in words; None: equal to the bit.
        trace: Trace of the drive; None for a cell that is no drive.
        graph: Town of the drive.
        compared: Compared results, in words.
        picture: Makes a picture of the system's input and output, clean and under the cell's condition.
        film: Frames [H, W, 3] of the driver's camera, with the seconds between two of them; None: there are none.
        perception: Perception of the driver: input, detections, belief; None: it does not perceive.
    """

    cell: Cell
    difference: str | None
    trace: EpisodeTrace | None = None
    graph: LaneGraph | None = None
    compared: str = ""
    picture: Callable[[], U8] | None = None
    film: tuple[Iterator[U8], float] | None = None
    perception: Any = None


class CellError(SSADError):
    """Reason why a cell has no result, in words for the record."""


class Kind(ABC):
    """A kind of experiment. It has no state: workers get it by the name of its class.

    Attributes:
        name: Name in suites (`kind: NAME`) and in run.json.
        suite: Schema of its suites.
        columns: Metrics of its records.
        factors: Fields of a record that make a row of the default table, from coarse to fine.
        metric_limits: Least and greatest possible value of metrics that are no columns.
        rates: Rates over cells, by symbol: the metric of the records that is above 0 where the event occurred.
        patience: Crashes and time-outs of one system after which its other cells are skipped (None: all are tried);
            for systems of which one hanging call predicts the others.
    """

    name: ClassVar[str]
    suite: ClassVar[type[SuiteBase]]
    columns: ClassVar[tuple[Column, ...]]
    factors: ClassVar[tuple[str, ...]]
    metric_limits: ClassVar[Mapping[str, ValueLimits]] = {}
    rates: ClassVar[Mapping[str, str]] = {}
    patience: ClassVar[int | None] = None

    def plan(self, suite: Any, *, device: str = "cpu", check: bool = True) -> Plan:
        """Resolve a suite: by default, to the cells of `cells`.

        Args:
            suite: The suite.
            device: Device of its cells.
            check: Whether to check all input, so that errors show up here and not in a record.

        Raises:
            ConfigError: The input is wrong.
            FormatError: The input is wrong.
        """
        return Plan(self, suite, device, tuple(self.cells(suite)), {})

    def cells(self, suite: Any) -> Iterable[Cell]:
        """Return the cells of a suite; a kind implements this or `plan`."""
        raise NotImplementedError

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        """Return results of some cells by key, in a worker; by default of one after another. Failures raise.

        A cell that fails alone keeps that reason; a batch that fails is run again cell by cell.
        """
        return {cell.key: self.result(cell, job) for cell in cells}

    def result(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """In a worker: the result of a cell; a kind brings this or `execute`.

        A result is plain data: metrics (name -> number, None where it was not measured); n; artefacts (name -> path in
        the folder, or list of them; on disk when this returns); case and cluster (docs/explanation/intervals.md);
        episode (a line for episodes.jsonl); and whatever else the record shall have.
        """
        raise NotImplementedError

    def start(self, job: Job) -> None:  # noqa: B027  nothing to do by default
        """Initialise a worker, once, outside of the time-out of any cell."""

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Make data in the main process, before cells run.

        Args:
            plan: The cells of the run.
            folder: Results folder.
            resources: Resources of the run.
            retry: Cells that failed before and are tried again.

        Returns:
            Settings of the `Job`, plain data.
        """
        return {}

    @cached_property
    def limits(self) -> Mapping[str, ValueLimits]:
        """Least and greatest possible value of each metric that has limits."""
        limits = {column.name: column.value_limits for column in self.columns} | dict(self.metric_limits)
        return {name: pair for name, pair in limits.items() if pair != (None, None)}

    def workers(self, plan: Plan, requested: int | None) -> int | None:
        """Return the number of workers that may run at once.

        Args:
            plan: The cells of the run.
            requested: Number that the user wants; None: as many as the machine allows.

        Returns:
            The same, or less.
        """
        return requested

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        """Return cells in batches for `execute`: of one system, alike, and fewer where workers would idle."""
        return make_batches(cells, plan.suite.chunk, workers=workers, group_key=self.alike)

    def alike(self, cell: Cell) -> Hashable:
        """Return a value that is equal for cells that can run as one batch; they share a system."""
        return cell.system

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: lower numbers run earlier."""
        return 0.0

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Return work that cells of different systems share and that is done before them.

        Args:
            cell: A cell that needs the work.
            job: Data that the workers of the run share.

        Returns:
            Name -> plain data; work that is already done may be left out.
        """
        return {}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Do a piece of shared work for some systems, in a worker, and leave its result in the folder.

        A failure costs only time: `execute` must be able to do without the piece, and its own failure counts.

        Args:
            name: Name of the piece.
            data: Its data; see `pieces`.
            systems: Systems to do it for.
            job: Data that the workers of the run share.
        """
        raise CellError(f"the kind {self.name} names pieces of work, but not how they are made")

    def plan_lines(self, plan: Plan) -> list[str]:
        """Return lines about the cells of a plan for `ssad plan` and `--dry-run`, besides their numbers."""
        return []

    def finish(self, plan: Plan, folder: Path) -> None:  # noqa: B027  nothing to do by default
        """Write pictures for the report, in the main process, when all cells have run."""

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Run a finished cell again, alone, and compare it with its record.

        Raises:
            ConfigError: the kind's cells cannot be replayed.
        """
        raise ConfigError(f"{folder}: cells of kind '{self.name}' cannot be replayed")

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run as HTML, and its tables; by default the columns by the factors.

        A kind of your own renders its own template with `ssad.report.pages.render`, or leaves this out.
        """
        return default.section(run, verdict=self.verdict(run), note=self.note(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run, for the terminal and for pages that link to the run."""
        return default.summary(run, note=self.note(run))

    def note(self, run: Run) -> str:
        """Return the text under the table of columns by factors, on page and terminal; empty: there is none."""
        return ""

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences, the most important first; empty: there are none."""
        return []

    @cached_property
    def code(self) -> str:
        """12 hex digits over the source that results depend on, as it was on first use."""
        return source_version(type(self).__module__, excluded_modules=self.presentation())

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
        # Through JSON and back: the key is made of the values that the record will hold, tuples being lists.
        plain_data = safeio.parse_json(safeio.dump_json({"fields": dict(fields), "spec": dict(spec)}))
        key = digest("cell", self.name, self.code, safeio.dump_json(plain_data), system, seed, *inputs)
        return Cell(key[:16], name, system, seed, plain_data["fields"], plain_data["spec"])


def check_distinct(suite: SuiteBase, key: str, names: Sequence[object]) -> None:
    """Raise ConfigError if a name, or the label of two, appears twice under a key of a suite."""
    labels = [label_of(name) if isinstance(name, str) else name for name in names]
    repeated = next((name for name in labels if labels.count(name) > 1), None)
    if repeated is None:
        return
    hint = f" ('{repeated}'); tell two of a name apart by a label, {repeated}@first" if key == "systems" else ""
    raise ConfigError(f"suite {suite.name}: {key}: a name appears twice{hint}")


def make_batches(
    cells: Sequence[Cell], chunk: int, *, workers: int, group_key: Callable[[Cell], Hashable]
) -> list[list[Cell]]:
    """Batches of cells with a value in common, of `chunk` at most, and smaller where cells are few for the workers."""
    batch_size = max(1, min(chunk, -(-len(cells) // workers)))
    groups: dict[Hashable, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(group_key(cell), []).append(cell)
    return [
        group[start : start + batch_size] for group in groups.values() for start in range(0, len(group), batch_size)
    ]


def find_cell(cells: Sequence[Cell], name_or_key: str) -> Cell:
    """Return the one cell of this name ("blind/StraightObstacle/00"), or whose key begins with `name_or_key`.

    Raises:
        ConfigError: There is none, or more than one.
    """
    # An exact name wins over a prefix of a key.
    matches = [cell for cell in cells if cell.name == name_or_key] or [
        cell for cell in cells if name_or_key and cell.key.startswith(name_or_key)
    ]
    if len(matches) == 1:
        return matches[0]
    if matches:
        examples = ", ".join(f"{cell.key} ({cell.name})" for cell in matches[:3])
        raise ConfigError(
            f"'{name_or_key}' means {counted(len(matches), 'cell')}: {examples} ...; give more of the key"
        )
    suggestions = difflib.get_close_matches(name_or_key, [cell.name for cell in cells], n=3, cutoff=0.0)
    raise ConfigError(f"no cell '{name_or_key}' in this run; closest: {', '.join(suggestions)}")
