"""Writer of Wavefront OBJ meshes with MTL materials, one of which shows a texture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssad.core import safeio
from ssad.rendering.meshes.mesh import F64, Material, Mesh

WORN = "texture"  # name of the material that shows the texture


def write_obj(path: Path, mesh: Mesh, *, texture: str | None = None) -> None:
    """Write a mesh as OBJ, and its materials beside it as MTL; `ssad.rendering.meshes.mesh_files.load_mesh` reads both.

    x forward, y left, z up, metres. Panels are groups. Faces of panels get a material of their own, which shows the
    texture (`map_Kd`).

    Args:
        path: The .obj file.
        mesh: The mesh.
        texture: File name of the texture's picture, in the same folder; None: materials have colours alone.
    """
    worn = mesh.panel >= 0 if texture is not None else np.zeros(len(mesh.faces), bool)
    lines = [f"# SSAD; x forward, y left, z up; metres\nmtllib {path.with_suffix('.mtl').name}"]
    lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.vertices.tolist()]
    uv, uv_of = np.unique(mesh.uv.reshape(-1, 2), axis=0, return_inverse=True)
    normals, normal_of = np.unique(mesh.normals.reshape(-1, 3), axis=0, return_inverse=True)
    lines += [f"vt {u:.7g} {1.0 - v:.7g}" for u, v in uv.astype(np.float64).tolist()]  # v runs up in an OBJ file
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    corners = np.stack([mesh.faces, uv_of.reshape(-1, 3), normal_of.reshape(-1, 3)], -1) + 1
    looks = np.where(worn, -1, mesh.material)
    state: tuple[int, int] | None = None
    for k in np.lexsort((looks, mesh.panel)).tolist():
        panel, look = int(mesh.panel[k]), int(looks[k])
        if state is None or state[0] != panel:
            lines.append(f"g {mesh.panels[panel] if panel >= 0 else 'body'}")
        if state is None or state != (panel, look):
            lines.append(f"usemtl {WORN if look < 0 else mesh.materials[look].name}")
        state = panel, look
        lines.append("f " + " ".join("/".join(map(str, corner)) for corner in corners[k].tolist()))
    safeio.make_folder(path.parent)
    safeio.write_atomic(path, "\n".join(lines) + "\n")
    blocks = [_material(one) for k, one in enumerate(mesh.materials) if (looks == k).any()]
    if worn.any():
        blocks.append(f"newmtl {WORN}\nKd 1 1 1\nKs 0.04 0.04 0.04\nNs 32\nmap_Kd {texture}")
    safeio.write_atomic(path.with_suffix(".mtl"), "\n\n".join(blocks) + "\n")


def _material(one: Material) -> str:
    """A material as MTL has it."""
    colour: F64 = np.asarray(one.colour, np.float64)
    kd, ks, ke = (" ".join(f"{v:.4g}" for v in row) for row in (colour, [one.specular] * 3, colour * one.emission))
    return f"newmtl {one.name}\nKd {kd}\nKs {ks}\nNs {10 + 200 * one.gloss:.4g}\nKe {ke}"
