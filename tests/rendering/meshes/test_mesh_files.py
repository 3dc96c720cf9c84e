"""Meshes of users: OBJ and glTF files."""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, FormatError
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.meshes.mesh import Material, Mesh, box
from ssad.rendering.meshes.mesh_files import load_mesh

GREY = Material("grey", (0.5, 0.5, 0.5))


@functools.cache
def body(kind: str, style: str, detail: int = 2) -> Mesh:
    return make_body(kind, style=style, generator=generator("mesh", kind, style), detail=detail)


def face_normals(mesh: Mesh) -> np.ndarray:
    p = mesh.corners()
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


# ---------------------------------------------------------------- OBJ


QUAD = """
mtllib m.mtl
v 0 0 0
v 2 0 0
v 2 1 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
g panel
usemtl body
f 1/1 2/2 3/3 4/4
f -5/1 -3/3 -1/4
"""


def write(folder: Path, text: str, name: str = "m.obj") -> Path:
    (folder / "m.mtl").write_text("newmtl body\nKd 0.1 0.2 0.3\nKs 0.2 0.2 0.2\nNs 250\nKe 0 0 0\n")
    path = folder / name
    path.write_text(text)
    return path


def test_obj_reads_polygons_negative_indices_and_colours(tmp_path: Path) -> None:
    mesh = load_mesh(write(tmp_path, QUAD))
    assert len(mesh.faces) == 3
    assert mesh.panels == ("panel",)
    (look,) = mesh.materials
    assert (look.name, look.colour, look.paint) == ("body", (0.1, 0.2, 0.3), True)
    assert (look.specular, look.gloss) == pytest.approx((0.2, 0.5))
    assert mesh.areas()[:2].sum() == pytest.approx(2.0)
    low, high = mesh.bounds()
    np.testing.assert_allclose([low, high], [[-1.0, -0.5, 0.0], [1.0, 0.5, 1.0]], atol=1e-6)
    # v runs down: the file's lower left corner is the lower left of the image
    first = np.argmin(np.linalg.norm(mesh.corners()[:2] - low, axis=-1).reshape(-1))
    np.testing.assert_allclose(mesh.uv[:2].reshape(-1, 2)[first], [0.0, 1.0], atol=1e-6)


def test_obj_units_axes_and_size(tmp_path: Path) -> None:
    path = write(tmp_path, QUAD)
    low, high = load_mesh(path, unit=0.5, up="y", forward="-z").bounds()
    np.testing.assert_allclose(high - low, [0.5, 1.0, 0.5], atol=1e-6)
    low, high = load_mesh(path, size=(4.0, 2.0, 1.5)).bounds()
    np.testing.assert_allclose(high - low, [4.0, 2.0, 1.5], atol=1e-5)
    with pytest.raises(ConfigError, match="not two different axes"):
        load_mesh(path, up="z", forward="-z")
    with pytest.raises(ConfigError, match="unit"):
        load_mesh(path, unit=0.0)


