"""Triangles as mesh readers return them, in the frame of the file, and the limits of what is read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.rendering.meshes.mesh import F64, Material

# Limits that keep a malformed or hostile file from exhausting memory.
MAX_VERTICES = 2_000_000
MAX_FACES = 2_000_000
MAX_BYTES = 256 * safeio.MIB
DEFAULT = Material("default", (0.5, 0.5, 0.5))


@dataclass
class FaceList:
    """Triangles as read: corners, texture coordinates (v down), normals, material and group of each."""

    points: list[F64] = field(default_factory=list)  # [n, 3, 3] each
    uv: list[F64] = field(default_factory=list)
    normals: list[F64] = field(default_factory=list)  # a row of zeros where the file gives none
    material: list[int] = field(default_factory=list)
    group: list[int] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)

    def add(self, points: F64, uv: F64, normals: F64, *, material: int, group: int) -> None:
        """Append triangles [n, 3, 3] with [n, 3, 2] texture coordinates."""
        self.points.append(points)
        self.uv.append(uv)
        self.normals.append(normals)
        self.material += [material] * len(points)
        self.group += [group] * len(points)


def beside(file: Path, reference: str) -> Path:
    """Return the path of a file that another file refers to; it must lie in the same folder or below.

    Raises:
        FormatError: It lies elsewhere.
    """
    folder = file.parent.resolve()
    target = (folder / reference).resolve()
    # Mesh files are untrusted: a reference must not reach other folders, drives or URLs.
    if "\0" in reference or ":" in reference or not target.is_relative_to(folder):
        raise FormatError(f"{file}: refers to '{reference[:80]}' outside its folder; put the file beside the mesh")
    return target
