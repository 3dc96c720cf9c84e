"""Reader of glTF 2.0 meshes (.gltf with data URIs or files beside it, and .glb): geometry and material factors.

Source: Khronos glTF 2.0 specification. Sparse accessors, compressed geometry, skins and animations are not read;
files that require an unknown extension are rejected.
"""

from __future__ import annotations

import base64
import binascii
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.rotations import pose_matrix
from ssad.rendering.meshes.face_list import DEFAULT, MAX_BYTES, MAX_FACES, MAX_VERTICES, FaceList, beside
from ssad.rendering.meshes.mesh import F64, Material

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_HARMLESS = ("KHR_materials_", "KHR_texture_transform", "KHR_mesh_quantization")
MAX_NODES = 20_000


def read_gltf(file: Path) -> FaceList:
    """Read the triangles of the default scene, in the frame of the file.

    Raises:
        FormatError: The file is broken, or uses an unsupported feature.
    """
    content = safeio.read_bytes(file, limit=MAX_BYTES)
    binary_chunk = None
    if file.suffix.lower() == ".glb":
        content, binary_chunk = _split_glb(content, file)
    tree = safeio.parse_json(content, str(file))
    if not isinstance(tree, dict):
        raise FormatError(f"{file}: not a glTF file (an object is expected)")
    try:
        return _Reader(file, tree, binary_chunk).read()
    except (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError) as error:
        raise FormatError(f"{file}: not a valid glTF file: {type(error).__name__} {error}") from None


