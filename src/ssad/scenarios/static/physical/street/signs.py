"""Removal and change of signs, and light on signal heads: sensors see the change, and the map keeps its rules."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, Episode
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.bodies.sign_stickers import apply_sticker, cover_sign
from ssad.rendering.camera.lamps import AHEAD, SceneLamp
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.street import cached_street
from ssad.rendering.street_edit import StreetEdit
from ssad.rendering.street_signs import KINDS, LIMIT_SIGN, limit_signs_of_route
from ssad.scenarios.static.perturbation import EGO, Perturbation

if TYPE_CHECKING:
    from ssad.rendering.sensor_suite import SensorSuite

NOTHING: Final = "nothing"
COVER: Final = "cover"
STICKER: Final = "sticker-"  # then the first figure that it shows, or one of `CONTROLS`
CONTROLS: Final = ("blank", "blocks")
SIGNS: Final = {"stop": "stop_sign", "yield": "yield_sign"}
LIMIT: Final = "limit"
FIGURES: Final = tuple(BODIES[LIMIT_SIGN].styles)
ROUTE_DISTANCE: Final = 25.0  # m from a route within which a sign or signal head belongs to it
HEAD_LUMENS: Final = (30.0, 100.0, 300.0, 1000.0, 3000.0)  # by severity
HEAD_LIGHTS: Final = {"red": (1.0, 0.03, 0.02), "green": (0.03, 1.0, 0.25), "white": (1.0, 0.98, 0.95)}
HEAD_SIZE: Final = (0.3, 0.9)  # m, width and height that the light covers


@dataclass(frozen=True)
class SignChange(Perturbation):
    """Change of the signs of a town: they are removed, covered, exchanged, or wear a sticker.

    A sticker lies on the first figure of a speed-limit sign, as in attacks that make a 3 an 8. Its controls are
    stickers of the same size in the same place that show no figure: "blank" is white, "blocks" are random black and
    white blocks.

    Attributes:
        sign: Signs that change: stop, yield, limit, or limit-30 for speed-limit signs of 30 km/h alone.
        into: Sign that stands in their place: stop, yield, or limit-80; "nothing": they are removed; "cover": a grey
            plate covers them; "sticker-8": a sticker with this figure on the first figure of speed-limit signs;
            "sticker-blank" and "sticker-blocks": its controls.

    Raises:
        ConfigError: A sign is unknown, would stay the same, or has no figure for a sticker.
    """

    sign: str = "yield"
    into: str = NOTHING
    severity: int = field(default=1, init=False)
    family: str = field(default="sign", init=False)

    def __post_init__(self) -> None:
        signs = (*SIGNS, LIMIT, *(f"{LIMIT}-{figures}" for figures in FIGURES))
        stickers = [f"{STICKER}{name}" for name in (*"123456789", *CONTROLS)]
        choices = [*(name for name in signs if name != LIMIT), NOTHING, COVER, *stickers]
        if self.sign not in signs:
            raise unknown_name("sign", self.sign, signs)
        if self.into not in choices:
            raise unknown_name("sign", self.into, choices)
        if self.into.startswith(STICKER) and not self._is_limit:
            raise ConfigError(f"sign-change: {self.sign} has no figure for {self.into}; choose sign: limit")
        if self.into == self.sign or (self._is_limit and not self._changed_figures()):
            raise ConfigError(f"sign-change: {self.sign} into {self.into} changes nothing; choose another `into`")

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        if self.into == NOTHING:
            return f"{self.sign}-sign-gone"
        return f"{self.sign}-sign-{self.into if self._is_marked else f'into-{self.into}'}"

    @property
    def needs_place(self) -> bool:
        """True: a sign must stand beside the route."""
        return True

    @property
    def _is_limit(self) -> bool:
        return self.sign.startswith(LIMIT)

    @property
    def _is_marked(self) -> bool:
        """True if the signs stay, with a cover or a sticker on them."""
        return self.into == COVER or self.into.startswith(STICKER)

    def _changed_figures(self) -> list[str]:
        """Return the figures of the speed-limit signs that change."""
        figures = FIGURES if self.sign == LIMIT else (self.sign.partition("-")[2],)
        same = self.into.removeprefix(f"{LIMIT}-")
        first = self.into.removeprefix(STICKER)
        return [entry for entry in figures if entry != same and entry[0] != first]

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if such a sign stands beside its route."""
        route = episode.agents[EGO].route
        if route is None:
            return None
        points = route.xy.astype(np.float64)
        if self._is_limit:
            signs = limit_signs_of_route(cached_street(town).limit_signs, points, within=ROUTE_DISTANCE)
            return EGO if np.isin(signs[:, 1], [float(figures) for figures in self._changed_figures()]).any() else None
        kinds = {name: number for number, name in KINDS.items()}
        places = town.sign_xy[town.sign_kind == kinds[SIGNS[self.sign]]].astype(np.float64).reshape(-1, 2)
        return EGO if near_route(points, places) else None

    def bodies(self) -> dict[str, Mesh | None]:
        """Return the body in place of each kind of sign that changes, see `StreetEdit.signs`; None removes it."""
        if not self._is_limit:
            kind = SIGNS[self.sign]
            return {kind: self._body(kind, "standard")}
        return {f"{LIMIT_SIGN}:{figures}": self._body(LIMIT_SIGN, figures) for figures in self._changed_figures()}

    def _body(self, kind: str, style: str) -> Mesh | None:
        """Return the body in place of a sign of a kind and style."""
        if self.into == NOTHING:
            return None
        if self._is_marked:
            sign_body, size = _standard_body(kind, style), BODIES[kind].styles[style].size
            if self.into == COVER:
                return cover_sign(sign_body, size)
            return apply_sticker(sign_body, size, style, self.into.removeprefix(STICKER))
        if self.into in SIGNS:
            return _standard_body(SIGNS[self.into], "standard")
        return _standard_body(LIMIT_SIGN, self.into.partition("-")[2])

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite whose cameras and LiDARs see the changed signs."""
        return suite.with_street_edit(StreetEdit(signs=self.bodies()))


def _standard_body(kind: str, style: str) -> Mesh:
    size = BODIES[kind].styles[style].size
    return make_body(kind, style=style, size=size, generator=generator("changed sign", kind))


@dataclass(frozen=True)
class HeadLight(Perturbation):
    """Light on the signal heads: dark lenses seem lit, and lit ones lose their contrast.

    The light of a lamp in front of a head adds to that of its lenses, as the low sun does (sun phantom effect).

    Attributes:
        colour: red, green or white.
        distance: m from a head to its lamp.
        lumens: Luminous flux of each lamp; None: by severity.
        severity: 1 to 5, the luminous flux.

    Raises:
        ConfigError: A colour is unknown, or a number out of its range.
    """

    colour: str = "green"
    distance: float = 15.0
    lumens: float | None = None
    severity: int = 3
    family: str = field(default="light", init=False)

    def __post_init__(self) -> None:
        if self.colour not in HEAD_LIGHTS:
            raise unknown_name("colour", self.colour, HEAD_LIGHTS)
        flux = HEAD_LUMENS[0] if self.lumens is None else self.lumens
        if self.severity not in range(1, 6) or not 1.0 <= self.distance <= 60.0 or not 0.0 <= flux <= 1e6:
            raise ConfigError(
                f"head-light: severity {self.severity}, distance {self.distance:g} m, {flux:g} lumens; give 1 to 5, "
                "1 to 60 m and 0 to 1e6 lumens"
            )

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        settings = [f"distance={self.distance:g}"] if self.distance != 15.0 else []
        settings += [] if self.lumens is None else [f"lumens={self.lumens:g}"]
        return f"head-light-{self.colour}{'?' if settings else ''}{'&'.join(settings)}"

    @property
    def needs_place(self) -> bool:
        """True: a signal must stand beside the route."""
        return True

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if a signal stands beside its route."""
        route = episode.agents[EGO].route
        places = town.signal_xy[~town.signal_virtual].astype(np.float64).reshape(-1, 2)
        return EGO if route is not None and near_route(route.xy.astype(np.float64), places) else None

    def lamp(self) -> SceneLamp:
        """Return the lamp in the frame of a head (x away from its face), power in lumen."""
        flux = HEAD_LUMENS[self.severity - 1] if self.lumens is None else self.lumens
        spread = (0.5 * HEAD_SIZE[0] / self.distance, 0.5 * HEAD_SIZE[1] / self.distance)
        pose = upright_pose(self.distance, 0.0, np.pi) @ AHEAD
        return SceneLamp(pose, flux, spread, HEAD_LIGHTS[self.colour], square=True, shadows=False)

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with a lamp on every signal head."""
        return suite.with_street_edit(StreetEdit(head_lamps=(self.lamp(),)))


def near_route(route: F64, places: F64) -> bool:
    """Return True if any of the places [M, 2] lies within `ROUTE_DISTANCE` of a route [N, 2]."""
    if not len(places):
        return False
    return bool((np.hypot(*np.moveaxis(places[:, None] - route[None], -1, 0)).min(1) < ROUTE_DISTANCE).any())
