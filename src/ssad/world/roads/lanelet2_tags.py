"""Meaning of the tags of Lanelet2 maps: use of lanelets, markings, speed limits, signs, countries.

Source:
    Documentation of Lanelet2 on tagging of lanelets, line strings and regulatory elements; statutory speed limits of
    the countries named.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final

from ssad.core.lane_graph import Marking, SignKind
from ssad.core.types import LaneType
from ssad.world.roads.lanelet2 import Bound, Lanelet, Rule, Tags, Way
from ssad.world.roads.xodr import COUNTRIES, SIGNS

KM_H: Final = 1.0 / 3.6  # m/s
MPH: Final = 0.44704  # m/s
WALKING_PACE: Final = 7.0 * KM_H
LEFT_HAND_COUNTRIES: Final = (
    "ag au bb bd bn bs bt bw cy dm fj gb gd gy hk id ie im in jm jp ke ki kn lc lk ls mo mt mu mv mw my "
    "mz na np nz pg pk sb sc sg sr sz th tl to tt tv tz ug vc ws za zm zw "
)
"""Codes of the countries in which traffic keeps to the left, ISO 3166."""
RED_TURN_COUNTRIES: Final = frozenset({"", "us", "ca"})
TOWN_SPEEDS: Final = {
    "": (50 * KM_H, 100 * KM_H, 130 * KM_H),
    "us": (25 * MPH, 55 * MPH, 65 * MPH),
    "gb": (30 * MPH, 60 * MPH, 70 * MPH),
    "jp": (60 * KM_H, 60 * KM_H, 100 * KM_H),
}
"""Country -> limits in towns, outside them, and on motorways, m/s."""

_KINDS: Final = {
    name: kind
    for kind, names in (
        (LaneType.DRIVING, "road highway play_street exit bus_lane lane"),
        (LaneType.SHOULDER, "emergency_lane road_shoulder"),
        (LaneType.BIKING, "bicycle_lane"),
        (LaneType.SIDEWALK, "walkway shared_walkway stairs pedestrian_lane"),
    )
    for name in names.split()
} | {"": LaneType.DRIVING}
_PARTICIPANTS: Final = (
    (
        LaneType.DRIVING,
        ("vehicle", "vehicle:car", "vehicle:bus", "vehicle:truck", "vehicle:motorcycle", "vehicle:taxi"),
    ),
    (LaneType.SHOULDER, ("vehicle:emergency",)),
    (LaneType.BIKING, ("bicycle",)),
    (LaneType.SIDEWALK, ("pedestrian",)),
)
_PAINT: Final = {
    "solid": Marking.SOLID,
    "dashed": Marking.BROKEN,
    "solid_solid": Marking.DOUBLE,
    "dashed_dashed": Marking.BROKEN,
}
_YES: Final = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
_SPEED: Final = re.compile(r"\s*([0-9]*\.?[0-9]+)\s*([a-z/]*)\s*")
_UNITS: Final = {
    "": KM_H,
    "km/h": KM_H,
    "kmh": KM_H,
    "kph": KM_H,
    "mph": MPH,
    "m/s": 1.0,
    "mps": 1.0,
    "ms": 1.0,
}
_SPEED_SIGNS: Final = {
    "de": (re.compile(r"274(?:\.1)?[-_ ]([0-9]+)"), KM_H),
    "at": (re.compile(r"52-10a[-_ ]([0-9]+)"), KM_H),
    "jp": (re.compile(r"323[-_ ]([0-9]+)"), KM_H),
    "us": (re.compile(r"r2-1[-_ ]([0-9]+)"), MPH),
    "gb": (re.compile(r"670[-_ v]*([0-9]+)"), MPH),
}
_CODE: Final = re.compile(r"([a-z]{2})?[-_ :]*([a-z]?[0-9].*)")
MAX_SPEED: Final = 100.0  # m/s


def is_crosswalk(tags: Tags) -> bool:
    """Return whether a lanelet is a crosswalk."""
    return tags.get("subtype", "") == "crosswalk"


def lane_kind(tags: Tags) -> LaneType | None:
    """Return the use of a lanelet; None: its subtype is unknown.

    Participants that are named take the place of the subtype, unless it is a shoulder.
    """
    kind = _KINDS.get(tags.get("subtype", ""))
    if kind == LaneType.SHOULDER:
        return kind
    allowed = {
        name.removeprefix("participant:"): _YES.get(value.lower())
        for name, value in tags.items()
        if name.startswith("participant:")
    }
    if any(allowed.values()):
        for lane_type, names in _PARTICIPANTS:
            if any(allowed.get(name) for name in names):
                return lane_type
        return LaneType.NONE
    for lane_type, names in _PARTICIPANTS:
        if kind == lane_type and allowed.get(names[0]) is False:
            return LaneType.NONE
    return kind


def is_one_way(tags: Tags) -> bool | None:
    """Return whether vehicles use a lanelet in one direction; None: the tag says neither."""
    text = tags.get("one_way:vehicle", tags.get("one_way", "yes"))
    return _YES.get(text.lower()) if text else True


def marking(bound: Bound, *, is_left: bool) -> Marking:
    """Return the marking of a bound as a vehicle on the lanelet sees it: only BROKEN may be crossed."""
    tags = bound.tags
    change = tags.get("lane_change", "")
    # To the left of the line as it runs in the file lies the left of the bound, unless the bound is reversed.
    if not change:
        change = tags.get("lane_change:left" if is_left != bound.is_reversed else "lane_change:right", "")
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if bound.is_reversed and subtype in ("solid_dashed", "dashed_solid"):
        subtype = "dashed_solid" if subtype == "solid_dashed" else "solid_dashed"
    if kind in ("line_thin", "line_thick"):
        near = subtype.partition("_")[0 if not is_left else 2]
        paint = _PAINT.get(subtype, _PAINT.get(near, Marking.OTHER))
    elif kind == "curbstone":
        paint = Marking.CURB
    elif kind in ("virtual", ""):
        paint = Marking.NONE
    else:
        paint = Marking.OTHER
    allowed = _YES.get(change.lower())
    if allowed:
        return Marking.BROKEN
    return Marking.SOLID if allowed is False and paint == Marking.BROKEN else paint


def country_of(tags: Iterable[Tags]) -> str:
    """Return the country that most lanelets name, as two letters; empty: none."""
    regions = [region.lower()[:2] for lanelet_tags in tags if (region := lanelet_tags.get("region", ""))]
    country = max(sorted(set(regions)), key=regions.count, default="")
    return "gb" if country == "uk" else country


def stated_speed(text: str) -> float | None:
    """Return the speed that a text states, m/s; without a unit it is in km/h. None: it states none above 0."""
    match = _SPEED.fullmatch(text.lower())
    unit = _UNITS.get(match[2]) if match else None
    if match is None or unit is None:
        return None
    value = float(match[1]) * unit
    return value if 0.0 < value <= MAX_SPEED else None


def signed_speed(code: str, country: str) -> float | None:
    """Return the limit of a sign such as "de274-60" or "usR2-1-25", m/s; None: it is no speed limit."""
    match = _CODE.fullmatch(code.strip().lower())
    if match is None:
        return None
    pattern, unit = _SPEED_SIGNS.get(match[1] or country or "de", _SPEED_SIGNS["de"])
    number = pattern.fullmatch(match[2])
    return stated_speed(f"{float(number[1]) * unit} m/s") if number else None


def sign_kind(subtype: str, country: str) -> SignKind | None:
    """Return the meaning of a sign such as "de206", "usR1-2" or "stop_sign"; None: neither stop nor yield."""
    text = subtype.strip().lower()
    if text in ("stop", "stop_sign"):
        return SignKind.STOP
    if text in ("yield", "yield_sign", "give_way"):
        return SignKind.YIELD
    for prefix, code in ((text[:2], text[2:].lstrip("-_ :")), (country, text)):
        if (kind := SIGNS.get((COUNTRIES.get(prefix, prefix), code))) is not None:
            return kind
    return None


def speed_limit(
    lanelet: Lanelet, rules: Mapping[str, Rule], ways: Mapping[str, Way], country: str
) -> tuple[float | None, list[str]]:
    """Return the limit that a map states for vehicles on a lanelet, m/s, and texts that state none.

    A regulatory element goes before the tag of the lanelet; of several, the lowest holds.
    """
    unread: list[str] = []
    speeds: list[float] = []
    for name in lanelet.rules:
        rule = rules.get(name)
        if rule is None or rule.subtype != "speed_limit":
            continue
        texts = [text for key in ("sign_type", "value", "limit") if (text := rule.tags.get(key, ""))][:1]
        texts += [
            ways[way].tags.get("subtype", "") for way in rule.members.get("refers", ()) if way in ways and not texts
        ]
        for text in texts:
            speed = stated_speed(text) if not text.strip().isdecimal() or rule.tags.get("sign_type") else None
            speed = speed if speed is not None else signed_speed(text, country)
            if speed is None:
                unread.append(f"regulatory element {name[:30]}: '{text[:30]}'")
            else:
                speeds.append(speed)
    if speeds:
        return min(speeds), unread
    for key in ("speed_limit:vehicle:car", "speed_limit:vehicle", "speed_limit"):
        if text := lanelet.tags.get(key, ""):
            speed = stated_speed(text)
            if speed is not None:
                return speed, unread
            unread.append(f"lanelet {lanelet.id[:30]}: '{text[:30]}'")
    return None, unread


def statutory_speed(tags: Tags, country: str) -> float:
    """Return the limit where the map states none, by subtype, location and country, m/s."""
    town, outside, motorway = TOWN_SPEEDS.get(country, TOWN_SPEEDS[""])
    subtype = tags.get("subtype", "")
    if subtype == "play_street":
        return WALKING_PACE
    if subtype == "highway":
        return motorway
    return outside if tags.get("location", "") in ("nonurban", "rural") else town
