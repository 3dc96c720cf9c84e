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
from ssad.rendering.camera.lamps import AHEAD, SceneLamp
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.street_edit import StreetEdit
from ssad.rendering.street_signs import KINDS
from ssad.scenarios.static.perturbation import EGO, Perturbation

if TYPE_CHECKING:
    from ssad.rendering.sensor_suite import SensorSuite

NOTHING: Final = "nothing"
SIGNS: Final = {"stop": "stop_sign", "yield": "yield_sign"}
ROUTE_DISTANCE: Final = 25.0  # m from a route within which a sign or signal head belongs to it
HEAD_LUMENS: Final = (30.0, 100.0, 300.0, 1000.0, 3000.0)  # by severity
HEAD_LIGHTS: Final = {"red": (1.0, 0.03, 0.02), "green": (0.03, 1.0, 0.25), "white": (1.0, 0.98, 0.95)}
HEAD_SIZE: Final = (0.3, 0.9)  # m, width and height that the light covers


@dataclass(frozen=True)
class SignChange(Perturbation):
    """Change of the signs of a town: they are removed, or become signs of another kind.

    Attributes:
        sign: Signs that change: stop or yield.
        into: Sign that stands in their place: stop, yield, or "nothing".

    Raises:
        ConfigError: A sign is unknown, or would stay the same.
    """

    sign: str = "yield"
    into: str = NOTHING
    severity: int = field(default=1, init=False)
    family: str = field(default="sign", init=False)

    def __post_init__(self) -> None:
        if self.sign not in SIGNS:
            raise unknown_name("sign", self.sign, SIGNS)
        if self.into not in (*SIGNS, NOTHING):
            raise unknown_name("sign", self.into, (*SIGNS, NOTHING))
        if self.into == self.sign:
            raise ConfigError(f"sign-change: {self.sign} into {self.into} changes nothing; choose another `into`")

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        return f"{self.sign}-sign-gone" if self.into == NOTHING else f"{self.sign}-sign-into-{self.into}"

    @property
    def needs_place(self) -> bool:
        """True: a sign must stand beside the route."""
        return True

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if such a sign stands beside its route."""
        route = episode.agents[EGO].route
        kinds = {name: number for number, name in KINDS.items()}
        places = town.sign_xy[town.sign_kind == kinds[SIGNS[self.sign]]].astype(np.float64).reshape(-1, 2)
        return EGO if route is not None and near_route(route.xy.astype(np.float64), places) else None

    def body(self) -> Mesh | None:
        """Return the sign that stands in place of each; None if they are removed."""
        if self.into == NOTHING:
            return None
        kind = SIGNS[self.into]
        size = BODIES[kind].styles["standard"].size
        return make_body(kind, style="standard", size=size, generator=generator("changed sign", kind))

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite whose cameras and LiDARs see the changed signs."""
        return suite.with_street_edit(StreetEdit(signs={SIGNS[self.sign]: self.body()}))


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
