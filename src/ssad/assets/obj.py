"""Users' own meshes: Wavefront OBJ with MTL colours here, glTF 2.0 in `ssad.assets.gltf`; `load_mesh` reads both.

A file is data from somewhere: sizes are limited, references may not leave its folder, and every complaint is one line
with file and line (OBJ) or object (glTF). Texture images are not read: the texture is what the user brings or attacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ssad.assets.mesh import F64, Material, Mesh, Point, corner_normals, triangulate, weld
from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError

MAX_VERTICES = 2_000_000
MAX_FACES = 2_000_000
MAX_BYTES = 256 * safeio.MIB
DEFAULT = Material("default", (0.5, 0.5, 0.5))
_AXES = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip


@dataclass
class FaceList:
    """Triangles as read: for each one its corners, texture coordinates (v down), normals, material and group."""

    points: list[F64] = field(default_factory=list)  # [n, 3, 3] each
    uv: list[F64] = field(default_factory=list)
    normals: list[F64] = field(default_factory=list)  # a row of zeros where the file gives none
    material: list[int] = field(default_factory=list)
    group: list[int] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)

    def add(self, points: F64, uv: F64, normals: F64, *, material: int, group: int) -> None:
        """Triangles [n, 3, 3] with [n, 3, 2] texture coordinates."""
        self.points.append(points)
        self.uv.append(uv)
        self.normals.append(normals)
        self.material += [material] * len(points)
        self.group += [group] * len(points)


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

    `unit` is the length of one unit of the file in metres; `up` and `forward` are axes of the file (x, -x, y, ...;
    default z and x for OBJ, y and z for glTF, as its standard says); `size` (m) stretches the mesh to fill a box.
    `paint` names the materials that take paint or a texture (default: all); their groups become panels, and their
    texture coordinates must lie in one tile. FormatError, ConfigError.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in (".obj", ".gltf", ".glb"):
        raise FormatError(f"{file}: not a mesh that can be read; give an .obj, .gltf or .glb file")
    if suffix == ".obj":
        soup = _read_obj(file)
    else:
        from ssad.assets.gltf import read_gltf

        soup = read_gltf(file)
    turn = _rotation(up or ("z" if suffix == ".obj" else "y"), forward or ("x" if suffix == ".obj" else "z"))
    if not (np.isfinite(unit) and unit > 0.0):
        raise ConfigError(f"{file}: unit {unit} is not a length in metres; give e.g. 0.01 for centimetres")
    mesh = assemble(soup, str(file), paint=paint)
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


def assemble(soup: FaceList, name: str, *, paint: Sequence[str] | None = None) -> Mesh:
    """A checked mesh of triangles as read. FormatError."""
    if not soup.points or not sum(len(p) for p in soup.points):
        raise FormatError(f"{name}: the file has no triangles")
    points, uv, normals = (np.concatenate(a).astype(np.float64) for a in (soup.points, soup.uv, soup.normals))
    for what, array in (("vertices", points), ("texture coordinates", uv), ("normals", normals)):
        if not np.isfinite(array).all():
            raise FormatError(f"{name}: {what} hold NaN or infinity; mend the mesh")
    known = [m.name for m in soup.materials]
    missing = [p for p in paint or () if p not in known]
    if missing:
        raise ConfigError(f"{name}: no material '{missing[0]}' to paint; it has: {', '.join(known)}")
    materials = tuple(replace(m, paint=paint is None or m.name in paint) for m in soup.materials)
    material = np.array(soup.material, np.int32)
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
    used = sorted({g for g, p in zip(soup.group, painted, strict=True) if p})
    place = np.full(len(soup.groups) + 1, -1, np.int32)
    place[used] = np.arange(len(used))
    keep = 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1) > 0.0
    return Mesh(
        vertices.astype(np.float32),
        faces[keep],
        normals[keep].astype(np.float32),
        uv[keep].astype(np.float32),
        material[keep],
        np.where(painted, place[np.array(soup.group)], -1).astype(np.int32)[keep],
        materials,
        tuple(soup.groups[g] for g in used),
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


def beside(file: Path, reference: str) -> Path:
    """A file that another one refers to: it must lie in the same folder or below. FormatError."""
    folder = file.parent.resolve()
    target = (folder / reference).resolve()
    if "\0" in reference or ":" in reference or not target.is_relative_to(folder):
        raise FormatError(f"{file}: refers to '{reference[:80]}' outside its folder; put the file beside the mesh")
    return target


# ---------------------------------------------------------------- Wavefront OBJ


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


def _read_obj(file: Path) -> FaceList:
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


def save_obj(mesh: Mesh, path: str | Path) -> None:
    """Write an OBJ and, beside it, an MTL of the same name; `load_mesh` reads back the same mesh. StoreError."""
    file = Path(path)
    lines = [f"mtllib {file.stem}.mtl"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.9g} {1.0 - v:.9g}" for u, v in mesh.uv.reshape(-1, 2).tolist()]
    lines += [f"vn {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.normals.reshape(-1, 3).tolist()]
    last: tuple[int, int] | None = None
    for k, (face, look, panel) in enumerate(
        zip(mesh.faces.tolist(), mesh.material.tolist(), mesh.panel.tolist(), strict=True)
    ):
        if (look, panel) != last:
            lines += [f"g {mesh.panels[panel] if panel >= 0 else 'none'}", f"usemtl {mesh.materials[look].name}"]
            last = look, panel
        lines.append("f " + " ".join(f"{v + 1}/{3 * k + c + 1}/{3 * k + c + 1}" for c, v in enumerate(face)))
    looks: list[str] = []
    for m in mesh.materials:
        looks += [f"newmtl {m.name}"]
        glow = min(m.emission, 1.0)
        for key, values in (
            ("Kd", m.colour),
            ("Ks", (m.specular,) * 3),
            ("Ke", (glow,) * 3),
            ("Ns", (1000.0 * m.gloss**2,)),
        ):
            looks.append(f"{key} " + " ".join(f"{v:.6g}" for v in values))
    safeio.write_atomic(file.with_suffix(".mtl"), "\n".join(looks) + "\n")
    safeio.write_atomic(file, "\n".join(lines) + "\n")
