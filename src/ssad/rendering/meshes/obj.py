"""Reader of Wavefront OBJ meshes with MTL colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.rendering.meshes.face_list import DEFAULT, MAX_BYTES, MAX_FACES, MAX_VERTICES, FaceList, beside
from ssad.rendering.meshes.mesh import F64, Material, triangulate


class _Obj:
    """State of the OBJ reader: tables so far, current material and group."""

    def __init__(self, file: Path) -> None:
        self.file, self.line = file, 0
        self.v: list[tuple[float, ...]] = []
        self.vt: list[tuple[float, ...]] = []
        self.vn: list[tuple[float, ...]] = []
        self.corners: list[tuple[int, int, int]] = []
        self.materials: dict[str, Material] = {}
        self.order: dict[str, int] = {}
        self.groups: dict[str, int] = {}
        self.look: list[int] = []
        self.panel: list[int] = []
        self.material = self.group = "default"

    def error(self, message: str) -> FormatError:
        return FormatError(f"{self.file}:{self.line}: {message}")

    def numbers(self, words: Sequence[str], count: int) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in words[:count])
        except ValueError:
            raise self.error(f"'{' '.join(words)[:40]}' is not a list of numbers") from None
        if len(values) < count:
            raise self.error(f"{len(values)} numbers where {count} are needed")
        if not np.isfinite(values).all():
            raise self.error("NaN or infinity is not a coordinate; mend the mesh")
        return values

    def corner(self, word: str) -> tuple[int, int, int]:
        parts = [*word.split("/"), "", ""][:3]
        indices = []
        for token, table, label in zip(parts, (self.v, self.vt, self.vn), ("vertex", "texture", "normal"), strict=True):
            if not token:
                indices.append(-1)
                continue
            try:
                index = int(token)
            except ValueError:
                raise self.error(f"'{word[:40]}' is not a corner of a face") from None
            # OBJ indices count from 1; negative ones count back from the latest entry.
            index = index - 1 if index > 0 else len(table) + index
            if index == -1 or not 0 <= index < len(table):
                raise self.error(f"{label} index {token} is out of range (there are {len(table)})")
            indices.append(index)
        if indices[0] < 0:
            raise self.error("a corner of a face names no vertex")
        if indices[1] < 0:
            raise self.error("a face has no texture coordinates (UVs); unwrap the mesh before the export")
        return indices[0], indices[1], indices[2]

    def face(self, words: Sequence[str]) -> None:
        if len(words) < 3:
            raise self.error("a face needs three corners")
        if len(words) > 1000:
            raise self.error(f"a face with {len(words)} corners; triangulate the mesh")
        corners = [self.corner(word) for word in words]
        triangles = (
            [(0, 1, 2)]
            if len(corners) == 3
            else self.split(np.array([self.v[corner_triple[0]] for corner_triple in corners]))
        )
        if len(self.look) + len(triangles) > MAX_FACES:
            raise self.error(f"more than {MAX_FACES} triangles; simplify the mesh")
        material_index = self.order.setdefault(self.material, len(self.order))
        group_index = self.groups.setdefault(self.group, len(self.groups))
        for triangle in triangles:
            self.corners += [corners[corner_index] for corner_index in triangle]
            self.look.append(material_index)
            self.panel.append(group_index)

    def split(self, p: F64) -> list[tuple[int, int, int]]:
        """Triangles of a plane polygon [P, 3]."""
        normal = np.cross(p - p[0], np.roll(p, -1, axis=0) - p[0]).sum(axis=0)
        # Dropping the axis of the largest normal component keeps the projection from degenerating.
        dropped_axis = int(np.argmax(np.abs(normal)))
        projected = np.delete(p, dropped_axis, axis=1)
        try:
            faces = [(int(first), int(second), int(third)) for first, second, third in triangulate(projected)]
        except ConfigError:
            faces = [(0, index, index + 1) for index in range(1, len(p) - 1)]
        first, second, third = (
            p[[face[0] for face in faces]],
            p[[face[1] for face in faces]],
            p[[face[2] for face in faces]],
        )
        # The projection may mirror the polygon: restore the winding of the file.
        is_reversed = float(np.cross(second - first, third - first).sum(axis=0) @ normal) < 0.0
        return [face[::-1] for face in faces] if is_reversed else faces


def read_obj(file: Path) -> FaceList:
    """Read the triangles of an OBJ file and the materials of its MTL files, in the frame of the file.

    Raises:
        FormatError: A file is broken.
    """
    text = safeio.read_text(file, limit=MAX_BYTES).replace("\\\n", " ").replace("\\\r\n", " ")
    state = _Obj(file)
    tables = {"v": (state.v, 3), "vt": (state.vt, 2), "vn": (state.vn, 3)}
    for line_number, line in enumerate(text.splitlines(), start=1):
        tokens = line.split("#", 1)[0].split()
        if not tokens:
            continue
        state.line = line_number
        key, arguments = tokens[0], tokens[1:]
        if key in tables:
            entries, count = tables[key]
            if len(entries) >= MAX_VERTICES:
                raise state.error(f"more than {MAX_VERTICES} entries '{key}'; simplify the mesh")
            entries.append(state.numbers(arguments, count))
        elif key == "f":
            state.face(arguments)
        elif key in ("g", "o"):
            state.group = " ".join(arguments) or "default"
        elif key == "usemtl":
            state.material = " ".join(arguments) or "default"
        elif key == "mtllib":
            state.materials.update(_read_mtl(beside(file, " ".join(arguments))))
    if not state.corners:
        raise FormatError(f"{file}: the file has no faces")
    index = np.array(state.corners).reshape(-1, 3, 3)
    points = np.array(state.v, np.float64)[index[..., 0]]
    uv = np.array(state.vt, np.float64)[index[..., 1]] * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts v from the bottom
    normals = np.array([*state.vn, (0.0, 0.0, 0.0)], np.float64)[index[..., 2]]
    materials = [state.materials.get(name, replace(DEFAULT, name=name)) for name in state.order]
    return FaceList([points], [uv], [normals], state.look, state.panel, materials, list(state.groups))


def _read_mtl(file: Path) -> dict[str, Material]:
    """Read the materials of an MTL file.

    The diffuse colour becomes the albedo, the mean of the specular colour the specular share, and the exponent
    the gloss.
    """
    materials: dict[str, Material] = {}
    name = ""
    for number, line in enumerate(safeio.read_text(file, limit=16 * safeio.MIB).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "newmtl":
            name = " ".join(words[1:]) or "default"
            materials[name] = replace(DEFAULT, name=name)
        elif words[0] in ("Kd", "Ks", "Ke", "Ns") and name:
            try:
                values = np.clip([float(word) for word in words[1:4]], 0.0, 1000.0)
            except ValueError:
                raise FormatError(f"{file}:{number}: '{line.strip()[:40]}' is not a colour") from None
            if not len(values) or not np.isfinite(values).all():
                raise FormatError(f"{file}:{number}: '{line.strip()[:40]}' is not a colour")
            red, green, blue = (float(component) for component in np.minimum(np.resize(values, 3), 1.0))
            if words[0] == "Kd":
                materials[name] = replace(materials[name], colour=(red, green, blue))
            elif words[0] == "Ks":
                materials[name] = replace(materials[name], specular=min(0.5, (red + green + blue) / 3.0))
            elif words[0] == "Ke":
                materials[name] = replace(materials[name], emission=max(red, green, blue))
            else:
                materials[name] = replace(materials[name], gloss=float(np.sqrt(min(values[0], 1000.0) / 1000.0)))
    return materials
