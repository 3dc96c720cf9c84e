"""Bodies of road users and street furniture: parametric meshes with named panels, by kind and style.

Sizes are (length along x, width along y, height), m. Where none is given it is drawn about the mean of the style; the
means over styles are near those of the boxes in nuScenes (Caesar et al. 2020) where it has the class.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import generator as seeded
from ssad.rendering.bodies import anomalies, cycles, furniture, heavy, machines, people, strollers
from ssad.rendering.bodies import car as _car
from ssad.rendering.meshes.mesh import Mesh, Point, Rectangle
from ssad.world.models import MODELS

DETAILS = (0, 1, 2)


@dataclass(frozen=True, slots=True)
class BodyStyle:
    """Mean size (length, width, height) m, relative spread of the size, and weight in random draws."""

    size: Point
    spread: float = 0.04
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class BodyKind:
    """Maker and styles of a kind of body.

    `phased` bodies move with a phase (rad); `driven` ones show who sits in them.
    """

    make: Callable[..., Mesh]
    styles: Mapping[str, BodyStyle]
    phased: bool = False
    driven: bool = False


def _target_style(model: str) -> BodyStyle:
    """Return the style of a test target, with the size of its model in the world; it is never drawn at random."""
    target = MODELS[model]
    return BodyStyle((target.length, target.width, target.height), 0.0, 0.0)


BODIES: dict[str, BodyKind] = {
    "car": BodyKind(
        _car.car,
        {
            "sedan": BodyStyle((4.75, 1.93, 1.47), 0.035, 3.0),
            "hatchback": BodyStyle((4.15, 1.89, 1.50), 0.04, 2.0),
            "estate": BodyStyle((4.70, 1.94, 1.52), 0.03, 1.0),
            "suv": BodyStyle((4.70, 2.00, 1.76), 0.05, 3.0),
            "van": BodyStyle((5.00, 2.08, 2.05), 0.05, 1.0),
            "pickup": BodyStyle((5.45, 2.07, 1.87), 0.04, 0.7),
            "global_vehicle_target": _target_style("euroncap_vehicle"),
        },
        driven=True,
    ),
    "truck": BodyKind(
        heavy.truck,
        {
            "box": BodyStyle((7.6, 2.52, 3.30), 0.09, 3.0),
            "flatbed": BodyStyle((7.0, 2.50, 2.80), 0.08, 1.0),
            "tractor": BodyStyle((6.2, 2.60, 3.60), 0.05, 1.0),
            "tipper": BodyStyle((7.6, 2.55, 3.15), 0.06, 1.0),
        },
        driven=True,
    ),
    "bus": BodyKind(
        heavy.bus,
        {
            "city": BodyStyle((11.3, 2.94, 3.40), 0.05, 3.0),
            "coach": BodyStyle((12.1, 2.94, 3.60), 0.04, 1.0),
            "bendy": BodyStyle((17.8, 2.94, 3.35), 0.02, 0.5),
        },
        driven=True,
    ),
    "trailer": BodyKind(
        heavy.trailer,
        {
            "box": BodyStyle((12.6, 2.65, 3.95), 0.06, 3.0),
            "flatbed": BodyStyle((12.0, 2.60, 2.60), 0.06, 1.0),
            "tank": BodyStyle((11.3, 2.55, 3.65), 0.05, 0.7),
            "utility": BodyStyle((3.6, 1.90, 1.55), 0.10, 0.6),
        },
    ),
    "construction": BodyKind(
        machines.construction,
        {
            "excavator": BodyStyle((7.2, 2.80, 3.30), 0.06),
            "wheel_loader": BodyStyle((6.5, 2.60, 3.10), 0.06),
        },
    ),
    "motorcycle": BodyKind(
        cycles.motorcycle,
        {
            "ridden": BodyStyle((2.10, 0.80, 1.62), 0.04),
            "parked": BodyStyle((2.08, 0.78, 1.22), 0.04),
            "motorcyclist_target": _target_style("euroncap_motorcycle"),
        },
    ),
    "bicycle": BodyKind(
        cycles.bicycle,
        {
            "ridden": BodyStyle((1.73, 0.60, 1.72), 0.03),
            "parked": BodyStyle((1.71, 0.60, 1.06), 0.03),
            "bicyclist_target": _target_style("euroncap_bicycle"),
        },
        phased=True,
    ),
    "pedestrian": BodyKind(
        people.pedestrian,
        {
            "adult": BodyStyle((0.76, 0.66, 1.74), 0.05, 6.0),
            "child": BodyStyle((0.55, 0.48, 1.28), 0.09, 1.0),
            "standing": BodyStyle((0.42, 0.62, 1.74), 0.05, 1.0),
            "elderly": BodyStyle((0.70, 0.66, 1.60), 0.05, 0.8),
            "worker": BodyStyle((0.44, 0.66, 1.80), 0.04, 0.4),
            "stroller": BodyStyle((0.80, 0.62, 1.70), 0.05, 0.5),
            "adult_target": _target_style("euroncap_adult"),
            "child_target": _target_style("euroncap_child"),
        },
        phased=True,
    ),
    "stroller": BodyKind(
        strollers.stroller,
        {
            "buggy": BodyStyle((0.92, 0.55, 1.02), 0.04, 3.0),
            "pram": BodyStyle((1.00, 0.58, 1.04), 0.04, 1.0),
        },
    ),
    "traffic_cone": BodyKind(
        furniture.traffic_cone,
        {
            "cone": BodyStyle((0.41, 0.41, 0.80), 0.08, 3.0),
            "tall": BodyStyle((0.36, 0.36, 1.07), 0.05, 2.0),
            "drum": BodyStyle((0.56, 0.56, 1.05), 0.04, 1.0),
        },
    ),
    "barrier": BodyKind(
        furniture.barrier,
        {
            "jersey": BodyStyle((0.60, 2.60, 0.90), 0.06, 2.0),
            "fence": BodyStyle((0.50, 2.30, 1.10), 0.04),
            "board": BodyStyle((0.50, 1.80, 1.15), 0.06),
            "water": BodyStyle((0.50, 2.20, 0.95), 0.05),
        },
    ),
    "traffic_signal": BodyKind(
        furniture.traffic_signal,
        {
            "post": BodyStyle((0.55, 0.48, 3.60), 0.02),
            "mast": BodyStyle((0.62, 5.60, 6.20), 0.03),
            "walker": BodyStyle((0.55, 0.48, 3.00), 0.02),
        },
    ),
    "street_lamp": BodyKind(
        furniture.street_lamp,
        {
            "curved": BodyStyle((2.20, 0.34, 8.50), 0.06),
            "straight": BodyStyle((1.80, 0.34, 7.50), 0.06),
        },
    ),
    "sign": BodyKind(
        furniture.sign,
        {
            "limit": BodyStyle((0.10, 0.66, 2.80), 0.02),
            "warning": BodyStyle((0.10, 0.85, 2.75), 0.02),
            "direction": BodyStyle((0.10, 1.80, 3.60), 0.02),
        },
    ),
    "stop_sign": BodyKind(
        furniture.stop_sign,
        {
            "standard": BodyStyle((0.08, 0.76, 2.86), 0.03, 4.0),
            "large": BodyStyle((0.10, 0.89, 3.02), 0.02, 1.0),
            "all_way": BodyStyle((0.08, 0.76, 2.92), 0.03, 1.5),
            "worn": BodyStyle((0.08, 0.70, 2.78), 0.06, 1.5),
        },
    ),
    "yield_sign": BodyKind(
        furniture.yield_sign,
        {
            "standard": BodyStyle((0.08, 0.90, 2.90), 0.03, 3.0),
            "worn": BodyStyle((0.08, 0.86, 2.82), 0.04, 1.0),
        },
    ),
    "limit_sign": BodyKind(
        furniture.limit_sign,
        # 600 mm in towns, 750 mm on faster roads
        {str(limit): BodyStyle((0.08, 0.60 if limit < 70 else 0.75, 2.80), 0.02) for limit in range(10, 150, 10)},
    ),
    "debris": BodyKind(
        anomalies.debris,
        {
            "tyre": BodyStyle((0.68, 0.68, 0.22), 0.05),
            "pallet": BodyStyle((1.20, 1.00, 0.145), 0.04),
            "boxes": BodyStyle((1.15, 0.80, 0.85), 0.08),
            "mattress": BodyStyle((1.95, 1.10, 0.22), 0.06),
            "ladder": BodyStyle((3.00, 0.42, 0.09), 0.12),
            "branch": BodyStyle((2.40, 1.20, 0.60), 0.12),
        },
    ),
    "animal": BodyKind(
        anomalies.animal,
        {
            "dog": BodyStyle((1.05, 0.26, 0.82), 0.08, 2.0),
            "deer": BodyStyle((1.55, 0.46, 1.55), 0.06, 2.0),
            "cow": BodyStyle((2.45, 0.72, 1.50), 0.05),
            "horse": BodyStyle((2.35, 0.56, 2.00), 0.05),
        },
    ),
    "overturned": BodyKind(
        anomalies.overturned_vehicle,
        {
            "car_side": BodyStyle((4.75, 1.47, 1.93), 0.035, 2.0),
            "suv_side": BodyStyle((4.70, 1.76, 2.00), 0.04),
            "car_roof": BodyStyle((4.15, 1.89, 1.50), 0.04),
            "truck_side": BodyStyle((7.60, 3.30, 2.52), 0.06),
        },
    ),
    "fallen_tree": BodyKind(
        anomalies.fallen_tree,
        {
            "leafy": BodyStyle((8.50, 3.80, 2.60), 0.10, 2.0),
            "bare": BodyStyle((7.50, 3.20, 2.20), 0.10),
        },
    ),
}

# common car paints, linear RGB, and rough shares of new cars
PAINTS: dict[str, tuple[float, float, float]] = {
    "white": (0.80, 0.80, 0.79),
    "pearl": (0.72, 0.70, 0.65),
    "silver": (0.46, 0.47, 0.48),
    "grey": (0.17, 0.175, 0.18),
    "graphite": (0.055, 0.058, 0.062),
    "black": (0.010, 0.010, 0.011),
    "blue": (0.015, 0.065, 0.26),
    "navy": (0.010, 0.020, 0.065),
    "sky": (0.14, 0.30, 0.46),
    "red": (0.38, 0.012, 0.015),
    "maroon": (0.11, 0.010, 0.014),
    "green": (0.012, 0.075, 0.038),
    "olive": (0.085, 0.090, 0.045),
    "beige": (0.42, 0.36, 0.26),
    "brown": (0.085, 0.045, 0.025),
    "orange": (0.62, 0.15, 0.012),
    "yellow": (0.72, 0.46, 0.02),
    "teal": (0.01, 0.12, 0.14),
}
PAINT_SHARES: dict[str, float] = {
    "white": 0.27,
    "pearl": 0.04,
    "silver": 0.11,
    "grey": 0.14,
    "graphite": 0.08,
    "black": 0.16,
    "blue": 0.07,
    "navy": 0.03,
    "sky": 0.01,
    "red": 0.045,
    "maroon": 0.01,
    "green": 0.01,
    "olive": 0.005,
    "beige": 0.01,
    "brown": 0.01,
    "orange": 0.007,
    "yellow": 0.006,
    "teal": 0.007,
}


def draw_paint(generator: np.random.Generator) -> tuple[float, float, float]:
    """Draw a car paint (linear RGB) with the frequency of new cars and a small shift of its brightness."""
    shares = np.array([PAINT_SHARES[name] for name in PAINTS])
    red, green, blue = list(PAINTS.values())[int(generator.choice(len(shares), p=shares / shares.sum()))]
    brightness = float(generator.uniform(0.9, 1.1))
    return red * brightness, green * brightness, blue * brightness


def draw_style(kind: str, *, generator: np.random.Generator) -> str:
    """Draw a style of a kind, by the weights of its styles.

    Raises:
        UnknownNameError: There is no such kind.
    """
    styles = _body(kind).styles
    weights = np.array([body_style.weight for body_style in styles.values()])
    return list(styles)[int(generator.choice(len(weights), p=weights / weights.sum()))]


def draw_size(kind: str, style: str, *, generator: np.random.Generator) -> Point:
    """Draw a size (length, width, height, m) of a style: normal around its mean, truncated at two standard deviations.

    Raises:
        UnknownNameError: There is no such kind or style.
    """
    body_style = _style(kind, style)
    scale = 1.0 + body_style.spread * np.clip(generator.normal(size=3), -2.0, 2.0) * [1.0, 0.5, 0.7]
    length, width, height = (float(extent) for extent in np.asarray(body_style.size) * scale)
    return (length, length, height) if kind == "traffic_cone" else (length, width, height)


def make_body(
    kind: str,
    *,
    style: str | None = None,
    size: Point | None = None,
    generator: np.random.Generator,
    detail: int = 2,
    phase: float | None = None,
    has_driver: bool = True,
) -> Mesh:
    """Make the mesh of a kind of road user or furniture (see `BODIES`), base centred on the origin, x forward.

    The mesh fills its size exactly; a walker fills it over the whole walking cycle. A panel has the same place
    in the texture atlas in every body of a style, whatever its size and detail. The generator always yields the
    same number of draws for a style.

    Args:
        kind: Name of the kind.
        style: Name of the style; None: drawn.
        size: Length, width and height, m; None: drawn.
        generator: Source of randomness.
        detail: 2 is full, 0 is for far away; draws and size do not depend on it.
        phase: Place in the cycle of a walker, or angle of a bicycle's crank, rad.
        has_driver: Whether somebody sits in a car, truck or bus; draws do not depend on it.

    Returns:
        The mesh.

    Raises:
        UnknownNameError: There is no such kind or style.
        ConfigError: The size is not three lengths in [0.01, 100] m, or there is no such detail.
    """
    body = _body(kind)
    # Drawn even if given, so that the generator advances equally in both cases.
    random_style = draw_style(kind, generator=generator)
    style_name = random_style if style is None else style
    _style(kind, style_name)
    random_size = draw_size(kind, style_name, generator=generator)
    full_size = random_size if size is None else size
    lengths = np.asarray(full_size, np.float64)
    if lengths.shape != (3,) or not ((lengths >= 0.01) & (lengths <= 100.0)).all():
        raise ConfigError(f"{kind}: size {full_size} is not three lengths in [0.01, 100] m")
    if detail not in DETAILS:
        raise ConfigError(f"{kind}: detail {detail} is not one of 0, 1, 2")
    options: dict[str, object] = {"phase": phase} if body.phased else {}
    if body.driven:
        options["has_driver"] = has_driver
    length, width, height = (float(extent) for extent in lengths)
    mesh = body.make(style_name, (length, width, height), generator=generator, detail=detail, **options)
    return _in_atlas(mesh, _atlas(kind, style_name))


@lru_cache
def _atlas(kind: str, style: str) -> Mapping[str, Rectangle]:
    """Return the rectangle of each panel of a style.

    It is that of the mean size, so that one texture fits every size.
    """
    body = BODIES[kind]
    mean_body = body.make(style, body.styles[style].size, generator=seeded("atlas", kind, style), detail=0)
    return dict(zip(mean_body.panels, mean_body.rectangles, strict=True))


def _in_atlas(mesh: Mesh, atlas: Mapping[str, Rectangle]) -> Mesh:
    """Move and stretch each panel into its rectangle of the atlas, parts of one panel together."""
    uv = mesh.uv.astype(np.float64)
    panel_names = [name.split("/")[0] for name in mesh.panels]
    targets = tuple(atlas[name] for name in mesh.panels)
    for panel in set(panel_names):
        part_indices = [index for index, name in enumerate(panel_names) if name == panel]
        part_rectangles, atlas_rectangles = (
            np.array([table[index] for index in part_indices]) for table in (mesh.rectangles, targets)
        )
        (lower, upper), (atlas_lower, atlas_upper) = (
            (rectangles[:, :2].min(0), rectangles[:, 2:].max(0)) for rectangles in (part_rectangles, atlas_rectangles)
        )
        faces = np.isin(mesh.panel, part_indices)
        uv[faces] = atlas_lower + (uv[faces] - lower) / np.maximum(upper - lower, 1e-9) * (atlas_upper - atlas_lower)
    return replace(mesh, uv=np.clip(uv, 0.0, 1.0).astype(np.float32), rectangles=targets)


def _body(kind: str) -> BodyKind:
    if kind not in BODIES:
        raise unknown_name("body", kind, BODIES)
    return BODIES[kind]


def _style(kind: str, style: str) -> BodyStyle:
    styles = _body(kind).styles
    if style not in styles:
        raise unknown_name(f"{kind} style", style, styles)
    return styles[style]
