"""What the readers of mesh files give before it is a mesh: triangles in the frame of the file; and how much is read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.rendering.meshes.mesh import F64, Material

MAX_VERTICES = 2_000_000
MAX_FACES = 2_000_000
MAX_BYTES = 256 * safeio.MIB
DEFAULT = Material("default", (0.5, 0.5, 0.5))


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


def beside(file: Path, reference: str) -> Path:
    """A file that another one refers to: it must be in the same folder or below.

    Raises:
        FormatError: It is elsewhere.
    """
    folder = file.parent.resolve()
    target = (folder / reference).resolve()
    if "\0" in reference or ":" in reference or not target.is_relative_to(folder):
        raise FormatError(f"{file}: refers to '{reference[:80]}' outside its folder; put the file beside the mesh")
    return target
