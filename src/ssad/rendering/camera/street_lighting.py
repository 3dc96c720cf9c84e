"""Street lighting at night by class: luminaires whose mean light on the carriageway is that of EN 13201-2.

Class P of residential streets states the mean illuminance. Class M of traffic roads states the mean luminance; a road
of standard asphalt (class R3 of CIE 144, with a mean luminance coefficient of 0.07 cd/m^2 for 1 lux) needs about 14
lux for 1 cd/m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssad.core.errors import unknown_name
from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.rendering.street.model import Street
from ssad.rendering.street.palette import STYLES

UNLIT: Final = "unlit"
UNLIT_LUX: Final = 1.0  # lux of a road without street lighting, the limit that night test protocols set
LUMINANCE_COEFFICIENT: Final = 0.07  # cd/m^2 for 1 lux, asphalt of class R3
# class -> mean luminance of the road, cd/m^2, and mean illuminance, lux (EN 13201-2:2015, tables 1 and 3)
LUMINANCE: Final = {"M1": 2.0, "M2": 1.5, "M3": 1.0, "M4": 0.75, "M5": 0.5, "M6": 0.3}
ILLUMINANCE: Final = {"P1": 15.0, "P2": 10.0, "P3": 7.5, "P4": 5.0, "P5": 3.0, "P6": 2.0}
LIGHTING_CLASSES: Final = (*LUMINANCE, *ILLUMINANCE, UNLIT)
DEFAULT_CLASS: Final = "M4"  # of main streets in towns

SPREAD: Final = (2.0, 3.8)  # tangents of the half angles across and along the road
SOFT: Final = 0.9
REACH: Final = 60.0  # m
SAMPLES: Final = 3000  # points on the asphalt of a town
BEHIND, BEFORE = 4.0, 12.0  # m from a luminaire, away from the road and across it: the road that it lights


def check_lighting(name: str) -> None:
    """Check the name of a class of street lighting; "" stands for lamps that meet no class.

    Raises:
        UnknownNameError: There is no such class.
    """
    if name and name not in LIGHTING_CLASSES:
        raise unknown_name("street lighting", name, LIGHTING_CLASSES)


def road_illuminance(name: str) -> float:
    """Return the mean illuminance of the road under a class of street lighting, lux.

    Raises:
        UnknownNameError: There is no such class.
    """
    check_lighting(name)
    if name in LUMINANCE:
        return LUMINANCE[name] / LUMINANCE_COEFFICIENT
    return UNLIT_LUX if name == UNLIT else ILLUMINANCE[name]


@dataclass(frozen=True, slots=True)
class RoadSamples:
    """Points on the carriageway that luminaires light.

    Attributes:
        points: [N, 3], m.
        gaps: Vectors from each luminaire to each point in its own frame: across and along the road, and down
            [N, M, 3], m.
    """

    points: F64
    gaps: F64


def sample_road(street: Street, *, count: int = SAMPLES) -> RoadSamples:
    """Draw points evenly from the carriageway between the luminaires of a street.

    The field of calculation of EN 13201-3 lies between two luminaires of a row, over the width of the carriageway. A
    point belongs to it if it is at most half the spacing from its nearest luminaire along the road.

    Args:
        street: Street with at least one luminaire.
        count: Points that are drawn from all asphalt; those far from luminaires are left out.
    """
    is_asphalt = np.array([material.name.startswith("asphalt") for material in street.materials])[street.material]
    near_faces = np.unique(street.order[: street.offset[0, -2]])
    triangles = street.vertices[street.faces[near_faces[is_asphalt[near_faces]]]].astype(np.float64)
    areas = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    random_draws = generator("street lighting", street.name, street.style)
    drawn_triangles = triangles[random_draws.choice(len(areas), count, p=areas / areas.sum())]
    first_share, second_share = random_draws.random((2, count, 1))
    # A point in the other half of the parallelogram is mirrored into the triangle.
    first_share, second_share = np.where(
        first_share + second_share > 1.0, (1.0 - first_share, 1.0 - second_share), (first_share, second_share)
    )
    points = (
        drawn_triangles[:, 0]
        + first_share * (drawn_triangles[:, 1] - drawn_triangles[:, 0])
        + second_share * (drawn_triangles[:, 2] - drawn_triangles[:, 0])
    )
    lamps = street.lamps.astype(np.float64)
    offsets = points[:, None] - lamps[None, :, :3]
    cosine, sine = np.cos(lamps[:, 3]), np.sin(lamps[:, 3])
    across = offsets[..., 0] * cosine + offsets[..., 1] * sine
    along = offsets[..., 1] * cosine - offsets[..., 0] * sine
    gaps = np.stack([across, along, -offsets[..., 2]], -1)
    nearest_gaps = gaps[np.arange(count), np.hypot(across, along).argmin(1)]
    is_lit = np.abs(nearest_gaps[:, 1]) <= 0.5 * STYLES[street.style].lamp
    is_lit &= (nearest_gaps[:, 0] > -BEHIND) & (nearest_gaps[:, 0] < BEFORE)
    return RoadSamples(points[is_lit], gaps[is_lit])


def unit_illuminance(samples: RoadSamples) -> F64:
    """Return the irradiance over pi [N] that luminaires of power 1 give to points of a road, as the kernels have it."""
    across, along, down = np.moveaxis(samples.gaps, -1, 0)
    height = np.maximum(down, 1e-3)
    squared_radius = (across / SPREAD[0] / height) ** 2 + (along / SPREAD[1] / height) ** 2
    inner_squared = (1.0 - SOFT) ** 2
    weight = np.clip((1.0 - squared_radius) / (1.0 - inner_squared), 0.0, 1.0) * (down > 0.02)
    squared_distance = across**2 + along**2 + height**2
    weight *= np.clip(3.0 * (1.0 - np.sqrt(squared_distance) / REACH), 0.0, 1.0)
    area = np.pi * SPREAD[0] * SPREAD[1] * (1.0 + inner_squared) / 2.0
    # A lamp lights a level plane evenly: the cubes of secant and cosine cancel.
    return np.asarray((weight / height**2).sum(1) / area, np.float64)


def luminaire_power(street: Street, name: str, lux: float) -> float:
    """Return the power of each luminaire of a street that gives its carriageway the mean illuminance of a class.

    Args:
        street: The street. Without luminaires, or asphalt near them, the power is 0.
        name: Class of street lighting.
        lux: Irradiance over pi of one lux.
    """
    if name == UNLIT or not len(street.lamps):
        return 0.0
    samples = sample_road(street)
    mean_illuminance = float(unit_illuminance(samples).mean()) if len(samples.points) else 0.0
    return road_illuminance(name) * lux / mean_illuminance if mean_illuminance > 0.0 else 0.0
