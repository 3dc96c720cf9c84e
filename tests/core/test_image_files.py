"""Image files of every format: upright when read, written anew like the original, refused where neither is possible."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from ssad.core.errors import FormatError
from ssad.core.image_files import (
    FORMATS,
    ImageFile,
    check_writable,
    decode_image_file,
    encode_like,
    encode_png,
    is_image,
    turn_back,
    turn_upright,
)
from ssad.core.images import decode_image, read_annotated_image, read_image

ORIENTATION = 0x0112


def street() -> Any:
    """A smooth image [48, 64, 3] without symmetry."""
    across, down = np.meshgrid(np.arange(64), np.arange(48))
    return np.stack([across * 3 + 20, down * 4 + 10, 200 - across * 2 - down], axis=-1).astype(np.uint8)


def encoded(image: Image.Image, kind: str, *, orientation: int = 1, **options: Any) -> bytes:
    stream = io.BytesIO()
    if orientation != 1:
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        options["exif"] = exif
    image.save(stream, kind, **options)
    return stream.getvalue()


def foggy(image_file: ImageFile) -> Any:
    return (image_file.rgb * 0.5 + 100).astype(np.uint8)


COLOUR = Image.fromarray(street())
ALPHA = Image.fromarray(np.dstack([street(), np.arange(48 * 64).reshape(48, 64).astype(np.uint8)]))
# name: the bytes, the format, the colour model, whether it has alpha, the largest difference of a lossy file
FILES: dict[str, tuple[bytes, str, str, bool, int]] = {
    "jpeg": (encoded(COLOUR, "JPEG", quality=95), "JPEG", "RGB", False, 8),
    "progressive": (encoded(COLOUR, "JPEG", quality=95, progressive=True), "JPEG", "RGB", False, 8),
    "grey jpeg": (encoded(COLOUR.convert("L"), "JPEG", quality=95), "JPEG", "grey", False, 4),
    "cmyk jpeg": (encoded(COLOUR.convert("CMYK"), "JPEG", quality=98), "JPEG", "CMYK", False, 14),
    "png": (encoded(COLOUR, "PNG"), "PNG", "RGB", False, 0),
    "grey png": (encoded(COLOUR.convert("L"), "PNG"), "PNG", "grey", False, 0),
    "bilevel png": (encoded(COLOUR.convert("1"), "PNG"), "PNG", "grey", False, 0),
    "palette png": (encoded(COLOUR.quantize(64), "PNG"), "PNG", "RGB", False, 0),
    "alpha png": (encoded(ALPHA, "PNG"), "PNG", "RGB", True, 0),
    "grey alpha png": (encoded(ALPHA.convert("LA"), "PNG"), "PNG", "grey", True, 0),
    "webp": (encoded(COLOUR, "WEBP", quality=95), "WEBP", "RGB", False, 14),
    "exact webp": (encoded(COLOUR, "WEBP", lossless=True), "WEBP", "RGB", False, 0),
    "alpha webp": (encoded(ALPHA, "WEBP", lossless=True, exact=True), "WEBP", "RGB", True, 0),
    "bmp": (encoded(COLOUR, "BMP"), "BMP", "RGB", False, 0),
    "grey bmp": (encoded(COLOUR.convert("L"), "BMP"), "BMP", "grey", False, 0),
    "tiff": (encoded(COLOUR, "TIFF", compression="tiff_lzw"), "TIFF", "RGB", False, 0),
    "cmyk tiff": (encoded(COLOUR.convert("CMYK"), "TIFF"), "TIFF", "CMYK", False, 0),
    "grey alpha tiff": (encoded(ALPHA.convert("LA"), "TIFF"), "TIFF", "grey", True, 0),
    "ppm": (encoded(COLOUR, "PPM"), "PPM", "RGB", False, 0),
    "pgm": (encoded(COLOUR.convert("L"), "PPM"), "PPM", "grey", False, 0),
    "text pgm": (b"P2\n# a comment\n2 3\n255\n0 10\n20 30\n200 255\n", "PPM", "grey", False, 0),
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_is_read_and_written_with_its_own_channels(name: str) -> None:
    data, kind, model, has_alpha, tolerance = FILES[name]
    image_file = decode_image_file(data, name)
    assert (image_file.format, image_file.model, image_file.alpha is not None) == (kind, model, has_alpha)
    with Image.open(io.BytesIO(data)) as pillow_image:
        expected = np.asarray(pillow_image.convert("L" if model == "grey" else "RGB").convert("RGB"))
    assert image_file.rgb.shape == expected.shape
    assert np.abs(image_file.rgb.astype(int) - expected).max() == 0
    assert decode_image(data).tobytes() == image_file.rgb.tobytes()
    assert image_file.rgb.std() > 20
    assert image_file.rgb.flags.writeable, "torch warns of arrays that are not"
    changed = foggy(image_file)
    result = decode_image_file(encode_like(image_file, changed, quality=98, subsampling="444"), name)
    assert (result.format, result.model, result.alpha is not None) == (kind, model, has_alpha)
    assert result.pixels.shape == image_file.pixels.shape
    assert np.abs(result.rgb.astype(int) - changed).max() <= max(tolerance, 1 if model == "grey" else 0)
    if has_alpha:
        assert np.array_equal(result.alpha, image_file.alpha)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_orientation_is_the_same_in_the_original_in_the_result_and_when_read(kind: str, orientation: int) -> None:
    data = encoded(COLOUR, kind, orientation=orientation)
    with Image.open(io.BytesIO(data)) as pillow_image:
        expected = np.asarray(ImageOps.exif_transpose(pillow_image).convert("RGB"))
    image_file = decode_image_file(data)
    assert np.array_equal(image_file.rgb, expected)
    assert image_file.rgb.shape[:2] == ((64, 48) if orientation > 4 else (48, 64))
    assert any("upright" in note for note in image_file.notes) == (orientation != 1)
    result = encode_like(image_file, image_file.rgb, quality=98, subsampling="444")
    with Image.open(io.BytesIO(result)) as stored:
        # TIFF readers turn the pixels themselves, so a TIFF is written upright.
        stored_orientation = stored.getexif().get(ORIENTATION, 1)
        assert stored_orientation == (1 if kind == "TIFF" else orientation)
        assert stored.size == (COLOUR.size if kind != "TIFF" else expected.shape[1::-1])
        upright = np.asarray(ImageOps.exif_transpose(stored).convert("RGB"))
    assert np.abs(upright.astype(int) - expected).max() <= (0 if kind in ("PNG", "TIFF") else 16)
    assert np.array_equal(turn_back(turn_upright(street(), orientation), orientation), street())


def deep(*, channels: int, maximum: int = 65535) -> Any:
    """A smooth image [48, 64, channels] of 16 bits."""
    image = (street().astype(np.uint32) * maximum // 255).astype(np.uint16)
    return np.dstack([image, image[..., :1]])[..., :channels]


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pnm"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_read_in_full_and_written_as_sixteen(suffix: str, channels: int) -> None:
    if suffix == ".pnm" and channels == 4:
        return
    image = deep(channels=channels)
    kind = suffix if suffix != ".pnm" else ".pgm" if channels == 1 else ".ppm"
    data = cv2.imencode(kind, image[..., [2, 1, 0, 3][:channels]] if channels > 1 else image)[1].tobytes()
    image_file = decode_image_file(data)
    assert np.array_equal(image_file.pixels, image[..., : 1 if channels == 1 else 3])
    assert (image_file.alpha is not None) == (channels == 4)
    expected = np.round(image[..., :3] / 257)
    assert np.abs(image_file.rgb - expected[..., : image_file.pixels.shape[2]]).max() == 0
    result = decode_image_file(encode_like(image_file, foggy(image_file)))
    assert result.pixels.dtype == np.uint16
    assert result.pixels.shape == image_file.pixels.shape
    assert np.abs(result.rgb.astype(int) - foggy(image_file)).max() <= 1


def test_a_turned_png_of_sixteen_bits_is_turned_once() -> None:
    stream = io.BytesIO()
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    stored = deep(channels=1)[..., 0]
    for kind in ("PNG", "TIFF"):
        stream = io.BytesIO()
        Image.fromarray(stored).save(stream, kind, exif=exif)
        image_file = decode_image_file(stream.getvalue())
        assert np.array_equal(image_file.pixels[..., 0], np.rot90(stored, -1)), kind
        again = decode_image_file(encode_like(image_file, image_file.rgb))
        assert np.array_equal(again.rgb, image_file.rgb), kind


def test_tiff_with_channels_in_planes_is_read_or_refused() -> None:
    def tiff(image: Any) -> bytes:
        """A TIFF that holds red, then green, then blue."""
        height, width, _ = image.shape
        planes = [image[..., channel].tobytes() for channel in range(3)]
        bits, size = 8 * image.itemsize, len(planes[0])
        table = 8 + 3 * size
        directory = table + 8 + 24
        tags = [(256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, table), (259, 3, 1, 1), (262, 3, 1, 2)]
        tags += [(273, 4, 3, table + 8), (277, 3, 1, 3), (278, 3, 1, height), (279, 4, 3, table + 20), (284, 3, 1, 2)]
        values = struct.pack("<4H6I", bits, bits, bits, 0, 8, 8 + size, 8 + 2 * size, size, size, size)
        rows = b"".join(struct.pack("<HHII", *tag) for tag in tags)
        header = struct.pack("<2sHI", b"II", 42, directory)
        return header + b"".join(planes) + values + struct.pack("<H", len(tags)) + rows + bytes(4)

    assert np.array_equal(decode_image_file(tiff(street())).rgb, street())
    with pytest.raises(FormatError, match=r"^a\.tif: 16 bits a channel in separate planes"):
        decode_image_file(tiff(deep(channels=3)), "a.tif")


def test_values_of_a_pnm_are_shares_of_its_maximum() -> None:
    for header, count in ((b"P5\n3 1\n1023\n", 1), (b"P6\n1 1\n1023\n", 3)):
        image_file = decode_image_file(header + np.array([0, 512, 1023], ">u2").tobytes())
        assert image_file.pixels.shape[2] == count
        assert image_file.pixels.ravel().tolist() == [0, round(512 * 65535 / 1023), 65535]


def test_what_cannot_be_written_without_a_loss_is_refused_by_name() -> None:
    def refusal(data: bytes) -> str:
        with pytest.raises(FormatError) as caught:
            check_writable(decode_image_file(data, "a.file"))
        return str(caught.value)

    pages = encoded(COLOUR, "TIFF", save_all=True, append_images=[COLOUR, COLOUR])
    assert refusal(pages).startswith("a.file: it has 3 frames or pages")
    moving = encoded(COLOUR, "WEBP", save_all=True, append_images=[ImageOps.flip(COLOUR)])
    assert "2 frames" in refusal(moving)
    assert "the first of 2 frames" in decode_image_file(moving).notes
    assert "no value above 1069" in refusal(encode_png(deep(channels=1, maximum=1305)))
    rows = b"".join(b"\0" + row.tobytes() for row in deep(channels=4).astype(">u2")[..., :2])

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 48, 16, 4, 0, 0, 0))
    grey_alpha = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    assert decode_image_file(grey_alpha).pixels.shape == (48, 64, 1)
    assert "grey with alpha and 16 bits" in refusal(grey_alpha)


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_short_is_one_line(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data = FILES[name][0]
    lengths = [1, 10, 30, len(data) // 2, len(data) - max(len(data) // 10, 4)]
    if name.startswith("text"):
        lengths = [2]
    for length in lengths:
        with pytest.raises(FormatError) as caught:
            decode_image_file(data[:length], "a.file")
        assert str(caught.value).startswith("a.file: ")
        assert "\n" not in str(caught.value)
    assert capfd.readouterr().out == ""


def test_the_tag_of_an_image_holds_no_more_than_its_orientation() -> None:
    """A camera's preview would be an unshifted image within the shifted one."""
    exif = Image.Exif()
    exif[ORIENTATION], exif[0x010E] = 6, "a place"
    stream = io.BytesIO()
    COLOUR.save(stream, "JPEG", exif=exif, icc_profile=b"a profile")
    result = encode_like(decode_image_file(stream.getvalue()), np.zeros((64, 48, 3), np.uint8))
    assert b"a place" not in result
    with Image.open(io.BytesIO(result)) as written:
        assert dict(written.getexif()) == {ORIENTATION: 6}
        assert "icc_profile" not in written.info