def _split_glb(data: bytes, file: Path) -> tuple[bytes, bytes | None]:
    """Return the JSON text and the binary chunk of a .glb file."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise FormatError(f"{file}: not a binary glTF file")
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FormatError(f"{file}: glTF version {version}; only version 2 is read")
    if total > len(data):
        raise FormatError(f"{file}: cut short: {len(data)} of {total} bytes")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset + 8 <= total:
        size, chunk_type = struct.unpack_from("<II", data, offset)
        if offset + 8 + size > total:
            raise FormatError(f"{file}: a chunk of {size} bytes is cut short")
        chunks.setdefault(chunk_type, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    # Chunk types are the ASCII codes of "JSON" and "BIN\\0".
    if 0x4E4F534A not in chunks:
        raise FormatError(f"{file}: no JSON chunk")
    return chunks[0x4E4F534A], chunks.get(0x004E4942)


class _Reader:
    """Reader of the scene graph of a parsed glTF tree, for one pass."""

    def __init__(self, file: Path, tree: dict[str, Any], chunk: bytes | None) -> None:
        self.file, self.tree, self.chunk = file, tree, chunk
        self.buffers: dict[int, bytes] = {}
        self.triangles = FaceList()
        self.faces = self.visited = 0

    def error(self, message: str) -> FormatError:
        return FormatError(f"{self.file}: {message}")

    def item(self, kind: str, index: Any) -> Any:
        table = self.tree.get(kind, [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(table):
            raise self.error(f"{kind}[{index}] does not exist (there are {len(table)})")
        return table[index]

    def read(self) -> FaceList:
        version = str(self.tree.get("asset", {}).get("version", ""))
        if not version.startswith("2"):
            raise self.error(f"glTF version '{version[:20]}'; only version 2 is read")
        unsupported = [
            extension
            for extension in self.tree.get("extensionsRequired", [])
            if not str(extension).startswith(_HARMLESS)
        ]
        if unsupported:
            raise self.error(f"requires the extension {str(unsupported[0])[:60]}; export without it")
        self.triangles.materials = [
            self.material(material, index) for index, material in enumerate(self.tree.get("materials", []))
        ] + [DEFAULT]
        scenes = self.tree.get("scenes", [])
        nodes = self.tree.get("nodes", [])
        if scenes:
            roots = self.item("scenes", self.tree.get("scene", 0)).get("nodes", [])
        else:
            children = {child for entry in nodes for child in entry.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        for root in roots:
            self.node(root, np.eye(4), ())
        return self.triangles

    def node(self, index: int, parent: F64, above: tuple[int, ...]) -> None:
        self.visited += 1
        # The graph comes from an untrusted file and may contain cycles.
        if index in above or len(above) > safeio.MAX_DEPTH or self.visited > MAX_NODES:
            raise self.error(f"nodes[{index}]: the tree of nodes is a loop or too large")
        node = self.item("nodes", index)
        matrix = parent @ _local(node)
        if not np.isfinite(matrix).all():
            raise self.error(f"nodes[{index}]: the matrix holds NaN or infinity")
        if "mesh" in node:
            mesh = self.item("meshes", node["mesh"])
            name = str(node.get("name") or mesh.get("name") or f"mesh {node['mesh']}")[:80]
            for primitive_index, primitive in enumerate(mesh["primitives"]):
                self.primitive(primitive, matrix, name, f"meshes[{node['mesh']}].primitives[{primitive_index}]")
        for child in node.get("children", []):
            self.node(child, matrix, (*above, index))

    def primitive(self, data: dict[str, Any], matrix: F64, name: str, location: str) -> None:
        attributes = data["attributes"]
        mode = data.get("mode", 4)
        if mode not in (4, 5, 6):
            return  # points and lines have no surface
        points = self.accessor(attributes["POSITION"], "VEC3", location)
        if "TEXCOORD_0" not in attributes:
            raise self.error(f"{location}: no texture coordinates (UVs); unwrap the mesh before the export")
        uv = self.accessor(attributes["TEXCOORD_0"], "VEC2", location)
        normals = (
            self.accessor(attributes["NORMAL"], "VEC3", location) if "NORMAL" in attributes else np.zeros_like(points)
        )
        if not len(points) == len(uv) == len(normals):
            raise self.error(f"{location}: attributes have different lengths")
        if "indices" in data:
            indices = self.accessor(data["indices"], "SCALAR", location)[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(points))
        if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
            raise self.error(
                f"{location}: index {int(indices.max())} is out of range (there are {len(points)} vertices)"
            )
        faces = _triangles(indices, mode)
        self.faces += len(faces)
        if self.faces > MAX_FACES:
            raise self.error(f"more than {MAX_FACES} triangles; simplify the mesh")
        linear = matrix[:3, :3]
        determinant = float(np.linalg.det(linear))
        if abs(determinant) < 1e-18:
            raise self.error(f"{location}: its node has a singular matrix")
        # A mirroring node turns its faces inside out.
        if determinant < 0.0:
            faces = faces[:, ::-1]
        positions = points @ linear.T + matrix[:3, 3]
        face_normals = normals @ np.linalg.inv(linear)
        face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-12)
        material_index = len(self.triangles.materials) - 1
        if "material" in data:
            self.item("materials", data["material"])
            material_index = data["material"]
        if name not in self.triangles.groups:
            self.triangles.groups.append(name)
        group = self.triangles.groups.index(name)
        self.triangles.add(positions[faces], uv[faces], face_normals[faces], material=material_index, group=group)

    def accessor(self, index: int, kind: str, location: str) -> F64:
        """Values [n, width] of an accessor as float64."""
        description = self.item("accessors", index)
        label = f"accessors[{index}]"
        if "sparse" in description or "bufferView" not in description:
            raise self.error(f"{label}: sparse accessors are not read; export without them")
        if description.get("type") != kind or description.get("componentType") not in _TYPES:
            raise self.error(
                f"{label}: type {description.get('type')} of {description.get('componentType')} "
                f"where {kind} is needed ({location})"
            )
        count, width = int(description["count"]), _WIDTHS[kind]
        if not 0 <= count <= 3 * MAX_VERTICES:
            raise self.error(f"{label}: {count} entries; simplify the mesh")
        dtype = np.dtype(_TYPES[description["componentType"]])
        buffer_view = self.item("bufferViews", description["bufferView"])
        buffer = self.buffer(buffer_view["buffer"])
        start, size = int(buffer_view.get("byteOffset", 0)), int(buffer_view["byteLength"])
        stride = int(buffer_view.get("byteStride", 0)) or dtype.itemsize * width
        offset = int(description.get("byteOffset", 0))
        # Offsets and counts come from the file: check them before any view into the buffer is made.
        end = offset + (count - 1) * stride + dtype.itemsize * width if count else 0
        if min(start, size, offset) < 0 or stride < dtype.itemsize * width or start + size > len(buffer) or end > size:
            raise self.error(
                f"{label}: reaches past the end of its buffer ({len(buffer)} bytes): the file is cut short"
            )
        if not count:
            return np.zeros((0, width))
        raw_bytes = np.frombuffer(buffer, np.uint8, count=end, offset=start)[offset:]
        rows = np.lib.stride_tricks.as_strided(raw_bytes, (count, dtype.itemsize * width), (stride, 1))
        values = np.ascontiguousarray(rows).view(dtype).astype(np.float64)
        if description.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return np.asarray(values)

    def buffer(self, index: int) -> bytes:
        if index in self.buffers:
            return self.buffers[index]
        description = self.item("buffers", index)
        uri = description.get("uri")
        if uri is None:
            if self.chunk is None or index != 0:
                raise self.error(f"buffers[{index}] has no data")
            content = self.chunk
        elif uri.startswith("data:"):
            try:
                content = base64.b64decode(uri.split(",", 1)[1], validate=True)
            except (IndexError, binascii.Error):
                raise self.error(f"buffers[{index}]: the data URI is not base64") from None
        else:
            content = safeio.read_bytes(beside(self.file, unquote(uri)), limit=MAX_BYTES)
        if len(content) < int(description["byteLength"]):
            raise self.error(f"buffers[{index}] is cut short: {len(content)} of {description['byteLength']} bytes")
        self.buffers[index] = content
        return content

    def material(self, data: dict[str, Any], index: int) -> Material:
        """Base colour (linear), metal share as specular share, roughness as lack of gloss."""
        metallic_roughness = data.get("pbrMetallicRoughness", {})
        colour = [float(value) for value in metallic_roughness.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])][:3]
        emissive = [float(value) for value in data.get("emissiveFactor", [0.0, 0.0, 0.0])]
        metallic, roughness = (
            float(metallic_roughness.get("metallicFactor", 1.0)),
            float(metallic_roughness.get("roughnessFactor", 1.0)),
        )
        values = np.array([*colour, *emissive, metallic, roughness])
        if len(colour) != 3 or not np.isfinite(values).all():
            raise self.error(f"materials[{index}]: a colour is not three finite numbers")
        red, green, blue = (float(np.clip(value, 0.0, 1.0)) for value in colour)
        specular = 0.04 + 0.46 * float(np.clip(metallic, 0.0, 1.0)) if "metallicFactor" in metallic_roughness else 0.04
        gloss = 1.0 - float(np.clip(roughness, 0.0, 1.0))
        name = str(data.get("name") or f"material {index}")[:80]
        return Material(name, (red, green, blue), specular=specular, gloss=gloss, emission=max(0.0, *emissive))


def _local(node: dict[str, Any]) -> F64:
    """Return the matrix [4, 4] of a node, from its matrix (column by column) or translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(component) for component in node.get("rotation", (0.0, 0.0, 0.0, 1.0)))
    matrix = pose_matrix(np.array(node.get("translation", (0.0, 0.0, 0.0)), np.float64).reshape(3), (w, x, y, z))
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64).reshape(3)
    return matrix


def _triangles(index: npt.NDArray[np.int64], mode: int) -> npt.NDArray[np.int64]:
    """Faces [n, 3] of a list (4), strip (5) or fan (6) of triangles."""
    if mode == 4:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    count = max(len(index) - 2, 0)
    first = np.arange(count)
    if mode == 6:
        return np.stack([index[np.zeros(count, np.int64)], index[first + 1], index[first + 2]], 1)
    # Every second triangle of a strip has the opposite winding.
    parity = first % 2
    return np.stack([index[first], index[first + 1 + parity], index[first + 2 - parity]], 1)
