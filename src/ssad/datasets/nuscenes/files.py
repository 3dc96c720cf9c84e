"""The sensor files of a nuScenes folder: camera images and LiDAR sweeps, read with every check and written as bytes.

Images are uint8 [H, W, 3] RGB; sweeps are float32 [N, 5]: x, y, z in metres in the sensor's frame, intensity, ring.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from ssad.errors import FormatError
from ssad.safeio import read_bytes
from ssad.types import F32, U8

POINT_BYTES = 20
MAX_PIXELS = 1 << 26
_PNG = b"\x89PNG\r\n\x1a\n"


def read_image(path: str | Path) -> U8:
    """A JPEG or PNG as uint8 [H, W, 3] RGB. FormatError: missing, cut short, not an image, grey, alpha or 16 bit."""
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
        height, width, space, _ = simplejpeg.decode_jpeg_header(data)
        if space == "Gray":
            raise FormatError(f"{name}: a greyscale image; three colour channels are needed")
        if space in ("CMYK", "YCCK"):
            raise FormatError(f"{name}: a {space} image; RGB colours are needed")
        _check_pixels(width, height, name)
        image: U8 = simplejpeg.decode_jpeg(data, "RGB")  # strict: a file cut short raises
    except ValueError as error:
        raise FormatError(f"{name}: a broken or truncated JPEG: {error}") from None
    return image


def _decode_png(data: bytes, name: str) -> U8:
    """Every chunk's checksum is checked first: OpenCV fills what is missing with grey and says nothing."""
    at, ended = len(_PNG), False
    while at + 12 <= len(data) and not ended:
        size = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + size
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise FormatError(f"{name}: a broken PNG: the checksum of its {kind.decode('latin-1')} block is wrong")
        if kind == b"IHDR" and size == 13:
            width, height, depth, colour = struct.unpack_from(">IIBB", data, at + 8)
            _check_pixels(width, height, name)
            if depth == 16:
                raise FormatError(f"{name}: 16 bits a channel; 8 are needed")
            if colour in (0, 4):
                raise FormatError(f"{name}: a greyscale image; three colour channels are needed")
            if colour == 6:
                raise FormatError(f"{name}: it has an alpha channel; three colour channels are needed")
        at, ended = end, kind == b"IEND"
    if not ended:
        raise FormatError(f"{name}: a truncated PNG: its end is missing")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise FormatError(f"{name}: not a readable 8 bit RGB image")
    return np.ascontiguousarray(image[:, :, ::-1])


def _check_pixels(width: int, height: int, name: str) -> None:
    if width * height > MAX_PIXELS:
        raise FormatError(f"{name}: {width} x {height} pixels are more than the limit of {MAX_PIXELS}")


def encode_jpeg(image: U8, quality: int = 95, subsampling: str = "420") -> bytes:
    """The bytes of a JPEG from uint8 [H, W, 3] RGB; subsampling 420 as in the originals, 444 keeps colour noise."""
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", subsampling, fastdct=False))


def read_points(path: str | Path) -> F32:
    """A LiDAR sweep (.pcd.bin) as float32 [N, 5]. FormatError: missing, of another size, or not finite."""
    data = read_bytes(path, limit=1 << 28)
    if len(data) % POINT_BYTES:
        raise FormatError(f"{path}: {len(data)} bytes are no whole number of {POINT_BYTES}-byte points (cut short?)")
    points = np.frombuffer(data, "<f4").reshape(-1, 5).astype(np.float32)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise FormatError(f"{path}: point {int(np.argmin(finite))} is not finite")
    return points


def points_bytes(points: npt.ArrayLike) -> bytes:
    """The bytes of a sweep file from points [N, 5]. ValueError for another shape."""
    array = np.ascontiguousarray(points, "<f4")
    if array.ndim != 2 or array.shape[1] != 5:
        raise ValueError(f"points have shape {array.shape}, not [N, 5]")
    return array.tobytes()
