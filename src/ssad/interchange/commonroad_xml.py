"""Shared parts of the writer and the reader of CommonRoad 2020a: elements with text, and names of the format."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from ssad.core.errors import FormatError
from ssad.core.lane_graph import Marking
from ssad.core.types import F64, AgentKind, LaneType, SignalState

if TYPE_CHECKING:
    import numpy.typing as npt

VERSION: Final = "2020a"
STEP: Final = 0.1  # s of the world
DIGITS: Final = 6  # decimals that are written; the format allows no exponents
STOP, YIELD, TOP_SPEED = "206", "205", "274"  # signs of Germany and of Zamunda, CommonRoad's country of fictitious maps

LANE_TYPES: Final[dict[LaneType, str]] = {
    LaneType.DRIVING: "urban",
    LaneType.SHOULDER: "shoulder",
    LaneType.SIDEWALK: "sidewalk",
    LaneType.PARKING: "parking",
    LaneType.BIKING: "bicycleLane",
    LaneType.MEDIAN: "border",
    LaneType.NONE: "restricted",
}
LANE_TYPE_OF: Final[dict[str, LaneType]] = {name: kind for kind, name in LANE_TYPES.items()} | {
    "busStop": LaneType.SHOULDER,
    "restricted_area": LaneType.NONE,
}
"""laneletType -> kind of lane; every other one (urban, country, highway, interstate, ...) is for driving."""
MARKINGS: Final[dict[Marking, str]] = {
    Marking.NONE: "no_marking",
    Marking.BROKEN: "dashed",
    Marking.SOLID: "solid",
    Marking.DOUBLE: "solid_solid",
    Marking.CURB: "curb",
    Marking.OTHER: "unknown",
}
MARKING_OF: Final[dict[str, Marking]] = {name: mark for mark, name in MARKINGS.items()} | {
    "dashed_dashed": Marking.BROKEN,
    "broad_dashed": Marking.BROKEN,
    "broad_solid": Marking.SOLID,
    "lowered_curb": Marking.CURB,
    "solid_dashed": Marking.OTHER,
    "dashed_solid": Marking.OTHER,
}
COLOURS: Final[dict[SignalState, str]] = {
    SignalState.OFF: "inactive",
    SignalState.RED: "red",
    SignalState.YELLOW: "yellow",
    SignalState.GREEN: "green",
}
STATE_OF: Final[dict[str, SignalState]] = {name: state for state, name in COLOURS.items()} | {
    "redYellow": SignalState.RED
}
TYPES: Final[dict[AgentKind, str]] = {
    AgentKind.CAR: "car",
    AgentKind.TRUCK: "truck",
    AgentKind.BUS: "bus",
    AgentKind.MOTORCYCLE: "motorcycle",
    AgentKind.BICYCLE: "bicycle",
    AgentKind.WALKER: "pedestrian",
}
"""Kind -> obstacle type of a dynamic obstacle."""
KINDS_OF: Final[dict[str, tuple[AgentKind, ...]]] = {name: (kind,) for kind, name in TYPES.items()} | {
    "taxi": (AgentKind.CAR,),
    "priorityVehicle": (AgentKind.CAR, AgentKind.TRUCK),
    "train": (AgentKind.BUS,),
    "unknown": (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS),
}
"""Obstacle type -> kinds that may play it."""


def add_element(parent: Element, tag: str, text: Any = None, **attributes: Any) -> Element:
    """Add an element to a parent, with a text and attributes."""
    element = SubElement(parent, tag, {name: format_value(value) for name, value in attributes.items()})
    if text is not None:
        element.text = format_value(text)
    return element


def element_name(element: Element) -> str:
    """Return the name of an element in messages: its tag, and its id if it has one."""
    number = element.get("id", "")
    return f"{element.tag} {number[:20]}" if number else str(element.tag)


def format_value(value: Any) -> str:
    """Format a value as text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return decimal(float(value)) if isinstance(value, (float, np.floating)) else str(value)


def decimal(value: float) -> str:
    """Format a number without an exponent."""
    text = f"{value:.{DIGITS}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def points(parent: Element, rows: npt.ArrayLike) -> None:
    """Add points [N, 2] or [N, 3] to an element."""
    for row in np.asarray(rows, np.float64).tolist():
        point = add_element(parent, "point")
        for name, value in zip("xyz", row, strict=False):
            add_element(point, name, value)


class TextReader:
    """Reader of the numbers in a document's elements; errors name the file and the element with its id."""

    def __init__(self, location: str) -> None:
        self.location = location

    def error(self, element: Element | str, message: str) -> FormatError:
        """Return a FormatError that names the file and the element."""
        if isinstance(element, str):
            return FormatError(f"{self.location}: {element}: {message}")
        return FormatError(f"{self.location}: {element_name(element)}: {message}")

    def number(self, text: str | None, element: Element, description: str) -> float:
        """A finite number. FormatError if the text is none."""
        if text is None:
            raise self.error(element, f"{description} is missing")
        try:
            value = float(text)
        except ValueError:
            raise self.error(element, f"{description} is '{text.strip()[:40]}', not a number") from None
        if not math.isfinite(value) or abs(value) > 1e9:
            raise self.error(element, f"{description} is '{text.strip()[:40]}', not a number that can be used")
        return value

    def whole(self, text: str | None, element: Element, description: str) -> int:
        """A whole number. FormatError if the text is none."""
        value = self.number(text, element, description)
        if value != int(value):
            raise self.error(element, f"{description} is '{(text or '').strip()[:40]}', not a whole number")
        return int(value)

    def ids(self, element: Element, tag: str) -> list[int]:
        """Return the ids that the children with a tag refer to."""
        return [self.whole(child.get("ref"), element, f"{tag}: ref") for child in element.iterfind(tag)]

    def points(self, element: Element | None, within: Element, description: str) -> F64:
        """Points [N, 3] under an element; z is 0 where it is not given."""
        if element is None:
            raise self.error(within, f"{description} is missing")
        rows = [
            [
                self.number(point.findtext(axis, None if axis != "z" else "0"), within, f"{description}: {axis}")
                for axis in "xyz"
            ]
            for point in element.iterfind("point")
        ]
        return np.array(rows, np.float64).reshape(-1, 3)

    def value(self, element: Element | None, within: Element, description: str) -> tuple[float, float]:
        """An exact value or an interval, as its ends."""
        if element is None:
            raise self.error(within, f"{description} is missing")
        if (exact := element.findtext("exact")) is not None:
            value = self.number(exact, within, description)
            return value, value
        low, high = (
            self.number(element.findtext(bound_tag), within, f"{description}: {bound_tag}")
            for bound_tag in ("intervalStart", "intervalEnd")
        )
        if low > high:
            raise self.error(within, f"{description}: an interval from {low:g} to {high:g}")
        return low, high


def parse_source(source: str) -> dict[str, str]:
    """Return the fields of a `source` that SSAD wrote: `SSAD; name=...; ...`."""
    first, *fields = (field.strip() for field in source.split(";"))
    return dict(field.split("=", 1) for field in fields if "=" in field) if first == "SSAD" else {}


def format_source(values: Iterable[tuple[str, Any]]) -> str:
    """The `source` that `parse_source` reads."""
    return "; ".join(["SSAD", *(f"{name}={str(value).replace(';', ',')}" for name, value in values)])