def test_a_concave_polygon_keeps_its_area(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nv 0 0 1\nvt 0 0\n"
    mesh = load_mesh(write(tmp_path, text + "f 1/1 2/1 3/1 4/1 5/1 6/1\nf 1/1 2/1 7/1\n"))
    assert mesh.areas().sum() == pytest.approx(3.0 + 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", r"m\.obj:4: a face has no texture coordinates"),
        ("v 0 0 nan\n", r"m\.obj:1: NaN"),
        ("v 0 0 inf\n", r"m\.obj:1: NaN or infinity"),
        ("v 0 0\n", r"m\.obj:1: 2 numbers where 3"),
        ("v a b c\n", r"m\.obj:1: 'a b c' is not a list of numbers"),
        ("v 0 0 0\nvt 0 0\nf 1/1 2/1 1/1\n", r"m\.obj:3: vertex index 2 is out of range \(there are 1\)"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/7 1/1\n", r"m\.obj:3: texture index 7"),
        ("v 0 0 0\nvt 0 0\nf 0/1 1/1 1/1\n", r"m\.obj:3: vertex index 0"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/1\n", r"m\.obj:3: a face needs three corners"),
        ("v 0 0 0\nvt 0 0\nf x 1/1 1/1\n", r"m\.obj:3: 'x' is not a corner"),
        ("v 0 0 0\nvt 0 0\nf 1/1" + " 1/1" * 1200 + "\n", "triangulate the mesh"),
        ("mtllib ../../etc/passwd\n", "outside its folder"),
        ("mtllib /etc/passwd\n", "outside its folder"),
        ("mtllib missing.mtl\n", r"missing\.mtl: no such file"),
        ("# nothing\n", "no faces"),
        (QUAD.replace("vt 1 1", "vt 1 5"), "over a tile's edge"),
        (QUAD.replace("v 2", "v 2e9"), "set unit"),
    ],
)
def test_broken_obj_files_get_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, text)
    with pytest.raises(FormatError, match=message) as error:
        load_mesh(path)
    assert "\n" not in str(error.value)


def test_other_broken_files(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        load_mesh(tmp_path / "none.obj")
    with pytest.raises(FormatError, match=r"give an \.obj, \.gltf or \.glb file"):
        load_mesh(tmp_path / "body.fbx")
    (tmp_path / "binary.obj").write_bytes(b"\xff\xfe\x00v 0 0 0")
    with pytest.raises(FormatError, match="not UTF-8"):
        load_mesh(tmp_path / "binary.obj")
    path = write(tmp_path, QUAD)
    with pytest.raises(ConfigError, match="no material 'hull' to paint; it has: body"):
        load_mesh(path, paint=["hull"])
    (tmp_path / "m.mtl").write_text("newmtl body\nKd red\n")
    with pytest.raises(FormatError, match=r"m\.mtl:2: 'Kd red' is not a colour"):
        load_mesh(path)


def test_tiled_coordinates_pass_on_what_is_not_painted(tmp_path: Path) -> None:
    text = QUAD.replace("vt 1 1", "vt 1 5").replace("usemtl body", "usemtl tyre")
    text += "usemtl body\nvt 3.25 2.5\nvt 3.75 2.5\nvt 3.75 2.75\nf 1/5 2/6 5/7\n"
    mesh = load_mesh(write(tmp_path, text), paint=["body"])
    assert mesh.painted().sum() == 1
    np.testing.assert_allclose(mesh.uv[mesh.painted()][0], [[0.25, 0.5], [0.75, 0.5], [0.75, 0.25]], atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet="vftnmgo /0123456789.-e\n#\\u", max_size=200))
def test_any_text_is_a_mesh_or_one_line(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("obj") / "m.obj"
    path.write_text(text)
    with pytest.raises(FormatError):
        load_mesh(path)


# ---------------------------------------------------------------- glTF


def gltf_tree(mesh: Mesh) -> tuple[dict, bytes]:
    """A glTF tree (y up, front to +z) and its buffer, one primitive for each material."""
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    blob = b""
    views, accessors, primitives = [], [], []

    def add(array: np.ndarray, component: int, kind: str) -> int:
        nonlocal blob
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        blob += data + b"\0" * (-len(data) % 4)
        return len(accessors) - 1

    for k in range(len(mesh.materials)):
        chosen = mesh.material == k
        corners = mesh.corners()[chosen].reshape(-1, 3)
        attributes = {
            "POSITION": add((corners @ turn.T).astype("<f4"), 5126, "VEC3"),
            "NORMAL": add((mesh.normals[chosen].reshape(-1, 3) @ turn.T).astype("<f4"), 5126, "VEC3"),
            "TEXCOORD_0": add(mesh.uv[chosen].reshape(-1, 2).astype("<f4"), 5126, "VEC2"),
        }
        indices = add(np.arange(len(corners), dtype="<u4"), 5125, "SCALAR")
        primitives.append({"attributes": attributes, "indices": indices, "material": k})
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "scale": [0.5, 0.5, 0.5]}, {"mesh": 0, "name": "hull", "scale": [2.0, 2.0, 2.0]}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "name": m.name,
                "pbrMetallicRoughness": {"baseColorFactor": [*m.colour, 1.0], "roughnessFactor": 1.0 - m.gloss},
            }
            for m in mesh.materials
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    return tree, blob


def save_glb(path: Path, tree: dict, blob: bytes) -> None:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize("form", ["glb", "data URI", "file"])
def test_gltf_round_trip(form: str, tmp_path: Path) -> None:
    mesh = body("car", "suv", 1)
    tree, blob = gltf_tree(mesh)
    path = tmp_path / ("m.glb" if form == "glb" else "m.gltf")
    if form == "glb":
        save_glb(path, tree, blob)
    else:
        (tmp_path / "the data.bin").write_bytes(blob)
        uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
        tree["buffers"][0]["uri"] = uri if form == "data URI" else "the%20data.bin"
        path.write_text(json.dumps(tree))
    read = load_mesh(path)
    order = np.argsort(mesh.material, kind="stable")
    np.testing.assert_allclose(read.corners(), mesh.corners()[order], atol=1e-4)
    np.testing.assert_allclose(read.normals, mesh.normals[order], atol=1e-3)
    np.testing.assert_allclose(read.uv, mesh.uv[order], atol=1e-5)
    assert read.panels == ("hull",)
    assert [m.name for m in read.materials][:-1] == [m.name for m in mesh.materials]
    np.testing.assert_allclose(read.materials[0].colour, mesh.materials[0].colour)


