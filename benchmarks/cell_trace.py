"""The path of one cell through the code: visits, modules, packages, upward calls.

    uv run python -m benchmarks.cell_trace gap-quick --set 'scenarios=[LaneChanging/00]' --cell das-yolov5n-twinford

A cell runs in this process. The profiler notes each function of SSAD when it is called for the first time, and its
caller. The *path* is the order of those functions down to `--depth` calls below `Kind.execute`; deeper calls are the
inside of what the path visits. With a depth of 4 the trace of commit 5367f82 has 67 visits to 33 modules, where a
reader who walked the source by hand counted 71 and 32.

A *visit* is an uninterrupted stretch of the path in one unit; a *return* is a visit to a unit that was visited before;
an *upward call* goes from a package to one in a layer above it (pyproject.toml lists the layers). Units are modules,
or packages down to the second level (`ssad.scenarios.static`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import ssad
from ssad.core.errors import ConfigError
from ssad.engine.kind import Cell, Job, Plan, Resources
from ssad.experiments.suites import kind_of, load_suite

ROOT = Path(__file__).resolve().parents[1]
SOURCE = str(Path(ssad.__file__).parent) + "/"
DEPTH = 4
NAMELESS = ("<module>", "<lambda>", "<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")


@dataclass(frozen=True)
class Call:
    """First call of a function.

    Attributes:
        module: Path of its module below the package, such as "engine/kind.py".
        function: Qualified name.
        caller: Index of the call of the function that called it; None for the first.
        depth: Number of calls above it.
    """

    module: str
    function: str
    caller: int | None
    depth: int

    @property
    def package(self) -> str:
        """Package of the module, down to the second level, such as "scenarios.static"."""
        parts = self.module.removesuffix(".py").split("/")
        return ".".join(parts[:2]) if len(parts) > 2 else parts[0]

    @property
    def layer(self) -> str:
        """Top-level package."""
        return self.module.removesuffix(".py").split("/")[0]


@dataclass(frozen=True)
class PathCount:
    """Counts of a path, with modules or packages as units."""

    visits: int
    units: int

    @property
    def returns(self) -> int:
        """Visits to units that were visited before."""
        return self.visits - self.units


def first_calls(work: Callable[[], Any]) -> list[Call]:
    """Return the functions of SSAD that `work` calls, in the order of their first calls."""
    calls: list[Call] = []
    index_of: dict[CodeType, int] = {}

    def profile(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event != "call" or code in index_of or not code.co_filename.startswith(SOURCE):
            return
        if code.co_name in NAMELESS:
            return
        back = frame.f_back
        while back is not None and back.f_code not in index_of:
            back = back.f_back
        caller = None if back is None else index_of[back.f_code]
        index_of[code] = len(calls)
        depth = 0 if caller is None else calls[caller].depth + 1
        calls.append(Call(code.co_filename.removeprefix(SOURCE), code.co_qualname, caller, depth))

    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls


def trace_cell(plan: Plan, cell: Cell, folder: Path) -> list[Call]:
    """Return the first calls of the execution of a cell, without those that plan and prepare the run."""
    job = Job(folder, plan.device, plan.kind.prepare(plan, folder, Resources(workers=0)))
    plan.kind.start(job)
    for name, data in plan.kind.pieces(cell, job).items():
        plan.kind.make(name, data, [cell.system], job)
    return first_calls(lambda: plan.kind.execute([cell], job))


def count(calls: Sequence[Call], unit: Callable[[Call], str]) -> PathCount:
    """Return visits and units of a path."""
    units = [unit(call) for call in calls]
    return PathCount(bool(units) + sum(before != after for before, after in pairwise(units)), len(set(units)))


def upward_calls(calls: Sequence[Call]) -> list[tuple[Call, Call]]:
    """Return caller and function of each call into a layer above the caller's."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    ranks = {name.strip(): -rank for rank, layer in enumerate(contracts[0]["layers"]) for name in layer.split("|")}
    pairs = [(calls[call.caller], call) for call in calls if call.caller is not None]
    return [(caller, call) for caller, call in pairs if ranks[call.layer] > ranks[caller.layer]]


def report(calls: Sequence[Call], depth: int) -> str:
    """Return the path as text: one line for each visit to a package, then the counts."""
    path = [call for call in calls if call.depth <= depth]
    lines: list[str] = []
    package = ""
    for call in path:
        if call.package != package:
            package = call.package
            lines.append(f"{package}:")
        lines[-1] += f" {call.function}"
    upward = [(calls[call.caller], call) for call in path if call.caller is not None]
    ups = [pair for pair in upward_calls(calls) if pair in upward]
    for name, unit in (("modules", lambda call: call.module), ("packages", lambda call: call.package)):
        counts = count(path, unit)
        lines.append(f"{name:<9} {counts.visits} visits, {counts.units} units, {counts.returns} returns")
    lines.append(f"upward    {len(ups)} calls: {', '.join(f'{a.function} -> {b.function}' for a, b in ups) or 'none'}")
    lines.append(f"in all    {len({call.package for call in calls})} packages, {len(calls)} functions")
    return "\n".join(lines)


def main() -> None:
    """Print the path of a cell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", help="name or file of a suite")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="KEY=VALUE, as for ssad run")
    parser.add_argument("--cell", default="", help="part of the cell's name; default: the last cell")
    parser.add_argument("--depth", type=int, default=DEPTH, help="calls below Kind.execute (default: %(default)s)")
    arguments = parser.parse_args()
    suite = load_suite(arguments.suite, arguments.settings)
    plan = kind_of(suite.kind).plan(suite)
    cells = [cell for cell in plan.cells if arguments.cell in cell.name]
    if not cells:
        raise ConfigError(f"no cell has '{arguments.cell}' in its name; cells: {', '.join(c.name for c in plan.cells)}")
    with tempfile.TemporaryDirectory() as folder:
        calls = trace_cell(plan, cells[-1], Path(folder))
    print(f"{cells[-1].name}\n{report(calls, arguments.depth)}")


if __name__ == "__main__":
    main()
