"""Loader of users' meshes: Wavefront OBJ with MTL colours (`meshes.obj`) and glTF 2.0 (`meshes.gltf`).

Files are untrusted: sizes are limited, references must not leave the folder, and every error is one line with
file and line (OBJ) or object (glTF). Texture images are not read: users supply or attack the texture themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssad.core.errors import ConfigError, FormatError
from ssad.rendering.meshes.face_list import FaceList
from ssad.rendering.meshes.gltf import read_gltf
from ssad.rendering.meshes.mesh import F64, Mesh, Point, corner_normals, weld
from ssad.rendering.meshes.obj import read_obj

_AXES = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}


def load_mesh(
    path: str | Path,
    *,
    unit: float = 1.0,
    up: str | None = None,
    forward: str | None = None,
    size: Point | None = None,
    paint: Sequence[str] | None = None,
) -> Mesh:
    """Load an .obj, .gltf or .glb file in the object frame: x forward, z up, base centred on the origin.

    Args:
        path: The file.
        unit: Length of one unit of the file, m.
        up: Axis of the file (x, -x, y, ...) that points up; None: z for OBJ, y for glTF, as its standard says.
        forward: Axis of the file that points forward; None: x for OBJ, z for glTF.
        size: Length, width and height that the mesh is stretched to, m; None: the size in the file.
        paint: Names of the materials that take paint or a texture; None: all. Their groups become panels, and
            their texture coordinates must be in one tile.

    Returns:
        The checked mesh.

    Raises:
        FormatError: The file is broken, or uses an unsupported feature.
        ConfigError: An argument is invalid.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in (".obj", ".gltf", ".glb"):
        raise FormatError(f"{file}: not a mesh that can be read; give an .obj, .gltf or .glb file")
    triangles = read_obj(file) if suffix == ".obj" else read_gltf(file)
    rotation = _rotation(up or ("z" if suffix == ".obj" else "y"), forward or ("x" if suffix == ".obj" else "z"))
    if not (np.isfinite(unit) and unit > 0.0):
        raise ConfigError(f"{file}: unit {unit} is not a length in metres; give e.g. 0.01 for centimetres")
    mesh = _assemble(triangles, str(file), paint=paint)
    matrix = np.eye(4)
    matrix[:3, :3] = unit * rotation
    mesh = mesh.transformed(matrix)
    lower, upper = mesh.bounds()
    extent = upper - lower
    if size is not None:
        if extent.min() < 1e-6:
            raise FormatError(f"{file}: the mesh is flat, it cannot be stretched to a size; leave out size")
        scale = np.asarray(size, np.float64) / extent
        mesh = mesh.transformed(np.diag([*scale, 1.0]))
        lower, upper = mesh.bounds()
    # The usual mistake is a wrong unit: a car in centimetres would be hundreds of metres long.
    if not 1e-3 < float(np.max(upper - lower)) < 1e3:
        raise FormatError(f"{file}: the mesh is {np.max(upper - lower):.3g} m large; set unit (metres of one unit)")
    mesh = mesh.moved(-0.5 * (lower[0] + upper[0]), -0.5 * (lower[1] + upper[1]), -lower[2])
    mesh.check(str(file))
    return mesh


def _assemble(triangles: FaceList, name: str, *, paint: Sequence[str] | None = None) -> Mesh:
    """Build a mesh from triangles as read.

    Raises:
        FormatError: The triangles are unusable.
    """
    if not triangles.points or not sum(len(entry) for entry in triangles.points):
        raise FormatError(f"{name}: the file has no triangles")
    points, uv, normals = (
        np.concatenate(arrays).astype(np.float64) for arrays in (triangles.points, triangles.uv, triangles.normals)
    )
    for label, array in (("vertices", points), ("texture coordinates", uv), ("normals", normals)):
        if not np.isfinite(array).all():
            raise FormatError(f"{name}: {label} hold NaN or infinity; mend the mesh")
    material_names = [entry_material.name for entry_material in triangles.materials]
    missing = [entry for entry in paint or () if entry not in material_names]
    if missing:
        raise ConfigError(f"{name}: no material '{missing[0]}' to paint; it has: {', '.join(material_names)}")
    materials = tuple(
        replace(entry_material, paint=paint is None or entry_material.name in paint)
        for entry_material in triangles.materials
    )
    material = np.array(triangles.material, np.int32)
    painted = np.array([entry_material.paint for entry_material in materials])[material]
    # Shift each triangle into the first tile; the margin absorbs rounding at the tile's edge.
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-6)
    crosses_tile = painted & (uv.max(axis=(1, 2)) > 1.0 + 1e-4)
    if crosses_tile.any():
        raise FormatError(
            f"{name}: {int(crosses_tile.sum())} painted triangles have texture coordinates over a tile's edge; "
            "unwrap the mesh into one atlas, or name the materials to paint"
        )
    in_one_tile = uv.max(axis=(1, 2), keepdims=True) <= 1.0 + 1e-4
    uv = np.clip(np.where(in_one_tile, uv, uv - np.floor(uv)), 0.0, 1.0)
    vertices, faces = weld(points.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3), tolerance=_grain(points))
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    has_normals = (lengths > 0.2).all(axis=1, keepdims=True)
    computed_normals = corner_normals(vertices, faces) if not has_normals.all() else normals
    normals = np.where(has_normals, normals / np.maximum(lengths, 1e-12), computed_normals)
    painted_groups = sorted({group for group, entry in zip(triangles.group, painted, strict=True) if entry})
    panel_of_group = np.full(len(triangles.groups) + 1, -1, np.int32)
    panel_of_group[painted_groups] = np.arange(len(painted_groups))
    has_area = 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1) > 0.0
    return Mesh(
        vertices.astype(np.float32),
        faces[has_area],
        normals[has_area].astype(np.float32),
        uv[has_area].astype(np.float32),
        material[has_area],
        np.where(painted, panel_of_group[np.array(triangles.group)], -1).astype(np.int32)[has_area],
        materials,
        tuple(triangles.groups[group] for group in painted_groups),
    )


def _grain(points: F64) -> float:
    """Return the distance below which corners are merged into one vertex."""
    return max(float(np.ptp(points)) * 1e-6, 1e-12)


def _rotation(up: str, forward: str) -> F64:
    """Return the rotation from the axes of a file to x forward, z up.

    Raises:
        ConfigError: The axes are not two different ones.
    """
    if up not in _AXES or forward not in _AXES or up[-1] == forward[-1]:
        raise ConfigError(
            f"up '{up}' and forward '{forward}' are not two different axes; choose from {', '.join(_AXES)}"
        )
    z, x = np.array(_AXES[up]), np.array(_AXES[forward])
    return np.array([x, np.cross(z, x), z])
