"""Textures for print and for other programs: true size, and an OBJ that shows what the renderer shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.core.images import read_image
from ssad.rendering.meshes.mesh_files import load_mesh
from ssad.rendering.target import TargetCar, TargetSign
from ssad.scenarios.static.physical import Camouflage, Patch, control
from ssad.scenarios.static.physical.textures.export import PrintedTexture, export_texture, load_printed_texture


def test_a_patch_has_its_true_size_and_lies_where_the_target_wears_it(tmp_path: Path) -> None:
    surface = Patch(width=1.2, height=0.4, texels=24).on(TargetCar().mesh())
    colour = control("random", surface.size, seed=3)
    made = PrintedTexture(colour, "patch", {"width": 1.2, "height": 0.4, "texels": 24}, "sedan:silver:0")
    written = export_texture(tmp_path, made, dots=500, name="mine")
    assert all(path.is_file() for path in written)
    with Image.open(tmp_path / "print.png") as image:
        assert image.size == (600, 200)
        assert image.info["dpi"] == pytest.approx((12.7, 12.7))
    printed = read_image(tmp_path / "print.png").astype(float) / 255
    # the middle of each texel, as far from others as can be
    middle = printed[12::25, 12::25][: surface.size[0], : surface.size[1]]
    assert np.abs(middle - colour.permute(1, 2, 0).numpy()).max() < 0.05
    atlas = read_image(tmp_path / "atlas.png").astype(float) / 255
    u0, v0, u1, v1 = surface.layer.rectangle
    for share in (0.1, 0.6):
        u, v = u0 + share * (u1 - u0), v0 + 0.3 * (v1 - v0)
        seen = atlas[int(v * 2048), int(u * 2048)]
        texel = colour[:, int(0.3 * surface.size[0]), int(share * surface.size[1])].numpy()
        assert np.abs(seen - texel).max() < 0.2
    about = safeio.read_json(tmp_path / "texture.json")
    assert about["metres"] == [1.2, 0.4]
    assert about["panels"]["rear"]["metres"][0] > 1.2
    assert 0.0 < about["non_printability"] < 0.5
    assert 0.0 < about["delta_e"] < 100.0
    again = load_printed_texture(tmp_path)
    assert torch.equal(again.colour, colour)
    assert again.on(TargetCar().mesh()).layer == surface.layer
    edit = again.edit(replace(TargetCar(), size=(5.2, 2.0, 2.0)).mesh())
    assert edit.textures[0].shape == (3, 8, 24), "also on a body of another size"
    (tmp_path / "texture.npz").write_bytes((tmp_path / "texture.npz").read_bytes() + b"x")
    with pytest.raises(FormatError, match="not the texture that"):
        load_printed_texture(tmp_path)
    (tmp_path / "texture.npz").unlink()
    with pytest.raises(SSADError, match=r"texture\.npz"):
        load_printed_texture(tmp_path)


def test_the_obj_is_the_target_with_its_atlas(tmp_path: Path) -> None:
    target = TargetCar("hatchback", "red")
    mesh, surface = target.mesh(), Camouflage(texels=16).on(target.mesh())
    made = PrintedTexture(control("noise", surface.size), "camouflage", {"texels": 16}, "hatchback:red:0")
    export_texture(tmp_path, made, dots=20)
    read = load_mesh(tmp_path / "target.obj")
    assert len(read.faces) == len(mesh.faces)
    assert read.bounds()[1] - read.bounds()[0] == pytest.approx(target.full_size, abs=1e-3)

    low = mesh.bounds()[0]
    assert low[2] == pytest.approx(0.0, abs=1e-3)
    names = np.array([m.name for m in read.materials])[read.material]
    own, found = mesh.corners()[mesh.panel >= 0], read.corners()[names == "texture"]
    assert len(own) == len(found), "the material with the picture is on all panels and nowhere else"
    assert np.sort(own.sum((1, 2))) == pytest.approx(np.sort(found.sum((1, 2))), abs=2e-3)
    order, other = np.lexsort(np.round(own, 2).reshape(-1, 9).T), np.lexsort(np.round(found, 2).reshape(-1, 9).T)
    alike = np.abs(mesh.uv[mesh.panel >= 0][order] - read.uv[names == "texture"][other]).max((1, 2)) < 1e-4
    assert alike.mean() > 0.95, "the same place of the atlas on the same face"
    text = (tmp_path / "target.mtl").read_text()
    assert "map_Kd atlas.png" in text


def test_what_cannot_be_printed_ends_in_one_line(tmp_path: Path) -> None:
    options = {"panel": "face", "width": 0.4, "height": 0.4, "texels": 8}
    sign = PrintedTexture(torch.full((3, 8, 8), 0.5), "patch", options, "stop_sign")
    with pytest.raises(ConfigError, match="dots; from 1 to 16384"):
        export_texture(tmp_path, sign, dots=100_000)
    assert export_texture(tmp_path, sign, dots=100)
    assert sign.live(1).attacked_model(("car",), "key") == "stop_sign"
    with pytest.raises(ConfigError, match="8 x 8 texels, a patch on this body 4 x 4"):
        replace(sign, options=options | {"texels": 4}).on(TargetSign().mesh())
