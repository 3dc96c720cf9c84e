"""Styles of towns and the colours of one town, drawn anew for each seed so that walls rarely repeat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ssad.core.errors import unknown_name
from ssad.rendering.street.triangles import Palette

ASPHALT = (0.088, 0.088, 0.092)  # linear RGB; towns differ a little


@dataclass(frozen=True)
class TownStyle:
    """Buildings, plants and furniture that line the streets of a kind of town.

    Attributes:
        buildings: Kind -> weight, along streets.
        back: Kind -> weight, inside blocks.
        setback: Smallest and largest distance from the sidewalk, m.
        gap: Smallest and largest distance between neighbours, m.
        earth: Name of the ground.
        trees: Number for 1,000 m^2 of open ground.
        rows: Distance between street trees, m; 0: none.
        hedges: Share of fronts with a hedge.
        fences: Share of fronts with a fence.
        lamp: Distance between lamps, m.
        yellow: Whether centre lines are yellow.
        old: Whether there are lanterns, shop fronts and paved courts.
        vacant: Share of plots left open.
        furniture: Density of street furniture.
        tree_kinds: Kinds of trees.
    """

    buildings: Mapping[str, float]
    back: Mapping[str, float]
    setback: tuple[float, float]
    gap: tuple[float, float]
    earth: str
    trees: float
    rows: float
    hedges: float
    fences: float
    lamp: float
    yellow: bool = True
    old: bool = False  # lanterns, shop fronts, paved courts
    vacant: float = 0.06  # share of plots left open
    furniture: float = 1.0
    tree_kinds: tuple[str, ...] = ("round", "tall", "birch", "conifer")


STYLES: Mapping[str, TownStyle] = {
    "town": TownStyle(
        {"terrace": 4.0, "flats": 1.5, "house": 1.2, "shop": 1.5},
        {"shed": 1.0, "house": 1.0, "flats": 0.6},
        (0.4, 3.0),
        (0.0, 2.0),
        "grass",
        1.5,
        22.0,
        0.25,
        0.25,
        26.0,
    ),
    "city": TownStyle(
        {"office": 4.0, "flats": 2.0, "shop": 1.0, "tower": 1.0},
        {"office": 1.0, "flats": 1.0, "hall": 0.6},
        (2.5, 7.0),
        (3.0, 10.0),
        "grass",
        1.0,
        15.0,
        0.15,
        0.0,
        30.0,
        furniture=1.5,
        tree_kinds=("round", "tall", "round"),
    ),
    "old": TownStyle(
        {"terrace": 6.0, "shop": 3.0, "chapel": 0.12},
        {"terrace": 1.0, "shed": 1.0},
        (0.15, 0.4),
        (0.0, 0.0),
        "cobbles",
        1.2,
        0.0,
        0.0,
        0.0,
        22.0,
        yellow=False,
        old=True,
        vacant=0.05,
        furniture=1.3,
        tree_kinds=("round", "birch"),
    ),
    "suburb": TownStyle(
        {"house": 6.0, "bungalow": 2.0, "terrace": 0.6},
        {"shed": 1.0},
        (5.0, 9.0),
        (4.0, 10.0),
        "lawn",
        1.7,
        0.0,
        0.38,
        0.3,
        34.0,
        furniture=0.5,
    ),
    "outskirts": TownStyle(
        {"hall": 3.0, "office": 1.2, "flats": 0.8, "house": 0.8},
        {"hall": 1.0, "shed": 0.6},
        (6.0, 14.0),
        (8.0, 30.0),
        "meadow",
        0.6,
        28.0,
        0.1,
        0.25,
        40.0,
        vacant=0.15,
        furniture=0.6,
    ),
}
OF_TOWN = {
    "Twinford": "town",
    "Crossgate": "city",
    "Oldmarket": "old",
    "Larkhill": "suburb",
    "ProvingGround": "outskirts",
    "Ringmere": "town",
    "Longreach": "outskirts",
    "HighSpeedTrack": "outskirts",
}


def style_of(town: str, style: str | None = None) -> str:
    """Return the name of the requested style, or of the default style of the town.

    Raises:
        UnknownNameError: There is no such style.
    """
    name = style or OF_TOWN.get(town, "town")
    if name not in STYLES:
        raise unknown_name("street style", name, STYLES)
    return name


# linear RGB of common street materials
_PLASTER = [
    (0.68, 0.65, 0.58),
    (0.60, 0.52, 0.37),
    (0.52, 0.40, 0.31),
    (0.48, 0.50, 0.48),
    (0.70, 0.69, 0.66),
    (0.57, 0.53, 0.41),
    (0.42, 0.34, 0.29),
    (0.50, 0.54, 0.56),
    (0.58, 0.47, 0.41),
    (0.44, 0.45, 0.37),
]
_BRICK = [(0.30, 0.11, 0.07), (0.36, 0.17, 0.10), (0.24, 0.10, 0.07), (0.42, 0.28, 0.17), (0.28, 0.20, 0.16)]
_BOARD = [(0.72, 0.72, 0.70), (0.32, 0.40, 0.46), (0.58, 0.54, 0.44), (0.24, 0.30, 0.24), (0.46, 0.22, 0.18)]
_CLADDING = [(0.45, 0.47, 0.50), (0.30, 0.33, 0.37), (0.62, 0.62, 0.60), (0.42, 0.38, 0.33), (0.18, 0.20, 0.23)]
_SHEET = [(0.42, 0.46, 0.50), (0.16, 0.26, 0.40), (0.50, 0.48, 0.44), (0.22, 0.32, 0.26), (0.46, 0.16, 0.12)]
_ROOF = [(0.20, 0.095, 0.062), (0.08, 0.08, 0.09), (0.14, 0.092, 0.075), (0.12, 0.125, 0.14), (0.22, 0.13, 0.09)]
_DOOR = [
    (0.05, 0.12, 0.08),
    (0.20, 0.03, 0.03),
    (0.05, 0.08, 0.18),
    (0.16, 0.09, 0.05),
    (0.60, 0.60, 0.58),
    (0.03, 0.03, 0.03),
]
_AWNING = [(0.45, 0.06, 0.05), (0.06, 0.22, 0.12), (0.08, 0.14, 0.36), (0.62, 0.48, 0.12), (0.60, 0.58, 0.54)]
_EARTH = {
    "grass": (0.10, 0.165, 0.045),
    "lawn": (0.095, 0.19, 0.045),
    "meadow": (0.17, 0.185, 0.065),
    "cobbles": (0.21, 0.195, 0.175),
}
_LEAF = {
    "round": (0.065, 0.125, 0.028),
    "tall": (0.085, 0.145, 0.035),
    "birch": (0.125, 0.18, 0.05),
    "conifer": (0.022, 0.062, 0.028),
}
_WALLS = {
    "plaster": _PLASTER,
    "brick": _BRICK,
    "boards": _BOARD,
    "cladding": _CLADDING,
    "sheet": _SHEET,
    "roof_tiles": _ROOF,
    "door": _DOOR,
    "awning": _AWNING,
}


@dataclass
class TownMaterials:
    """Materials of one town, as indices into its palette, and the generators that draw everything else.

    `generator` draws the layout: plots, buildings, furniture, places of plants. `details` draws what decorates it:
    leaves, blades of grass, curtains, goods and fields, so that more detail moves no house.
    """

    style: TownStyle
    palette: Palette
    generator: np.random.Generator
    details: np.random.Generator
    walls: dict[str, list[int]] = field(default_factory=dict)
    leaves: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # The order of the draws is part of a town's look: append new materials at the end.
        add = self.palette.add
        brightness = self.generator.uniform(0.9, 1.12)
        self.asphalt = add("asphalt", np.array(ASPHALT) * brightness, gloss=0.15)
        self.patch = add("asphalt_patch", np.array([0.055, 0.055, 0.058]) * brightness, gloss=0.2)
        self.worn_paint = add("asphalt_worn", np.array([0.097, 0.096, 0.098]) * brightness, gloss=0.12)
        self.slab = add("paving", self._jitter((0.27, 0.255, 0.235), 0.06))
        self.kerb = add("kerb", self._jitter((0.37, 0.365, 0.35), 0.04))
        self.drive = add("driveway", self._jitter((0.22, 0.20, 0.185), 0.08))
        earth_colour = self._jitter(_EARTH[self.style.earth], 0.10)
        self.earth = add(self.style.earth, earth_colour)
        self.dry = add("dry_grass", self._jitter((0.20, 0.185, 0.085), 0.08))
        self.soil = add("soil", self._jitter((0.11, 0.082, 0.055), 0.08))
        self.lawn = add("lawn", self._jitter(_EARTH["lawn"], 0.1))
        self.earth_far = add("meadow", self._jitter(_EARTH["meadow"], 0.1)) if self.style.old else self.earth
        self.hill_near = add("forest", self._jitter((0.045, 0.075, 0.035), 0.1))
        self.hill_far = add("hills", self._jitter((0.13, 0.18, 0.19), 0.06))
        self.white = add("marking_white", (0.72, 0.72, 0.70), gloss=0.25)
        self.yellow = add("marking_yellow", (0.68, 0.42, 0.04), gloss=0.25)
        self.centre = self.yellow if self.style.yellow else self.white
        self.iron = add("cast_iron", (0.045, 0.045, 0.048), gloss=0.4)
        self.metal = add("galvanised", (0.36, 0.37, 0.38), specular=0.3, gloss=0.5)
        post_colour = (0.06, 0.075, 0.07) if self.style.old else (0.30, 0.31, 0.32)
        self.pole = add("lamp_post", self._jitter(post_colour, 0.1), gloss=0.4)
        self.black = add("black_plastic", (0.02, 0.02, 0.022), gloss=0.4)
        self.glow = add("lamp_light", (0.85, 0.80, 0.68), gloss=0.5)
        # The lens of a signal is dark while it is off, so that no light from outside makes it seem lit.
        self.red = add("signal_red", (0.09, 0.007, 0.005), gloss=0.6)
        self.amber = add("signal_amber", (0.09, 0.042, 0.004), gloss=0.6)
        self.green = add("signal_green", (0.004, 0.066, 0.03), gloss=0.6)
        self.glass = [
            add("window", self._jitter(rgb, 0.3), specular=0.09, gloss=0.9)
            for rgb in ((0.035, 0.045, 0.055), (0.05, 0.055, 0.055), (0.02, 0.028, 0.036), (0.07, 0.085, 0.10))
        ]
        self.blind = [
            add("window_blind", self._jitter(rgb, 0.1), specular=0.06, gloss=0.7)
            for rgb in ((0.36, 0.34, 0.30), (0.20, 0.20, 0.19))
        ]
        self.shop = [
            add("shop_window", self._jitter(rgb, 0.3), specular=0.09, gloss=0.9)
            for rgb in ((0.10, 0.09, 0.07), (0.05, 0.06, 0.07))
        ]
        self.frame = [add("window_frame", rgb) for rgb in ((0.68, 0.68, 0.66), (0.10, 0.09, 0.08), (0.32, 0.33, 0.34))]
        self.stone = [add("stone", self._jitter(rgb, 0.08)) for rgb in ((0.46, 0.43, 0.37), (0.34, 0.33, 0.31))]
        for name, colours in _WALLS.items():
            gloss = 0.4 if name in ("cladding", "sheet", "door") else 0.1
            self.walls[name] = [add(name, self._jitter(rgb, 0.12), gloss=gloss) for rgb in colours for _ in range(2)]
        self.flat_roof = add("roofing_felt", self._jitter((0.13, 0.13, 0.13), 0.15))
        self.bark = [add("bark", rgb) for rgb in ((0.085, 0.062, 0.045), (0.45, 0.44, 0.40))]
        for kind, colour in _LEAF.items():
            self.leaves[kind] = [add(f"leaves_{kind}", self._jitter(colour, 0.22)) for _ in range(5)]
        self.hedge = [add("hedge", self._jitter((0.045, 0.095, 0.025), 0.2)) for _ in range(3)]
        self.wood = [
            add("wood", self._jitter(rgb, 0.15))
            for rgb in ((0.20, 0.13, 0.075), (0.55, 0.54, 0.50), (0.12, 0.08, 0.05))
        ]
        self.sign = {
            name: add(f"sign_{name}", rgb, gloss=0.4)
            for name, rgb in (
                ("white", (0.78, 0.78, 0.76)),
                ("red", (0.42, 0.015, 0.02)),
                ("blue", (0.01, 0.08, 0.36)),
                ("yellow", (0.75, 0.50, 0.02)),
                ("back", (0.32, 0.33, 0.34)),
            )
        }

        self._add_details()

    def _add_details(self) -> None:
        """Add the materials of curtains, goods, grass, bays and fields."""
        add, vary = self.palette.add, self._vary
        self.curtain = [
            add("window_curtain", vary(rgb, 0.12), specular=0.07, gloss=0.8)
            for rgb in ((0.34, 0.33, 0.31), (0.24, 0.20, 0.16), (0.15, 0.17, 0.20), (0.22, 0.12, 0.10))
        ]
        self.room = [
            add("window_room", vary(rgb, 0.2), specular=0.09, gloss=0.9)
            for rgb in ((0.11, 0.095, 0.075), (0.075, 0.085, 0.09), (0.13, 0.125, 0.11))
        ]
        self.goods = [
            add("shop_goods", vary(rgb, 0.2), specular=0.07, gloss=0.8)
            for rgb in (
                (0.24, 0.06, 0.05),
                (0.06, 0.10, 0.20),
                (0.26, 0.21, 0.10),
                (0.07, 0.14, 0.08),
                (0.27, 0.26, 0.24),
                (0.03, 0.03, 0.035),
            )
        ]
        self.shop_back = [
            add("shop_back", vary(rgb, 0.15), specular=0.08, gloss=0.85)
            for rgb in ((0.17, 0.155, 0.13), (0.12, 0.125, 0.13), (0.15, 0.11, 0.085))
        ]
        self.shop_light = add("shop_ceiling", (0.42, 0.40, 0.35), specular=0.08, gloss=0.8)
        earth = np.array(list(self.palette.table)[self.earth].colour)
        self.blades = [add("grass_blades", vary(factor * earth, 0.12)) for factor in (0.75, 1.0, 1.3)]
        self.bay = add("parking_bay", vary((0.125, 0.12, 0.115), 0.1))
        meadow = np.array(list(self.palette.table)[self.earth_far].colour)
        self.fields = [
            self.earth_far,
            add("field_meadow", vary(0.8 * meadow, 0.1)),
            add("field_crop", vary((0.17, 0.165, 0.06), 0.1)),
            add("field_stubble", vary((0.24, 0.20, 0.10), 0.1)),
            add("field_soil", vary((0.13, 0.10, 0.07), 0.1)),
        ]
        self.tree_line = [add("tree_line", vary(rgb, 0.15)) for rgb in ((0.05, 0.085, 0.03), (0.07, 0.10, 0.04))]

    def _vary(self, colour: npt.ArrayLike, amount: float) -> npt.NDArray[np.float64]:
        """Return the colour slightly lighter or darker, drawn with the details."""
        return np.asarray(colour, np.float64) * self.details.uniform(1 - amount, 1 + amount)

    def _jitter(self, colour: npt.ArrayLike, amount: float) -> npt.NDArray[np.float64]:
        """Return the colour slightly lighter or darker, and slightly shifted in hue."""
        brightness = self.generator.uniform(1 - amount, 1 + amount)
        return np.asarray(colour, np.float64) * brightness * self.generator.uniform(1 - amount / 3, 1 + amount / 3, 3)

    def pick(self, name: str) -> int:
        """Draw one of the wall, roof or door materials of this name."""
        return int(self.generator.choice(self.walls[name]))
