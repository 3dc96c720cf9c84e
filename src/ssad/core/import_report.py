"""Report of an import: what it took over, left out, and doubted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from ssad.core.errors import SSADError

EXAMPLES = 4  # places named in a line


@dataclass
class ImportReport:
    """Account of an import.

    Attributes:
        source: The file.
        contents: Lines on what came in.
        notes: Reason -> places of what came in in another form.
        omissions: Reason -> places of what the file holds and the import does not carry over.
        doubts: Reason -> places at which the file is likely to be wrong; `refuse_doubts` turns them into an error.
    """

    source: str
    contents: list[str] = field(default_factory=list)
    notes: dict[str, list[str]] = field(default_factory=dict)
    omissions: dict[str, list[str]] = field(default_factory=dict)
    doubts: dict[str, list[str]] = field(default_factory=dict)

    def note(self, reason: str, place: str = "") -> None:
        """Note that something at a place of the file came in in another form."""
        self.notes.setdefault(reason, []).append(place)

    def omit(self, reason: str, place: str = "") -> None:
        """Note that something at a place of the file is not carried over."""
        self.omissions.setdefault(reason, []).append(place)

    def doubt(self, reason: str, place: str = "") -> None:
        """Note that the file is likely to be wrong at a place."""
        self.doubts.setdefault(reason, []).append(place)

    def lines(self) -> list[str]:
        """Return the report as lines: contents, notes, omissions, doubts."""
        return [
            *self.contents,
            *(_line(reason, places) for reason, places in self.notes.items()),
            *(f"not carried over: {_line(reason, places)}" for reason, places in self.omissions.items()),
            *(f"doubtful: {_line(reason, places)}" for reason, places in self.doubts.items()),
        ]

    def refuse_doubts(self, error: type[SSADError]) -> None:
        """Raise an error that names the first doubt, if there is one."""
        if self.doubts:
            reason, places = next(iter(self.doubts.items()))
            others = len(self.doubts) - 1
            raise error(
                f"{self.source}: {_line(reason, places)}{f', and {others} other doubts' if others else ''}; correct"
                " the file, or import it without --strict"
            )


def _line(reason: str, places: Sequence[str]) -> str:
    """Return a reason with its first places."""
    named = list(dict.fromkeys(place for place in places if place))
    count = f" ({len(places)} times)" if len(places) > 1 else ""
    rest = f" and {len(named) - EXAMPLES} more" if len(named) > EXAMPLES else ""
    return f"{reason}{count}{': ' if named else ''}{', '.join(named[:EXAMPLES])}{rest}"
