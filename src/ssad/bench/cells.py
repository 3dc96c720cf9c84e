"""Cells: one episode each, named by a hash of everything that its result depends on."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import ssad
from ssad.bench.suite import Suite
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.seeding import digest, seed32
from ssad.core.types import Scenario

# a change in any of these may change a number, so it changes the key of every cell
_CODE = ("drivers", "metrics", "roads", "scenarios", "world", "core")


@dataclass(frozen=True)
class Cell:
    """One episode to run: system x scenario x repetition. seed does not depend on the system: systems are paired."""

    key: str
    system: str
    scenario: Mapping[str, Any]
    repetition: int
    seed: int

    @property
    def group(self) -> str:
        """The column of the table: the scenario's group, else its type."""
        return str(self.scenario.get("group") or self.scenario["type"])

    @property
    def name(self) -> str:
        """What people call it: system/scenario, and the repetition if it is not the first."""
        tail = f"#{self.repetition}" if self.repetition else ""
        return f"{self.system}/{self.scenario['name']}{tail}"

    def as_dict(self) -> dict[str, Any]:
        """Plain data for a child process or a record."""
        return asdict(self)


def code_version() -> str:
    """12 hex digits over the source that episodes depend on."""
    return source_version(_CODE)


@lru_cache(maxsize=4)
def source_version(parts: tuple[str, ...]) -> str:
    """12 hex digits over files, and folders of source, of the package."""
    package = Path(ssad.__file__).resolve().parent
    total = hashlib.sha256()
    for part in parts:
        path = package / part
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return total.hexdigest()[:12]


def system_version(name: str) -> str:
    """Empty for a built-in system (the code version covers it), else a hash of the source file of its module.

    UnknownNameError or ConfigError when there is no such system.
    """
    from ssad.core.registry import resolve
    from ssad.drivers import SYSTEMS

    found = resolve("system", SYSTEMS, name)
    if name in SYSTEMS:
        return ""
    if not callable(getattr(found, "act", None)) or not callable(getattr(found, "reset", None)):
        raise ConfigError(f"system '{name}' needs the methods reset(episodes) and act(view)")
    try:
        source = inspect.getsourcefile(found if isinstance(found, type) else type(found))
        return hashlib.sha256(Path(str(source)).read_bytes()).hexdigest()[:12]
    except (OSError, TypeError):
        return ""


def town_version(graph: Any) -> str:
    """12 hex digits over every array of a lane graph."""
    total = hashlib.sha256()
    for name, value in sorted(vars(graph).items()):
        if hasattr(value, "tobytes"):
            total.update(f"{name}{value.dtype.str}{value.shape}".encode() + value.tobytes())
    return total.hexdigest()[:12]


def scenario_json(scenario: Scenario) -> dict[str, Any]:
    """A scenario as plain data, as it stands in YAML, with its defaults written out."""
    data: dict[str, Any] = safeio.parse_json(safeio.dump_json(asdict(scenario)))
    return data


def make_cells(
    suite: Suite,
    scenarios: Sequence[Scenario],
    *,
    systems: Mapping[str, str],
    towns: Mapping[str, str],
) -> tuple[Cell, ...]:
    """All cells of a suite. systems and towns map the names to versions (`system_version`, `town_version`)."""
    cells = []
    for system in suite.systems:
        for scenario in scenarios:
            data = scenario_json(scenario)
            text = safeio.dump_json(data)
            for repetition in range(suite.repetitions):
                seed = seed32("episode", suite.seed, text, repetition)
                town = towns.get(scenario.town, "")
                key = digest("cell", code_version(), text, town, system, systems[system], repetition, seed)
                cells.append(Cell(key[:16], system, data, repetition, seed))
    return tuple(cells)


def find_cell(cells: Sequence[Cell], text: str) -> Cell:
    """The one cell whose key begins with `text`, or that is called `text` ("blind/StraightObstacle/00")."""
    found = [c for c in cells if c.name == text] or [c for c in cells if text and c.key.startswith(text)]
    if len(found) == 1:
        return found[0]
    if found:
        shown = ", ".join(f"{c.key} ({c.name})" for c in found[:3])
        raise ConfigError(f"'{text}' means {len(found)} cells: {shown} ...; give more of the key")
    import difflib

    close = difflib.get_close_matches(text, [c.name for c in cells], n=3, cutoff=0.0)
    raise ConfigError(f"no cell '{text}' in this run; closest: {', '.join(close)}")