def test_annotations_mean_the_stored_pixels_unless_only_the_upright_ones_fit(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encoded(COLOUR, "PNG", orientation=6))
    upright = read_image(tmp_path / "a.png")
    assert upright.shape == (64, 48, 3)
    stored = read_annotated_image(tmp_path / "a.png", width=64, height=48)
    assert np.array_equal(stored, street())
    assert np.array_equal(read_annotated_image(tmp_path / "a.png", width=48, height=64), upright)
    assert np.array_equal(read_annotated_image(tmp_path / "a.png", width=0, height=0), street())
    with pytest.raises(FormatError, match=r"a\.png: 64 x 48 pixels, the annotations say 64 x 64"):
        read_annotated_image(tmp_path / "a.png", width=64, height=64)


def test_images_are_told_by_name_or_content(tmp_path: Path) -> None:
    assert {kind for _, kind, _, _, _ in FILES.values()} == set(FORMATS)
    for name, (data, *_) in FILES.items():
        (tmp_path / "no suffix").write_bytes(data)
        assert is_image(tmp_path / "no suffix") == (name != "text pgm"), name
    for name in ("a.gif", "b.HEIC", "c.mp4", "d.jpg"):
        (tmp_path / name).write_bytes(b"")
        assert is_image(tmp_path / name)
    for name, text in {"P.txt": b"P2 250 0 160 1", "calib.txt": b"P0: 1 0 0", "a.json": b"{}", "empty": b""}.items():
        (tmp_path / name).write_bytes(text)
        assert not is_image(tmp_path / name)
    (tmp_path / "moving").write_bytes(encoded(COLOUR, "GIF"))
    assert is_image(tmp_path / "moving")
