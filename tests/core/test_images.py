"""Pictures: what is read is what was written, and what is broken, odd or too large is refused in one line."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ssad.core import image_files
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.images import add_caption, decode_image, encode_jpeg, read_image, save_picture


def picture() -> Any:
    across, down = np.meshgrid(np.arange(64), np.arange(48))
    return np.stack([across * 4, down * 5, 255 - across * 3], axis=-1).astype(np.uint8)


def test_images_round_trip(tmp_path: Path) -> None:
    image = picture()
    (tmp_path / "a.jpg").write_bytes(encode_jpeg(image, 98, "444"))
    found = read_image(tmp_path / "a.jpg")
    assert (found.dtype, found.shape) == (np.uint8, (48, 64, 3))
    assert np.abs(found.astype(int) - image).max() <= 6
    cv2.imwrite(str(tmp_path / "a.png"), image[:, :, ::-1])
    assert np.array_equal(read_image(tmp_path / "a.png"), image)
    assert encode_jpeg(image[:, ::-1], 80) == encode_jpeg(image[:, ::-1].copy(), 80)


def png(image: Any) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("half.jpg", encode_jpeg(picture(), 90)[:-300], "truncated JPEG"),
        ("tail.jpg", encode_jpeg(picture(), 90)[:-2], "truncated JPEG"),
        ("head.jpg", encode_jpeg(picture(), 90)[:40], "truncated JPEG"),
        ("half.png", png(picture())[:-100], "truncated PNG"),
        ("flip.png", png(picture())[:60] + b"\x00" + png(picture())[61:], "checksum"),
        ("text.jpg", b"hello", "not a JPEG, PNG, TIFF, BMP, WebP or PNM image"),
        ("empty.jpg", b"", "is empty"),
    ],
)
def test_broken_images(tmp_path: Path, name: str, data: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match=rf"{name}.*{says}"):
        read_image(tmp_path / name)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_image(tmp_path / "gone.jpg")


def chunk(kind: bytes, data: bytes) -> bytes:
    """A block of a PNG with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def plain_png(width: int, height: int, *, colour: int = 2, end: bool = True) -> bytes:
    """A PNG that says its size; black where it has pixels."""
    pixels = zlib.compress((b"\0" + bytes(3 * width)) * min(height, 4))
    blocks = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)) + chunk(b"IDAT", pixels)
    return b"\x89PNG\r\n\x1a\n" + blocks + (chunk(b"IEND", b"") if end else b"")


def test_a_png_is_read_to_its_end_and_no_further() -> None:
    whole = plain_png(5, 4)
    assert decode_image(whole).shape == (4, 5, 3)
    assert decode_image(whole + b"what a tool has added").shape == (4, 5, 3)
    for data in (
        plain_png(5, 4, end=False),
        whole[:-1],
        whole[:-12],
        whole[:8],
        plain_png(5, 4, end=False) + bytes(11),
    ):
        with pytest.raises(FormatError, match="its end is missing"):
            decode_image(data)


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_pictures_over_the_limit_are_refused_before_they_are_unpacked(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = plain_png(8, 4) if kind == "png" else encode_jpeg(np.zeros((4, 8, 3), np.uint8))
    monkeypatch.setattr(image_files, "MAX_PIXELS", 32)
    assert decode_image(data, "it").shape == (4, 8, 3)
    monkeypatch.setattr(image_files, "MAX_PIXELS", 31)
    with pytest.raises(FormatError, match="it: 8 x 4 pixels are more than the limit of 31"):
        decode_image(data, "it")
    with pytest.raises(FormatError, match="more pixels than the limit"):
        decode_image(plain_png(70_000, 70_000))


def test_a_higher_quality_is_nearer_and_444_keeps_colours_apart() -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)

    def error(*how: Any) -> float:
        return float(np.abs(decode_image(encode_jpeg(image, *how)).astype(int) - image).mean())

    assert error(99, "444") < 0.3 * error(99, "420")
    assert error(95) < 0.9 * error(50)
    assert encode_jpeg(image) == encode_jpeg(image, 95, "420")


def test_a_caption_stands_under_the_picture_and_fits() -> None:
    image = np.full((50, 100, 3), (10, 200, 30), np.uint8)
    bare = add_caption(image, "", 300)
    assert bare.shape == (150 + 26 + 2, 300 + 4, 3)
    assert (bare[2:152, 2:302] == (10, 200, 30)).all(), "the picture, three times as large"
    assert (bare[:2] == 255).all()
    assert (bare[:, :2] == 255).all()
    assert (bare[:, -2:] == 255).all()
    assert (bare[152:] == 255).all(), "nothing is written"
    short, long = add_caption(image, "fog 3", 300), add_caption(image, "a word and another " * 3, 300)
    for written in (short, long):
        dark = (written < 128).all(-1)
        assert dark[152:].sum() > 40
        assert not dark[:152].any()
        assert np.flatnonzero(dark.any(0))[0] >= 6
    wide = cv2.getTextSize("fog 3", cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    assert np.ptp(np.flatnonzero((short[152:] < 200).all(-1).any(0))) == pytest.approx(wide, abs=4)
    assert np.flatnonzero((long < 200).all(-1).any(0))[-1] < 300, "the letters shrink until all fit"
    tall = [np.ptp(np.flatnonzero((v < 128).all(-1).any(1))) for v in (short, long)]
    assert tall[0] > tall[1]


def test_pictures_are_saved_by_the_name_of_the_file(tmp_path: Path) -> None:
    image = picture()
    save_picture(tmp_path / "a.PNG", image)
    assert np.array_equal(read_image(tmp_path / "a.PNG"), image)
    for name in ("a.jpg", "b.JPEG"):
        save_picture(tmp_path / name, image)
        assert (tmp_path / name).read_bytes() == encode_jpeg(image, 88, "420")
    with pytest.raises(ConfigError, match=r"a\.gif: pictures are written as \.png or \.jpg"):
        save_picture(tmp_path / "a.gif", image)
    with pytest.raises(StoreError):
        save_picture(tmp_path / "a.jpg" / "b.png", image)


@pytest.mark.parametrize("channels", [1, 3])
def test_an_image_that_was_read_can_be_drawn_on(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.zeros((9, 16, channels), np.uint8))
    image = read_image(path)
    image[0, 0] = (1, 2, 3)
    assert image.shape == (9, 16, 3)
    assert image[0].sum() == 6
