"""Target of attacks: a car, a stop sign or a walker, defined once, with the same mesh in every town and recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, PAINTS, make_body
from ssad.rendering.meshes.mesh import Mesh, Point


@lru_cache(maxsize=16)
def _mesh(kind: str, style: str, size: Point, key: str, seed: int) -> Mesh:
    # A suite asks for the same body dozens of times.
    return make_body(kind, style=style, size=size, generator=generator(key, style, seed))


@dataclass(frozen=True, slots=True)
class TargetCar:
    """Car with the same mesh in every recording.

    Attributes:
        style: Body style, see `ssad.rendering.bodies.BODIES`.
        paint: Name of its paint, see `ssad.rendering.bodies.PAINTS`.
        size: Length, width, height, m; the mean of the style if None.
        seed: Seed of all other differences between cars of a style.
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
        """Return its body, which all who ask share."""
        return _mesh("car", self.style, self.full_size, "target car", self.seed)


@dataclass(frozen=True, slots=True)
class _StandingTarget:
    """Target other than a car, with the same mesh in every recording.

    Attributes:
        style: Body style, see `ssad.rendering.bodies.BODIES`.
        size: Length, width, height, m; the mean of the style if None.
        seed: Seed of all other differences between bodies of a style.
        kind: Kind of its body.
    """

    style: str
    size: Point | None = None
    seed: int = 0
    kind: str = ""

    def __post_init__(self) -> None:
        styles = BODIES[self.kind].styles
        if self.style not in styles:
            raise unknown_name(f"{self.kind} style", self.style, styles)

    @property
    def full_size(self) -> Point:
        """Length, width, height, m."""
        return self.size or BODIES[self.kind].styles[self.style].size

    @property
    def colour(self) -> tuple[float, float, float]:
        """Linear RGB: grey, since these bodies have no paint."""
        return (0.5, 0.5, 0.5)

    def mesh(self) -> Mesh:
        """Return its body, which all who ask share; that of a sign has plate and post."""
        noun = "sign" if self.kind == "stop_sign" else self.kind
        return _mesh(self.kind, self.style, self.full_size, f"target {noun}", self.seed)


@dataclass(frozen=True, slots=True)
class TargetSign(_StandingTarget):
    """Stop sign with the same mesh in every recording."""

    style: str = "standard"
    kind: str = field(default="stop_sign", init=False)


@dataclass(frozen=True, slots=True)
class TargetWalker(_StandingTarget):
    """Person on foot with the same mesh in every recording; the shirt is the panels torso_front and torso_back."""

    style: str = "standing"
    kind: str = field(default="pedestrian", init=False)


Target = TargetCar | TargetSign | TargetWalker
STANDING: dict[str, type[TargetSign] | type[TargetWalker]] = {"stop_sign": TargetSign, "pedestrian": TargetWalker}


def class_of_target(target: Target) -> str:
    """Return the class of detectors that finds a target."""
    return "car" if isinstance(target, TargetCar) else target.kind


def parse_target(text: str) -> Target:
    """Parse STYLE[:PAINT[:SEED]] of a car, stop_sign[:STYLE[:SEED]] or pedestrian[:STYLE[:SEED]].

    Raises:
        ConfigError: The text has another form, or names an unknown style or paint.
    """
    kind = text.partition(":")[0]
    if kind in STANDING:
        # Padded, so that missing fields become empty and take their defaults.
        _, style, seed = [*text.split(":"), "", ""][:3]
        if text.count(":") > 2 or (seed and not seed.isdigit()):
            raise ConfigError(f"--target {text}: expected {kind}, {kind}:STYLE or {kind}:STYLE:SEED")
        target_class = STANDING[kind]
        return target_class(style or target_class().style, seed=int(seed or 0))
    style, paint, seed = [*text.split(":"), "", "", ""][:3]
    if text.count(":") > 2 or (seed and not seed.isdigit()):
        raise ConfigError(f"--target {text}: expected STYLE, STYLE:PAINT or STYLE:PAINT:SEED, such as sedan:silver:0")
    if style not in BODIES["car"].styles:
        raise unknown_name("target", style, (*BODIES["car"].styles, *STANDING))
    return TargetCar(style, paint or TargetCar().paint, seed=int(seed or 0))
