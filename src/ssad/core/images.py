"""Images as arrays, uint8 [H, W, 3] RGB and upright: read, captioned, and written as pictures of results."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ssad.core.colours import linear_to_srgb, srgb_to_linear
from ssad.core.errors import ConfigError, FormatError
from ssad.core.image_files import (
    ImageFile,
    decode_image_file,
    encode_jpeg,
    encode_png,
    read_image_file,
    turn_back,
)
from ssad.core.safeio import write_atomic
from ssad.core.types import F32, U8

__all__ = [
    "add_caption",
    "annotated_pixels",
    "annotation_orientation",
    "decode_image",
    "encode_jpeg",
    "read_annotated_image",
    "read_image",
    "save_picture",
]

CAPTION_HEIGHT = 26  # pixels


def read_image(path: str | Path) -> U8:
    """Read an image file of any supported format as uint8 [H, W, 3] RGB, upright.

    Grey is repeated to three channels, alpha is left out, and 16 bits are rounded to 8.

    Raises:
        FormatError: The file is missing, cut short, broken, too large, or not of a supported format.
    """
    return read_image_file(path).rgb


def decode_image(data: bytes, name: str = "<image>") -> U8:
    """The same from the bytes of a file; `name` is what errors call it."""
    return decode_image_file(data, name).rgb


def read_annotated_image(path: str | Path, *, width: int, height: int) -> U8:
    """Read an image in the frame of its annotations, as uint8 [H, W, 3] RGB.

    Annotations refer to the pixels as the file stores them (the convention of COCO's and nuScenes' tools), unless
    only the upright pixels have the size that the annotations state.

    Args:
        path: The file.
        width: Width that the annotations state, pixels; 0 where they state none.
        height: Height that they state; 0 where they state none.

    Raises:
        FormatError: The file cannot be read, or has another size in either frame.
    """
    return annotated_pixels(read_image_file(path), width=width, height=height)


def annotated_pixels(image_file: ImageFile, *, width: int, height: int) -> U8:
    """The same of a file that is already read."""
    orientation = annotation_orientation(image_file, width=width, height=height)
    return np.ascontiguousarray(turn_back(image_file.rgb, orientation))


def annotation_orientation(image_file: ImageFile, *, width: int, height: int) -> int:
    """Return the EXIF orientation of the pixels that annotations refer to: 1 if these are the upright ones.

    Raises:
        FormatError: The file has another size in either frame.
    """
    upright_size = image_file.pixels.shape[1::-1]
    stored_size = upright_size[::-1] if image_file.orientation > 4 else upright_size
    if not width or not height or stored_size == (width, height):
        return image_file.orientation
    if upright_size == (width, height):
        return 1
    raise FormatError(
        f"{image_file.name}: {stored_size[0]} x {stored_size[1]} pixels, the annotations say {width} x {height}; "
        "give the images that were annotated"
    )


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


def decode_srgb(image: U8) -> F32:
    """Return the linear values of an sRGB image, 0 to 1."""
    linear: F32 = srgb_to_linear(image.astype(np.float32) / 255.0)
    return linear


def encode_srgb(linear: F32) -> U8:
    """Return the sRGB image of linear values; values above 1 become white."""
    codes: U8 = np.rint(255.0 * linear_to_srgb(np.clip(linear, 0.0, 1.0))).astype(np.uint8)
    return codes


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
    write_atomic(path, encode_png(image))
