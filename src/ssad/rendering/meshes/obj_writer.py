"""Writer of Wavefront OBJ meshes with MTL materials, one of which carries a texture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssad.core import safeio
from ssad.rendering.meshes.mesh import F64, Material, Mesh

WORN = "texture"  # name of the material that shows the texture


def write_obj(path: Path, mesh: Mesh, *, texture: str | None = None) -> None:
    """Write a mesh as OBJ and its materials as MTL in the same folder; `load_mesh` reads both.

    x forward, y left, z up, metres. Panels are groups. Faces of panels get a material of their own, which
    refers to the texture (`map_Kd`).

    Args:
        path: The .obj file.
        mesh: The mesh.
        texture: File name of the texture image, in the same folder; None: materials have colours only.
    """
    is_textured = mesh.panel >= 0 if texture is not None else np.zeros(len(mesh.faces), bool)
    lines = [f"# SSAD; x forward, y left, z up; metres\nmtllib {path.with_suffix('.mtl').name}"]
    lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.vertices.tolist()]
    uv, uv_indices = np.unique(mesh.uv.reshape(-1, 2), axis=0, return_inverse=True)
    normals, normal_indices = np.unique(mesh.normals.reshape(-1, 3), axis=0, return_inverse=True)
    lines += [f"vt {u:.7g} {1.0 - v:.7g}" for u, v in uv.astype(np.float64).tolist()]  # v runs up in an OBJ file
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    corner_indices = np.stack([mesh.faces, uv_indices.reshape(-1, 3), normal_indices.reshape(-1, 3)], -1) + 1
    material_indices = np.where(is_textured, -1, mesh.material)
    current_group: tuple[int, int] | None = None
    # Sorting by panel, then material, writes each `g` and `usemtl` statement only once.
    for face in np.lexsort((material_indices, mesh.panel)).tolist():
        panel, material_index = int(mesh.panel[face]), int(material_indices[face])
        if current_group is None or current_group[0] != panel:
            lines.append(f"g {mesh.panels[panel] if panel >= 0 else 'body'}")
        if current_group is None or current_group != (panel, material_index):
            lines.append(f"usemtl {WORN if material_index < 0 else mesh.materials[material_index].name}")
        current_group = panel, material_index
        lines.append("f " + " ".join("/".join(map(str, corner)) for corner in corner_indices[face].tolist()))
    safeio.make_folder(path.parent)
    safeio.write_atomic(path, "\n".join(lines) + "\n")
    blocks = [_material(material) for face, material in enumerate(mesh.materials) if (material_indices == face).any()]
    if is_textured.any():
        blocks.append(f"newmtl {WORN}\nKd 1 1 1\nKs 0.04 0.04 0.04\nNs 32\nmap_Kd {texture}")
    safeio.write_atomic(path.with_suffix(".mtl"), "\n\n".join(blocks) + "\n")


def _material(material: Material) -> str:
    """A material as MTL has it."""
    colour: F64 = np.asarray(material.colour, np.float64)
    diffuse, specular, emission = (
        " ".join(f"{value:.4g}" for value in row)
        for row in (colour, [material.specular] * 3, colour * material.emission)
    )
    return f"newmtl {material.name}\nKd {diffuse}\nKs {specular}\nNs {10 + 200 * material.gloss:.4g}\nKe {emission}"
