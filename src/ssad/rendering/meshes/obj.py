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
    """The state of an OBJ reader: tables so far, current material and group."""

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

    def fail(self, message: str) -> FormatError:
        return FormatError(f"{self.file}:{self.line}: {message}")

    def numbers(self, words: Sequence[str], count: int) -> tuple[float, ...]:
        try:
            values = tuple(float(w) for w in words[:count])
        except ValueError:
            raise self.fail(f"'{' '.join(words)[:40]}' is not a list of numbers") from None
        if len(values) < count:
            raise self.fail(f"{len(values)} numbers where {count} are needed")
        if not np.isfinite(values).all():
            raise self.fail("NaN or infinity is not a coordinate; mend the mesh")
        return values

    def corner(self, word: str) -> tuple[int, int, int]:
        parts = [*word.split("/"), "", ""][:3]
        found = []
        for text, table, what in zip(parts, (self.v, self.vt, self.vn), ("vertex", "texture", "normal"), strict=True):
            if not text:
                found.append(-1)
                continue
            try:
                index = int(text)
            except ValueError:
                raise self.fail(f"'{word[:40]}' is not a corner of a face") from None
            index = index - 1 if index > 0 else len(table) + index
            if index == -1 or not 0 <= index < len(table):
                raise self.fail(f"{what} index {text} is out of range (there are {len(table)})")
            found.append(index)
        if found[0] < 0:
            raise self.fail("a corner of a face names no vertex")
        if found[1] < 0:
            raise self.fail("a face has no texture coordinates (UVs); unwrap the mesh before the export")
        return found[0], found[1], found[2]

    def face(self, words: Sequence[str]) -> None:
        if len(words) < 3:
            raise self.fail("a face needs three corners")
        if len(words) > 1000:
            raise self.fail(f"a face with {len(words)} corners; triangulate the mesh")
        corners = [self.corner(w) for w in words]
        triangles = [(0, 1, 2)] if len(corners) == 3 else self.split(np.array([self.v[c[0]] for c in corners]))
        if len(self.look) + len(triangles) > MAX_FACES:
            raise self.fail(f"more than {MAX_FACES} triangles; simplify the mesh")
        look = self.order.setdefault(self.material, len(self.order))
        panel = self.groups.setdefault(self.group, len(self.groups))
        for triangle in triangles:
            self.corners += [corners[i] for i in triangle]
            self.look.append(look)
            self.panel.append(panel)

    def split(self, p: F64) -> list[tuple[int, int, int]]:
        """Triangles of a plane polygon [P, 3]."""
        normal = np.cross(p - p[0], np.roll(p, -1, axis=0) - p[0]).sum(axis=0)
        drop = int(np.argmax(np.abs(normal)))
        flat = np.delete(p, drop, axis=1)
        try:
            faces = [(int(a), int(b), int(c)) for a, b, c in triangulate(flat)]
        except ConfigError:
            faces = [(0, k, k + 1) for k in range(1, len(p) - 1)]
        a, b, c = p[[f[0] for f in faces]], p[[f[1] for f in faces]], p[[f[2] for f in faces]]
        turned = float(np.cross(b - a, c - a).sum(axis=0) @ normal) < 0.0
        return [f[::-1] for f in faces] if turned else faces


def read_obj(file: Path) -> FaceList:
    """Triangles of an OBJ file with the materials of its MTL files, in the frame of the file.

    Raises:
        FormatError: A file is broken.
    """
    text = safeio.read_text(file, limit=MAX_BYTES).replace("\\\n", " ").replace("\\\r\n", " ")
    state = _Obj(file)
    tables = {"v": (state.v, 3), "vt": (state.vt, 2), "vn": (state.vn, 3)}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        state.line = number
        key, rest = words[0], words[1:]
        if key in tables:
            table, count = tables[key]
            if len(table) >= MAX_VERTICES:
                raise state.fail(f"more than {MAX_VERTICES} entries '{key}'; simplify the mesh")
            table.append(state.numbers(rest, count))
        elif key == "f":
            state.face(rest)
        elif key in ("g", "o"):
            state.group = " ".join(rest) or "default"
        elif key == "usemtl":
            state.material = " ".join(rest) or "default"
        elif key == "mtllib":
            state.materials.update(_read_mtl(beside(file, " ".join(rest))))
    if not state.corners:
        raise FormatError(f"{file}: the file has no faces")
    index = np.array(state.corners).reshape(-1, 3, 3)
    points = np.array(state.v, np.float64)[index[..., 0]]
    uv = np.array(state.vt, np.float64)[index[..., 1]] * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts v from the bottom
    normals = np.array([*state.vn, (0.0, 0.0, 0.0)], np.float64)[index[..., 2]]
    materials = [state.materials.get(name, replace(DEFAULT, name=name)) for name in state.order]
    return FaceList([points], [uv], [normals], state.look, state.panel, materials, list(state.groups))


def _read_mtl(file: Path) -> dict[str, Material]:
    """Materials of an MTL file: diffuse colour as albedo, mean of the specular colour, exponent as gloss."""
    found: dict[str, Material] = {}
    name = ""
    for number, line in enumerate(safeio.read_text(file, limit=16 * safeio.MIB).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "newmtl":
            name = " ".join(words[1:]) or "default"
            found[name] = replace(DEFAULT, name=name)
        elif words[0] in ("Kd", "Ks", "Ke", "Ns") and name:
            try:
                values = np.clip([float(w) for w in words[1:4]], 0.0, 1000.0)
            except ValueError:
                raise FormatError(f"{file}:{number}: '{line.strip()[:40]}' is not a colour") from None
            if not len(values) or not np.isfinite(values).all():
                raise FormatError(f"{file}:{number}: '{line.strip()[:40]}' is not a colour")
            r, g, b = (float(v) for v in np.minimum(np.resize(values, 3), 1.0))
            if words[0] == "Kd":
                found[name] = replace(found[name], colour=(r, g, b))
            elif words[0] == "Ks":
                found[name] = replace(found[name], specular=min(0.5, (r + g + b) / 3.0))
            elif words[0] == "Ke":
                found[name] = replace(found[name], emission=max(r, g, b))
            else:
                found[name] = replace(found[name], gloss=float(np.sqrt(min(values[0], 1000.0) / 1000.0)))
    return found
