"""Report of an import: what it took over, left out, and doubted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ssad.core.errors import SSADError
from ssad.core.wording import wrapped_line

EXAMPLES = 4  # places named in a line


@dataclass
class ImportReport:
    """Account of an import.

    Attributes:
        source: The file.
        contents: Lines on what came in.
        notes: Reason -> places of what came in in another form.
        omissions: Reason -> places of what the file holds and the import does not carry over.
        doubts: Reason -> places at which the file is likely to be wrong, or at which the result does something else
            than the file states; `refuse_doubts` turns them into an error.
    """

    source: str
    contents: list[str] = field(default_factory=list)
    notes: dict[str, list[str]] = field(default_factory=dict)
    omissions: dict[str, list[str]] = field(default_factory=dict)
    doubts: dict[str, list[str]] = field(default_factory=dict)

    def note(self, reason: str, place: str = "", *, count: int = 1) -> None:
        """Note that something at a place of the file, or at `count` places, came in in another form."""
        self.notes.setdefault(reason, []).extend([place] * count)

    def omit(self, reason: str, place: str = "", *, count: int = 1) -> None:
        """Note that something at a place of the file, or at `count` places, is not carried over."""
        self.omissions.setdefault(reason, []).extend([place] * count)

    def doubt(self, reason: str, place: str = "", *, count: int = 1) -> None:
        """Note that the file is likely to be wrong, or the result to differ from it, at a place or `count` places."""
        self.doubts.setdefault(reason, []).extend([place] * count)

    def extend(self, other: ImportReport) -> None:
        """Add the lines of another report, such as that of the map of a scenario."""
        self.contents += other.contents
        for lines, other_lines in (
            (self.notes, other.notes),
            (self.omissions, other.omissions),
            (self.doubts, other.doubts),
        ):
            for reason, places in other_lines.items():
                lines.setdefault(reason, []).extend(places)

    def lines(self, examples: int | None = EXAMPLES) -> list[str]:
        """Return the report as lines: contents, notes, omissions, doubts.

        Args:
            examples: Places that a line names at most; None: all of them.
        """
        return [
            *self.contents,
            *(_line(reason, places, examples) for reason, places in self.notes.items()),
            *(f"not carried over: {_line(reason, places, examples)}" for reason, places in self.omissions.items()),
            *(f"doubtful: {_line(reason, places, examples)}" for reason, places in self.doubts.items()),
        ]

    def text(self, first_line: str = "", *, examples: int | None = EXAMPLES) -> str:
        """Return the report in lines of at most 80 columns, after a first line on what was written.

        Args:
            first_line: Name and place of the result; empty: none.
            examples: Places that a line names at most; None: all of them.
        """
        return wrapped([first_line] * bool(first_line) + self.lines(examples))

    def refuse_doubts(self, error: type[SSADError]) -> None:
        """Raise an error that names the first doubt, if there is one."""
        if self.doubts:
            raise error(
                f"{self.source}: {_first(self.doubts, 'doubts')}; correct the file, or import it without --strict"
            )


def report_path(result: Path) -> Path:
    """Return the path of the report beside the result of an import: OUT.yaml -> OUT.import.txt."""
    return Path(result).with_suffix(".import.txt")


def wrapped(lines: Iterable[str]) -> str:
    """Return lines of at most 80 columns each; what continues a line is indented. Paths are never broken."""
    return "\n".join(map(wrapped_line, lines))


def _first(lines: Mapping[str, Sequence[str]], word: str) -> str:
    """Return the first reason with its places, and the number of the others, which a word names."""
    reason, places = next(iter(lines.items()))
    others = len(lines) - 1
    return f"{_line(reason, places, EXAMPLES)}{f', and {others} other {word}' if others else ''}"


def _line(reason: str, places: Sequence[str], examples: int | None) -> str:
    """Return a reason with its first places."""
    named = list(dict.fromkeys(place for place in places if place))
    count = f" ({len(places)} times)" if len(places) > 1 else ""
    shown = named[:examples]
    rest = f" and {len(named) - len(shown)} more" if len(named) > len(shown) else ""
    return f"{reason}{count}{': ' if named else ''}{', '.join(shown)}{rest}"
