"""Conversion of user images to the format of detectors: [B, 3, H, W] float32 in [0, 1], RGB."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.image_files import ALPHA_NOTE, GREY_NOTE, read_image_file

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
        x: A file name (see `ssad.core.image_files`; turned upright by its EXIF orientation); a numpy array [H, W],
            [H, W, 1|3|4] or [B, H, W, 1|3|4]; a torch tensor [3, H, W] or [B, 1|3|4, H, W]; or a list of these, all
            of one size.
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
    """Read a file as [1, C, H, W], with notes on conversions."""
    image_file = read_image_file(path)
    return torch.from_numpy(image_file.pixels).permute(2, 0, 1)[None], image_file.notes


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
        notes = (*notes, ALPHA_NOTE)
    if image.shape[1] == 1:
        image = image.expand(-1, 3, -1, -1)
        notes = (*notes, GREY_NOTE)
    return Images(image.contiguous(), notes)


def _check_range(image: Tensor, origin: str) -> None:
    low, high = (float(value) for value in image.aminmax())
    if not bool(image.isfinite().all()):
        raise ConfigError(f"{origin}: holds NaN or infinite values")
    if low < 0 or high > 1:
        unit = "; divide by 255" if low >= 0 and 1 < high <= 255 else ""
        raise ConfigError(f"{origin}: floats from {low:.4g} to {high:.4g}; they must lie in [0, 1]{unit}")
