"""The target of attacks, a car or a stop sign, named once: the same metal in every town and clip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ssad.assets.bodies import BODIES, PAINTS, make_body
from ssad.assets.mesh import Mesh, Point
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import generator


@dataclass(frozen=True, slots=True)
class TargetCar:
    """A car that is the same wherever it is made.

    Attributes:
        style: Body style, see `ssad.assets.bodies.BODIES`.
        paint: Name of its paint, see `ssad.assets.bodies.PAINTS`.
        size: Length, width, height, m; the mean of the style where None.
        seed: Of what else differs between cars of a style.
    """

    style: str = "sedan"
    paint: str = "silver"
    size: Point | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        styles = BODIES["car"].styles
        if self.style not in styles:
            raise unknown_name("car style", self.style, styles)
        if self.paint not in PAINTS:
            raise unknown_name("paint", self.paint, PAINTS)

    @property
    def full_size(self) -> Point:
        """Length, width, height, m."""
        return self.size or BODIES["car"].styles[self.style].size

    @property
    def colour(self) -> tuple[float, float, float]:
        """Linear RGB of its paint."""
        return PAINTS[self.paint]

    def mesh(self) -> Mesh:
        """Its body."""
        draws = generator("target car", self.style, self.seed)
        return make_body("car", style=self.style, size=self.full_size, generator=draws)


@dataclass(frozen=True, slots=True)
class TargetSign:
    """A stop sign that is the same wherever it is made.

    Attributes:
        style: Body style, see `ssad.assets.bodies.BODIES`.
        size: Length, width, height, m; the mean of the style where None.
        seed: Of what else differs between signs of a style.
        kind: Of its body.
    """

    style: str = "standard"
    size: Point | None = None
    seed: int = 0
    kind: Literal["stop_sign"] = "stop_sign"

    def __post_init__(self) -> None:
        styles = BODIES[self.kind].styles
        if self.style not in styles:
            raise unknown_name(f"{self.kind} style", self.style, styles)

    @property
    def full_size(self) -> Point:
        """Length, width, height, m."""
        return self.size or BODIES[self.kind].styles[self.style].size

    def mesh(self) -> Mesh:
        """Its body, plate and post."""
        draws = generator("target sign", self.style, self.seed)
        return make_body(self.kind, style=self.style, size=self.full_size, generator=draws)


def parse_target(text: str) -> TargetCar | TargetSign:
    """STYLE[:PAINT[:SEED]] of a car or stop_sign[:STYLE[:SEED]] as a target. ConfigError."""
    if text.partition(":")[0] == "stop_sign":
        _, style, seed = [*text.split(":"), "", ""][:3]
        if text.count(":") > 2 or (seed and not seed.isdigit()):
            raise ConfigError(f"--target {text}: expected stop_sign, stop_sign:STYLE or stop_sign:STYLE:SEED")
        return TargetSign(style or TargetSign().style, seed=int(seed or 0))
    style, paint, seed = [*text.split(":"), "", "", ""][:3]
    if text.count(":") > 2 or (seed and not seed.isdigit()):
        raise ConfigError(f"--target {text}: expected STYLE, STYLE:PAINT or STYLE:PAINT:SEED, such as sedan:silver:0")
    if style not in BODIES["car"].styles:
        raise unknown_name("target", style, (*BODIES["car"].styles, TargetSign().kind))
    return TargetCar(style, paint or TargetCar().paint, seed=int(seed or 0))
