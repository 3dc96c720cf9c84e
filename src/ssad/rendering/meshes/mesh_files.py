"""Meshes of a user's own: Wavefront OBJ with MTL colours (`meshes.obj`) and glTF 2.0 (`meshes.gltf`).

A file is data from somewhere: sizes are limited, references may not leave its folder, and every complaint is one line
with file and line (OBJ) or object (glTF). Texture images are not read: the texture is what the user brings or attacks.
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
    """A mesh from an .obj, .gltf or .glb file in the object frame: x forward, z up, base centred on the origin.

    Args:
        path: The file.
        unit: Length of one unit of the file, m.
        up: Axis of the file (x, -x, y, ...) that points up; None: z for OBJ, y for glTF, as its standard says.
        forward: Axis of the file that points forward; None: x for OBJ, z for glTF.
        size: Length, width and height that the mesh is stretched to, m; None: as it is.
        paint: Names of the materials that take paint or a texture; None: all. Their groups become panels, and their
            texture coordinates must be in one tile.

    Raises:
        FormatError: The file is broken, or uses what is not supported.
        ConfigError: An argument does not fit.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in (".obj", ".gltf", ".glb"):
        raise FormatError(f"{file}: not a mesh that can be read; give an .obj, .gltf or .glb file")
    triangles = read_obj(file) if suffix == ".obj" else read_gltf(file)
    turn = _rotation(up or ("z" if suffix == ".obj" else "y"), forward or ("x" if suffix == ".obj" else "z"))
    if not (np.isfinite(unit) and unit > 0.0):
        raise ConfigError(f"{file}: unit {unit} is not a length in metres; give e.g. 0.01 for centimetres")
    mesh = _assemble(triangles, str(file), paint=paint)
    matrix = np.eye(4)
    matrix[:3, :3] = unit * turn
    mesh = mesh.transformed(matrix)
    low, high = mesh.bounds()
    extent = high - low
    if size is not None:
        if extent.min() < 1e-6:
            raise FormatError(f"{file}: the mesh is flat, it cannot be stretched to a size; leave out size")
        scale = np.asarray(size, np.float64) / extent
        mesh = mesh.transformed(np.diag([*scale, 1.0]))
        low, high = mesh.bounds()
    if not 1e-3 < float(np.max(high - low)) < 1e3:
        raise FormatError(f"{file}: the mesh is {np.max(high - low):.3g} m large; set unit (metres of one unit)")
    mesh = mesh.moved(-0.5 * (low[0] + high[0]), -0.5 * (low[1] + high[1]), -low[2])
    mesh.check(str(file))
    return mesh


def _assemble(triangles: FaceList, name: str, *, paint: Sequence[str] | None = None) -> Mesh:
    """A checked mesh of triangles as read. FormatError."""
    if not triangles.points or not sum(len(p) for p in triangles.points):
        raise FormatError(f"{name}: the file has no triangles")
    points, uv, normals = (
        np.concatenate(a).astype(np.float64) for a in (triangles.points, triangles.uv, triangles.normals)
    )
    for what, array in (("vertices", points), ("texture coordinates", uv), ("normals", normals)):
        if not np.isfinite(array).all():
            raise FormatError(f"{name}: {what} hold NaN or infinity; mend the mesh")
    known = [m.name for m in triangles.materials]
    missing = [p for p in paint or () if p not in known]
    if missing:
        raise ConfigError(f"{name}: no material '{missing[0]}' to paint; it has: {', '.join(known)}")
    materials = tuple(replace(m, paint=paint is None or m.name in paint) for m in triangles.materials)
    material = np.array(triangles.material, np.int32)
    painted = np.array([m.paint for m in materials])[material]
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-6)
    over = painted & (uv.max(axis=(1, 2)) > 1.0 + 1e-4)
    if over.any():
        raise FormatError(
            f"{name}: {int(over.sum())} painted triangles have texture coordinates over a tile's edge; "
            "unwrap the mesh into one atlas, or name the materials to paint"
        )
    inside = uv.max(axis=(1, 2), keepdims=True) <= 1.0 + 1e-4
    uv = np.clip(np.where(inside, uv, uv - np.floor(uv)), 0.0, 1.0)
    vertices, faces = weld(points.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3), tolerance=_grain(points))
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    given = (length > 0.2).all(axis=1, keepdims=True)
    made = corner_normals(vertices, faces) if not given.all() else normals
    normals = np.where(given, normals / np.maximum(length, 1e-12), made)
    used = sorted({g for g, p in zip(triangles.group, painted, strict=True) if p})
    place = np.full(len(triangles.groups) + 1, -1, np.int32)
    place[used] = np.arange(len(used))
    keep = 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1) > 0.0
    return Mesh(
        vertices.astype(np.float32),
        faces[keep],
        normals[keep].astype(np.float32),
        uv[keep].astype(np.float32),
        material[keep],
        np.where(painted, place[np.array(triangles.group)], -1).astype(np.int32)[keep],
        materials,
        tuple(triangles.groups[g] for g in used),
    )


def _grain(points: F64) -> float:
    """Distance below which corners are one vertex."""
    return max(float(np.ptp(points)) * 1e-6, 1e-12)


def _rotation(up: str, forward: str) -> F64:
    """Matrix from the axes of a file to x forward, z up. ConfigError."""
    if up not in _AXES or forward not in _AXES or up[-1] == forward[-1]:
        raise ConfigError(
            f"up '{up}' and forward '{forward}' are not two different axes; choose from {', '.join(_AXES)}"
        )
    z, x = np.array(_AXES[up]), np.array(_AXES[forward])
    return np.array([x, np.cross(z, x), z])