def test_gltf_strips_fans_mirrors_and_normalised_coordinates(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], "<f4")
    uv = np.array([[0, 0], [65535, 0], [0, 65535], [65535, 65535]], "<u2")
    blob = corners.tobytes() + uv.tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}, {"mesh": 0, "scale": [-1, 1, 1], "rotation": [0, 0, 0, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "mode": 5}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 4, "type": "VEC2", "normalized": True},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 16}],
        "buffers": [{"byteLength": 64}],
    }
    save_glb(tmp_path / "m.glb", tree, blob)
    mesh = load_mesh(tmp_path / "m.glb", up="z", forward="x")
    assert len(mesh.faces) == 4
    assert (face_normals(mesh)[:, 2] > 0).all(), "a strip turns every other triangle, a mirror all of them"
    assert mesh.uv.max() == 1.0
    tree["meshes"][0]["primitives"][0]["mode"] = 6
    save_glb(tmp_path / "m.glb", tree, blob)
    assert len(load_mesh(tmp_path / "m.glb").faces) == 4


def set_in(tree: dict, path: str, value: object) -> None:
    *head, last = [int(p) if p.isdigit() else p for p in path.split("/")]
    for key in head:
        tree = tree[key]
    if value is None:
        del tree[last]
    else:
        tree[last] = value


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("asset/version", "1.0", "only version 2"),
        ("extensionsRequired", ["KHR_draco_mesh_compression"], "requires the extension KHR_draco"),
        ("meshes/0/primitives/0/attributes/TEXCOORD_0", None, "no texture coordinates"),
        ("meshes/0/primitives/0/attributes/POSITION", 99, r"accessors\[99\] does not exist"),
        ("accessors/0/count", 10**12, "simplify the mesh"),
        ("accessors/0/count", 2000, "cut short"),
        ("accessors/0/count", -1, "entries"),
        ("accessors/0/byteOffset", -4, "cut short"),
        ("accessors/0/type", "MAT4", "where VEC3 is needed"),
        ("accessors/0/sparse", {}, "sparse"),
        ("bufferViews/0/byteLength", 10**9, "cut short"),
        ("bufferViews/0/byteStride", 2, "cut short"),
        ("buffers/0/byteLength", 10**9, "cut short"),
        ("buffers/0/uri", "../secret.bin", "outside its folder"),
        ("buffers/0/uri", "file:///etc/passwd", "outside its folder"),
        ("buffers/0/uri", "http://example.org/x.bin", "outside its folder"),
        ("buffers/0/uri", "data:application/octet-stream;base64,!!", "not base64"),
        ("nodes/1/children", [0], "loop"),
        ("nodes/1/scale", [0, 1, 1], "singular"),
        ("nodes/1/scale", [1], "not a valid glTF file|singular|triangles"),
        ("nodes/1/rotation", "north", "not a valid glTF file"),
        ("nodes/1/mesh", -1, r"meshes\[-1\] does not exist"),
        ("scenes/0/nodes", [], "no triangles"),
        ("materials/0/pbrMetallicRoughness", {"baseColorFactor": ["red", 0, 0]}, "not a valid glTF file"),
        ("meshes", "none", "not a valid glTF file|does not exist"),
    ],
)
def test_broken_gltf_files_get_one_line(path: str, value: object, message: str, tmp_path: Path) -> None:
    tree, blob = gltf_tree(box((1.0, 1.0, 1.0), material=GREY))
    set_in(tree, path, value)
    if "scale" in path and value == [1]:
        message = "not a valid glTF file"
    save_glb(tmp_path / "m.glb", tree, blob)
    with pytest.raises(FormatError, match=message) as error:
        load_mesh(tmp_path / "m.glb")
    assert "\n" not in str(error.value)


def test_gltf_values_that_break_geometry(tmp_path: Path) -> None:
    tree, blob = gltf_tree(box((1.0, 1.0, 1.0), material=GREY))
    bad = bytearray(blob)
    bad[:4] = struct.pack("<f", np.nan)
    save_glb(tmp_path / "m.glb", tree, bytes(bad))
    with pytest.raises(FormatError, match="vertices hold NaN"):
        load_mesh(tmp_path / "m.glb")
    start = tree["bufferViews"][-1]["byteOffset"]
    bad = bytearray(blob)
    bad[start : start + 4] = struct.pack("<I", 4_000_000)
    save_glb(tmp_path / "m.glb", tree, bytes(bad))
    with pytest.raises(FormatError, match="index 4000000 is out of range"):
        load_mesh(tmp_path / "m.glb")


@settings(max_examples=60, deadline=None)
@given(cut=st.integers(0, 3000), flip=st.integers(0, 3000), value=st.integers(0, 255))
def test_damaged_glb_files_get_one_line_or_load(
    tmp_path_factory: pytest.TempPathFactory, cut: int, flip: int, value: int
) -> None:
    tree, blob = gltf_tree(box((1.0, 1.0, 1.0), material=GREY))
    path = tmp_path_factory.mktemp("glb") / "m.glb"
    save_glb(path, tree, blob)
    data = bytearray(path.read_bytes())
    data[flip % len(data)] = value
    path.write_bytes(bytes(data[: len(data) - cut % len(data)] if cut % 2 else data))
    with contextlib.suppress(FormatError):
        load_mesh(path).check()
