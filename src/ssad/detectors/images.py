"""Conversion of user images to the format of detectors: [B, 3, H, W] float32 in [0, 1], RGB."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.errors import ConfigError, FormatError
from ssad.core.safeio import MIB, read_bytes

MAX_FILE = 256 * MIB
MAX_PIXELS = 1 << 26
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM")
HINTS = {
    torch.int16: "; 16-bit pictures are uint16",
    torch.int32: "; convert to uint8 or uint16",
    torch.int64: "; convert to uint8 or uint16",
    torch.bool: "; a mask is no picture",
}


@dataclass(frozen=True, slots=True)
class Images:
    """Images in the format of detectors.

    Attributes:
        tensor: [B, 3, H, W] float32 (float64 is kept) in [0, 1], RGB.
        notes: Conversions that a user may want to know about, each once: "greyscale repeated to three channels",
            "alpha left out", "16 bit", ...
    """

    tensor: Tensor
    notes: tuple[str, ...] = ()


def as_images(x: Any, *, origin: str = "images") -> Images:
    """Convert one image or a batch from files, arrays or tensors; gradients of float tensors are kept.

    Channels are RGB (OpenCV reads BGR: reverse its arrays first). uint8 is divided by 255, uint16 by 65535 (also
    when only 12 of its bits are used, with a note); floats must be in [0, 1]. Greyscale is repeated to three
    channels and alpha is dropped, both with a note, since detectors expect colour. Any size is accepted.

    Args:
        x: A file name (PNG, JPEG, TIFF, BMP, WebP; 8 bits, then turned upright by its EXIF, or 16); a numpy array
            [H, W], [H, W, 1|3|4] or [B, H, W, 1|3|4]; a torch tensor [3, H, W] or [B, 1|3|4, H, W]; or a list of
            these, all of one size.
        origin: Name of the argument, for messages.

    Raises:
        ConfigError: The shape, type or range is invalid, or the images differ in size.
        FormatError: A file is not an image.
    """
    if isinstance(x, Sequence) and not isinstance(x, str | bytes):
        if not x:
            raise ConfigError(f"{origin}: no picture")
        converted_images = [as_images(image, origin=f"{origin}[{index}]") for index, image in enumerate(x)]
        sizes = sorted({tuple(converted.tensor.shape[2:]) for converted in converted_images})
        if len(sizes) > 1:
            size_list = ", ".join(f"{height} x {width}" for height, width in sizes[:3])
            raise ConfigError(f"{origin}: pictures of different sizes ({size_list}, height x width) make no batch")
        notes = dict.fromkeys(note for converted in converted_images for note in converted.notes)
        return Images(torch.cat([converted.tensor for converted in converted_images]), tuple(notes))
    if isinstance(x, str | os.PathLike):
        return _to_floats(*_read(Path(x).expanduser()), origin=str(x))
    if isinstance(x, np.ndarray):
        return _to_floats(_from_array(x, origin), (), origin=origin)
    if isinstance(x, Tensor):
        return _to_floats(_from_tensor(x, origin), (), origin=origin)
    raise ConfigError(f"{origin}: a {type(x).__name__} is no picture; give a file name, an array or a tensor")


def _from_array(x: npt.NDArray[Any], origin: str) -> Tensor:
    """Convert [H, W], [H, W, C] or [B, H, W, C] to [B, C, H, W]."""
    if x.ndim == 2:
        x = x[..., None]
    if x.ndim == 3:
        x = x[None]
    if x.ndim != 4 or x.shape[3] not in (1, 3, 4):
        hint = ", with channels last (turn [3, H, W] by .transpose(1, 2, 0))" if 3 in x.shape[:2] else ""
        raise ConfigError(f"{origin}: an array of shape {list(x.shape)}; pictures are [H, W, 3] or [B, H, W, 3]{hint}")
    if x.dtype.kind not in "uifb" or x.dtype.itemsize > 8:
        raise ConfigError(f"{origin}: an array of {x.dtype}; pictures are uint8, uint16 or floats in [0, 1]")
    # torch.from_numpy takes native byte order only, and warns of read-only arrays.
    native = np.ascontiguousarray(x.astype(x.dtype.newbyteorder("="), copy=False))
    return torch.from_numpy(native if native.flags.writeable else native.copy()).permute(0, 3, 1, 2)


def _from_tensor(x: Tensor, origin: str) -> Tensor:
    if x.ndim == 3:
        x = x[None]
    if x.ndim != 4 or x.shape[1] not in (1, 3, 4):
        hint = ", with channels first (turn [H, W, 3] by .permute(2, 0, 1))" if x.shape[-1:] == (3,) else ""
        shape = list(x.shape)
        raise ConfigError(f"{origin}: a tensor of shape {shape}; pictures are [3, H, W] or [B, 3, H, W]{hint}")
    return x


def _read(path: Path) -> tuple[Tensor, tuple[str, ...]]:
    """Read a file as [1, C, H, W], with notes on conversions; raise FormatError if it is not an image."""
    from PIL import Image, ImageOps

    content = read_bytes(path, limit=MAX_FILE)
    try:
        # Pillow warns of broken EXIF, which matters for the orientation only
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(content), formats=FORMATS) as image_file,
        ):
            if image_file.width * image_file.height > MAX_PIXELS:
                raise FormatError(f"{path}: {image_file.width} x {image_file.height} pixels are more than {MAX_PIXELS}")
            image_file.load()  # raises where the file is cut short
            has_16_bits = _has_16_bits(image_file, content)
            upright = ImageOps.exif_transpose(image_file)
    except FormatError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        reason = "cut short" if "truncated" in str(error) else f"not a picture of {', '.join(FORMATS)}"
        raise FormatError(f"{path}: {reason}, or broken") from None
    if has_16_bits:
        return _read_16_bits(content, path)
    if upright.mode == "P":
        upright = upright.convert("RGBA" if "transparency" in upright.info else "RGB")
    elif upright.mode in ("1", "CMYK", "YCbCr", "LAB", "HSV"):
        upright = upright.convert("L" if upright.mode == "1" else "RGB")
    if upright.mode not in ("L", "LA", "RGB", "RGBA"):
        raise FormatError(f"{path}: pixels of mode {upright.mode}; pictures have 8 or 16 bits a channel")
    return _channels(np.array(upright))


def _has_16_bits(image_file: Any, content: bytes) -> bool:
    """Return True for a file of 16 bits per channel, which Pillow keeps for greyscale only."""
    if image_file.format == "PNG":
        # Byte 24 of a PNG file is the bit depth in its IHDR chunk.
        return content[24] == 16
    # TIFF tag 258 is BitsPerSample.
    return image_file.format == "TIFF" and bool(image_file.tag_v2.get(258, (8,))[0] == 16)


def _read_16_bits(content: bytes, path: Path) -> tuple[Tensor, tuple[str, ...]]:
    import cv2

    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise FormatError(f"{path}: 16 bits a channel in a way that is not known")
    # OpenCV returns BGR or BGRA.
    channel_order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}
    return _channels(
        pixels[..., channel_order[pixels.shape[2]]] if pixels.ndim == 3 and pixels.shape[2] in channel_order else pixels
    )


def _channels(pixels: npt.NDArray[Any]) -> tuple[Tensor, tuple[str, ...]]:
    """Convert [H, W] or [H, W, C] to [1, 1 or 3, H, W], without alpha."""
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    notes = ("alpha left out",) if pixels.shape[2] in (2, 4) else ()
    colour = np.ascontiguousarray(pixels[..., : 1 if pixels.shape[2] < 3 else 3])
    return torch.from_numpy(colour).permute(2, 0, 1)[None], notes


def _to_floats(x: Tensor, notes: tuple[str, ...], *, origin: str) -> Images:
    """Convert [B, C, H, W] of any type to three channels of floats in [0, 1]."""
    if 0 in x.shape:
        raise ConfigError(f"{origin}: an empty picture, shape {list(x.shape)}")
    dtype_name = str(x.dtype).removeprefix("torch.")
    if x.dtype == torch.uint8:
        image = x.float() / 255
    elif x.dtype == torch.uint16:
        widened = x.to(torch.int32)
        max_value = int(widened.max())
        image = widened.float() / 65535
        notes = (*notes, "16 bit" if max_value > 4095 else f"16 bit, none above {max_value}: dark, or of fewer bits")
    elif x.is_floating_point():
        image = x if x.dtype in (torch.float32, torch.float64) else x.float()
        _check_range(image.detach(), origin)
    else:
        raise ConfigError(
            f"{origin}: {dtype_name} numbers; pictures are uint8, uint16 or floats in [0, 1]{HINTS.get(x.dtype, '')}"
        )
    if image.shape[1] == 4:
        image = image[:, :3]
        notes = (*notes, "alpha left out")
    if image.shape[1] == 1:
        image = image.expand(-1, 3, -1, -1)
        notes = (*notes, "greyscale repeated to three channels")
    return Images(image.contiguous(), notes)


def _check_range(image: Tensor, origin: str) -> None:
    low, high = (float(value) for value in image.aminmax())
    if not bool(image.isfinite().all()):
        raise ConfigError(f"{origin}: holds NaN or infinite values")
    if low < 0 or high > 1:
        unit = "; divide by 255" if low >= 0 and 1 < high <= 255 else ""
        raise ConfigError(f"{origin}: floats from {low:.4g} to {high:.4g}; they must lie in [0, 1]{unit}")
