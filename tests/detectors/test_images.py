"""What people hand in as pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.detectors.images import as_images

GREY = "greyscale repeated to three channels"


def pixels(*shape: int, most: int = 255) -> np.ndarray:  # type: ignore[type-arg]
    kind = np.uint8 if most < 256 else np.uint16
    return np.random.default_rng(0).integers(0, most + 1, shape).astype(kind)


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    channels=st.sampled_from([1, 3, 4]),
    batch=st.integers(1, 3),
    kind=st.sampled_from(["uint8", "uint16", "float32", "float64", ">u2"]),
    tensor=st.booleans(),
)
def test_every_form_means_the_same(  # type: ignore[no-untyped-def]
    height, width, channels, batch, kind, tensor
) -> None:
    whole = pixels(batch, height, width, channels, most=255 if kind == "uint8" else 65535)
    most = np.float64(np.iinfo(whole.dtype).max)
    expected = np.repeat(whole, 3, 3) if channels == 1 else whole[..., :3]
    given_ = whole.astype(kind) if "u" in kind else (whole / most).astype(kind)
    x = torch.from_numpy(np.ascontiguousarray(given_.astype(given_.dtype.newbyteorder("=")).transpose(0, 3, 1, 2)))
    found = as_images(x if tensor else given_)
    assert found.tensor.shape == (batch, 3, height, width)
    assert found.tensor.dtype is (torch.float64 if kind == "float64" else torch.float32)
    np.testing.assert_allclose(found.tensor.numpy(), expected.transpose(0, 3, 1, 2) / most, rtol=1e-6)
    assert (GREY in found.notes) == (channels == 1)
    assert ("alpha left out" in found.notes) == (channels == 4)
    single = as_images([x[0]] if tensor else given_[0])
    assert torch.equal(single.tensor[0], found.tensor[0])


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("most", [255, 65535])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_files_keep_their_bits(channels: int, most: int, suffix: str, tmp_path: Path) -> None:
    whole = pixels(5, 7, channels, most=most)
    swapped = whole[..., [2, 1, 0, 3][:channels]] if channels > 1 else whole
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), swapped)
    found = as_images(tmp_path / f"a{suffix}")
    expected = np.repeat(whole, 3, 2) if channels == 1 else whole[..., :3]
    np.testing.assert_allclose(found.tensor[0].permute(1, 2, 0).numpy(), expected / most, rtol=1e-6)
    assert (GREY in found.notes, "alpha left out" in found.notes) == (channels == 1, channels == 4)
    assert ("16 bit" in found.notes) == (most > 255)


def test_other_modes_become_colour(tmp_path: Path) -> None:
    base = Image.fromarray(pixels(6, 8, 3))
    for mode in ("1", "P", "CMYK", "LA"):
        base.convert(mode).save(tmp_path / "a.tiff")
        found = as_images(str(tmp_path / "a.tiff"))
        assert found.tensor.shape == (1, 3, 6, 8)
        assert ("alpha left out" in found.notes) == (mode == "LA")


def test_a_photograph_is_turned_upright(tmp_path: Path) -> None:
    picture = Image.fromarray(pixels(6, 8, 3))
    exif = picture.getexif()
    exif[0x0112] = 6
    picture.save(tmp_path / "a.png", exif=exif)
    expected = np.rot90(np.array(picture), -1) / 255
    found = as_images(tmp_path / "a.png").tensor[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_few_bits_in_sixteen_are_told() -> None:
    assert as_images(pixels(4, 4, 3, most=4095)).notes[0].startswith("16 bit, none above")


def test_gradients_and_precision_are_kept() -> None:
    x = torch.rand(1, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    found = as_images(x).tensor
    found.sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    assert bool((x.grad == 1).all())


BAD = {
    "[H, W, 3]": np.zeros((3, 8, 9), np.uint8),
    "permute": torch.zeros(8, 9, 3),
    "NaN": np.full((4, 4, 3), np.nan),
    "divide by 255": np.full((4, 4, 3), 200.0),
    "floats from -1": torch.full((3, 4, 4), -1.0),
    "uint16": torch.zeros(3, 4, 4, dtype=torch.int16),
    "int64": np.zeros((4, 4, 3), np.int64),
    "a mask": torch.zeros(1, 3, 4, 4, dtype=torch.bool),
    "no picture": [],
    "different sizes": [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)],
    "empty": np.zeros((0, 4, 3), np.uint8),
    "shape": torch.zeros(2, 2, 2, 2, 2),
    "array of": np.zeros((4, 4, 3), "c8"),
    "is no picture": 3.5,
}


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_picture_is_one_line(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        as_images(BAD[text], origin="input")
    assert text in str(caught.value)
    assert str(caught.value).startswith("input")


def test_files_that_are_none_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for suffix in (".png", ".jpg", ".tiff"):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(pixels(40, 50, 3)).save(path)
        whole = path.read_bytes()
        for length in (0, 3, 30, len(whole) // 2):
            path.write_bytes(whole[:length])
            with pytest.raises(FormatError):
                as_images(path)
    (tmp_path / "a.txt").write_text("hello")
    Image.fromarray(pixels(4, 4).astype(np.float32)).save(tmp_path / "f.tiff")
    for name in ("a.txt", "f.tiff", "none.png", "."):
        with pytest.raises(SSADError) as caught:
            as_images(tmp_path / name)
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
