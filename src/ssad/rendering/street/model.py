"""Static geometry of a town for the camera: triangles, materials, tiles with levels of detail, masts.

Shape letters: V vertices, F faces, M masts, H signal heads. World frame, metres, radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import FormatError
from ssad.core.safeio import load_npz, save_npz
from ssad.core.types import array_dtypes
from ssad.rendering.meshes.mesh import F32, I32, Material

FORMAT = 3  # of the .npz file
TILE = 32.0  # m
LEVELS = 3
NEAR, MID, FAR = 1, 2, 4  # bits of the levels at which a face is drawn
REACH = (64.0, 180.0)  # m from the eye up to which tiles are drawn at level 0 and 1


@dataclass(frozen=True)
class Street:
    """Triangles of a town. Arrays are read-only.

    Tiles are squares of `tile` m: tile iy * nx + ix begins at `origin` + tile * (ix, iy). Level k (0 full, 1 without
    small things, 2 boxes and crowns) of tile t draws the faces order[offset[k, t] : offset[k, t + 1]]; those of the
    last tile, nx * ny, are far ground and hills, which belong to every view at every level. A thing is wholly in the
    tile of its middle. Ground shared by levels is listed in each.

    Attributes:
        name: Name of the town.
        style: Name of its style.
        vertices: [V, 3], m.
        faces: Counter-clockwise seen from outside [F, 3].
        normals: Unit vectors, one for each corner [F, 3, 3].
        uv: Metres on the surface [F, 3, 2]: x and y of the world on the ground; on walls u runs right and v up from the
            ground.
        material: Index into `materials` [F].
        materials: All materials.
        tile: Side of a tile, m.
        origin: x, y of the first tile, m.
        nx: Number of tiles along x.
        ny: Number of tiles along y.
        order: See above.
        offset: See above.
        lamps: x, y, z of a street lamp's light, and its heading from the post to the road [M, 4].
        heads: x, y, z of the middle of a signal head, and the heading that it faces [H, 4].
        head_signal: Signal of each head in the lane graph [H].
        head_lens: First face and end of the faces of its red, amber and green lens [H, 3, 2].
        parking: x, y, yaw of places for parked cars, off the road [., 3].
        bays: Places in parking bays at the kerb [., 5]: x, y of the side towards the road and yaw of the traffic; depth
            of the bay; room to either end of the bay, m.
        yards: Places of long vehicles in yards behind the pavement [., 5], with the columns of `bays`; room to either
            end of the place.
        limit_signs: Speed-limit signs [., 5]: x, y and yaw of the traffic; z of the foot, m; limit, km/h.
    """

    name: str
    style: str
    vertices: F32
    faces: I32
    normals: F32
    uv: F32
    material: I32
    materials: tuple[Material, ...]
    tile: float
    origin: tuple[float, float]
    nx: int
    ny: int
    order: I32
    offset: I32
    lamps: F32
    heads: F32
    head_signal: I32
    head_lens: I32
    parking: F32
    bays: F32 = field(default_factory=lambda: np.zeros((0, 5), np.float32))
    yards: F32 = field(default_factory=lambda: np.zeros((0, 5), np.float32))
    limit_signs: F32 = field(default_factory=lambda: np.zeros((0, 5), np.float32))

    def __post_init__(self) -> None:
        # Streets are cached and shared between scenes, so their arrays must not change.
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def tile_faces(self, tile: int, level: int = 0) -> I32:
        """Return the faces of one tile at one level (0 full, 2 coarsest)."""
        return self.order[self.offset[level, tile] : self.offset[level, tile + 1]]

    def select(
        self, viewpoint: tuple[float, float], *, max_distance: float = 500.0, reach: tuple[float, float] = REACH
    ) -> I32:
        """Return the faces that a camera at x, y needs.

        Near tiles come at level 0, then 1, then 2 up to `max_distance` m; the horizon is always included. The distance
        of a tile is that of its nearest point.
        """
        selections = [self.tile_faces(self.nx * self.ny)]
        for tile_index, distance in enumerate(self._away(viewpoint)):
            if distance <= max_distance:
                selections.append(
                    self.tile_faces(tile_index, 0 if distance <= reach[0] else 1 if distance <= reach[1] else 2)
                )
        return np.concatenate(selections)

    def _away(self, viewpoint: tuple[float, float]) -> npt.NDArray[np.float64]:
        """Return the distance [nx * ny] of each tile from a point, m."""
        axis_gaps = []
        for axis, count in ((0, self.nx), (1, self.ny)):
            lower_edges = self.origin[axis] + self.tile * np.arange(count)
            axis_gaps.append(
                np.maximum(np.maximum(lower_edges - viewpoint[axis], viewpoint[axis] - lower_edges - self.tile), 0.0)
            )
        return np.asarray(np.hypot(axis_gaps[0][None, :], axis_gaps[1][:, None]).reshape(-1))

    def check(self) -> None:
        """Check that the arrays agree with each other.

        Raises:
            FormatError: They do not; the message is one line.
        """
        face_count, tile_count = len(self.faces), self.nx * self.ny + 1

        def require(is_met: bool, requirement: str) -> None:
            if not is_met:
                raise FormatError(f"street of {self.name}: {requirement}; delete the cached file and build it again")

        shapes = {
            "normals": (face_count, 3, 3),
            "uv": (face_count, 3, 2),
            "material": (face_count,),
            "offset": (LEVELS, tile_count + 1),
        }
        for array_name, shape in shapes.items():
            require(
                getattr(self, array_name).shape == shape,
                f"{array_name} has shape {getattr(self, array_name).shape}, not {shape}",
            )
        for array_name in ("vertices", "normals", "uv", "lamps", "heads", "parking", "bays", "yards", "limit_signs"):
            require(
                bool(np.isfinite(getattr(self, array_name)).all()), f"{array_name} holds a number that is not finite"
            )
        for array_name, limit in (
            ("faces", len(self.vertices)),
            ("material", len(self.materials)),
            ("order", face_count),
        ):
            value = getattr(self, array_name)
            require(
                value.size > 0 and value.min() >= 0 and value.max() < limit, f"{array_name} points outside the table"
            )
        require(bool((np.diff(self.offset, axis=1) >= 0).all()), "offset does not grow")
        require(int(self.offset.max()) == len(self.order), "offset does not cover the order")
        require(len(self.head_signal) == len(self.heads) == len(self.head_lens), "heads do not agree")


_MATERIAL = ("specular", "gloss", "emission")
_ARRAYS = array_dtypes(Street)


def save_street(street: Street, path: Path | str) -> None:
    """Write a street as .npz, whole or not at all; equal streets give equal bytes.

    Raises:
        StoreError: The file cannot be written.
    """
    materials = street.materials
    header = [f"ssad-street {FORMAT}", street.name, street.style]
    arrays: dict[str, npt.NDArray[Any]] = {
        "header": np.array(header),
        "size": np.array([street.tile, *street.origin, street.nx, street.ny], np.float64),
        "material_name": np.array([material.name for material in materials]),
        "material_value": np.array(
            [
                [*material.colour, *(getattr(material, attribute) for attribute in _MATERIAL), material.paint]
                for material in materials
            ]
        ),
    }
    save_npz(path, arrays | {name: getattr(street, name) for name in _ARRAYS})


def load_street(path: Path | str) -> Street:
    """Read a street that `save_street` wrote.

    Raises:
        FormatError: The file is missing, broken, or not a street.
    """
    arrays = load_npz(path)
    header = arrays.get("header")
    expected = {"header", "size", "material_name", "material_value", *_ARRAYS}
    # A cached file of another format is rejected here and built again by `cached_street`.
    if header is None or header.shape != (3,) or str(header[0]) != f"ssad-street {FORMAT}" or set(arrays) != expected:
        raise FormatError(f"{path}: not a street of format {FORMAT}; delete it and build the street again")
    for array_name, dtype in _ARRAYS.items():
        if arrays[array_name].dtype != dtype:
            raise FormatError(
                f"{path}: array {array_name} is {arrays[array_name].dtype}; delete it and build the street again"
            )
    size, material_values = arrays["size"], arrays["material_value"]
    if size.shape != (5,) or material_values.shape != (len(arrays["material_name"]), 7):
        raise FormatError(f"{path}: its tables are cut short; delete it and build the street again")
    materials = tuple(
        Material(str(array_name), (values[0], values[1], values[2]), values[3], values[4], values[5], bool(values[6]))
        for array_name, values in zip(arrays["material_name"].tolist(), material_values.tolist(), strict=True)
    )
    street = Street(
        name=str(header[1]),
        style=str(header[2]),
        materials=materials,
        tile=float(size[0]),
        origin=(float(size[1]), float(size[2])),
        nx=int(size[3]),
        ny=int(size[4]),
        **{array_name: arrays[array_name] for array_name in _ARRAYS},
    )
    street.check()
    return street
