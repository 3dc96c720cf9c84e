"""Image files, fully checked when read and written as bytes; captions. Images are uint8 [H, W, 3] RGB."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from ssad.core.errors import ConfigError, FormatError
from ssad.core.safeio import read_bytes, write_atomic
from ssad.core.types import U8

MAX_PIXELS = 1 << 26
_PNG = b"\x89PNG\r\n\x1a\n"
CAPTION_HEIGHT = 26  # pixels


def read_image(path: str | Path) -> U8:
    """Read a JPEG or PNG as uint8 [H, W, 3] RGB.

    Raises:
        FormatError: The file is missing or truncated, is not an image, or is grey, has alpha or 16 bits.
    """
    return decode_image(read_bytes(path), str(path))


def decode_image(data: bytes, name: str = "<image>") -> U8:
    """The same from the bytes of a file; `name` is what errors call it."""
    if data[:3] == b"\xff\xd8\xff":
        return _decode_jpeg(data, name)
    if data[: len(_PNG)] == _PNG:
        return _decode_png(data, name)
    raise FormatError(f"{name}: not a JPEG or PNG image{' (the file is empty)' if not data else ''}")


def _decode_jpeg(data: bytes, name: str) -> U8:
    try:
        height, width, colour_space, _ = simplejpeg.decode_jpeg_header(data)
        if colour_space == "Gray":
            raise FormatError(f"{name}: a greyscale image; three colour channels are needed")
        if colour_space in ("CMYK", "YCCK"):
            raise FormatError(f"{name}: a {colour_space} image; RGB colours are needed")
        _check_pixels(width, height, name)
        image: U8 = simplejpeg.decode_jpeg(data, "RGB")  # strict: a file cut short raises
    except ValueError as error:
        raise FormatError(f"{name}: a broken or truncated JPEG: {error}") from None
    return image


def _decode_png(data: bytes, name: str) -> U8:
    """Every chunk's checksum is checked first: OpenCV fills what is missing with grey and says nothing."""
    position, has_end = len(_PNG), False
    while position + 12 <= len(data) and not has_end:
        chunk_size = int.from_bytes(data[position : position + 4], "big")
        chunk_type, chunk_end = data[position + 4 : position + 8], position + 12 + chunk_size
        if chunk_end > len(data):
            break
        if zlib.crc32(data[position + 4 : chunk_end - 4]) != int.from_bytes(data[chunk_end - 4 : chunk_end], "big"):
            raise FormatError(
                f"{name}: a broken PNG: the checksum of its {chunk_type.decode('latin-1')} block is wrong"
            )
        if chunk_type == b"IHDR" and chunk_size == 13:
            width, height, bit_depth, colour_type = struct.unpack_from(">IIBB", data, position + 8)
            _check_pixels(width, height, name)
            if bit_depth == 16:
                raise FormatError(f"{name}: 16 bits a channel; 8 are needed")
            if colour_type in (0, 4):
                raise FormatError(f"{name}: a greyscale image; three colour channels are needed")
            if colour_type == 6:
                raise FormatError(f"{name}: it has an alpha channel; save it as JPEG, or as PNG without transparency")
        position, has_end = chunk_end, chunk_type == b"IEND"
    if not has_end:
        raise FormatError(f"{name}: a truncated PNG: its end is missing")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise FormatError(f"{name}: not a readable 8 bit RGB image")
    return np.ascontiguousarray(image[:, :, ::-1])


def _check_pixels(width: int, height: int, name: str) -> None:
    if width * height > MAX_PIXELS:
        raise FormatError(f"{name}: {width} x {height} pixels are more than the limit of {MAX_PIXELS}")


def encode_jpeg(image: U8, quality: int = 95, subsampling: str = "420") -> bytes:
    """Return a JPEG of uint8 [H, W, 3] RGB; subsampling 420 as in the originals, 444 keeps colour noise."""
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", subsampling, fastdct=False))


def add_caption(image: U8, caption: str, width: int) -> U8:
    """Return an image of the given width with its caption below."""
    height = round(image.shape[0] * width / image.shape[1])
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    caption_band = np.full((CAPTION_HEIGHT, width, 3), 255, np.uint8)
    scale = 0.5
    # Long captions shrink until they fit, but stay legible.
    while scale > 0.25 and cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width - 12:
        scale -= 0.05
    cv2.putText(caption_band, caption, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, scale, (30, 30, 30), 1, cv2.LINE_AA)
    return np.pad(np.vstack([resized, caption_band]), ((2, 0), (2, 2), (0, 0)), constant_values=255)


def save_picture(path: Path, image: U8) -> None:
    """Write an image as PNG or JPEG, by the suffix of the file.

    Raises:
        StoreError: The file cannot be written.
        ConfigError: The file has another suffix.
    """
    if path.suffix.lower() in (".jpg", ".jpeg"):
        write_atomic(path, encode_jpeg(image, 88, "420"))
        return
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are written as .png or .jpg")
    write_atomic(path, cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())
