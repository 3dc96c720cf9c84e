"""Conversion of images of any type to flat bytes on a device, and back."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.frames import Frame
from ssad.core.machine import start_warp_quietly
from ssad.core.types import U8
from ssad.scenarios.static.shifts.spec import ShiftSpec


@dataclass(slots=True)
class Batch:
    """B images of `height` x `width`, RGB interleaved, one byte per value, `stride` bytes each.

    The width is a multiple of four, so that four pixels are three words; images of another width are padded on the
    right with their last column, and cropped to `image_width` columns at the end.
    """

    data: Any
    count: int
    height: int
    width: int
    image_width: int
    device: str

    @property
    def stride(self) -> int:
        """Bytes per image."""
        return self.height * self.width * 3

    def empty_like(self) -> Batch:
        """Return another batch of the same shape with undefined values."""
        buffer = wp.empty(self.count * self.stride, dtype=wp.uint8, device=self.device)
        return Batch(buffer, self.count, self.height, self.width, self.image_width, self.device)

    def copy(self) -> Batch:
        """Return a copy on the same device."""
        return Batch(wp.clone(self.data), self.count, self.height, self.width, self.image_width, self.device)

    def words(self) -> Any:
        """Return the same memory as 32-bit words."""
        size = self.count * self.stride // 4
        view = wp.array(ptr=self.data.ptr, dtype=wp.uint32, shape=size, device=self.device)
        view._keep = self.data  # the memory belongs to the bytes
        return view

    def image(self, index: int) -> U8:
        """Return one image [H, W, 3] in main memory."""
        pixels = self.data[index * self.stride : (index + 1) * self.stride].numpy()
        return np.asarray(pixels.reshape(self.height, self.width, 3)[:, : self.image_width])

    def launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], *outputs: Any) -> None:
        """Launch a kernel of `dim` threads on the device of the batch."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=list(outputs), device=self.device)

    def chunks(self) -> tuple[tuple[int, int], int, int]:
        """Return the launch shape of kernels that work on words.

        Returns:
            Threads [B, chunks of an image], words of an image, words of a chunk.
        """
        words, chunk = self.stride // 4, max(256, self.width * 3 // 4)
        return (self.count, -(-words // chunk)), words, chunk

    def numpy(self) -> U8:
        """Return the images [B, H, W, 3] in main memory."""
        rows = self.data.numpy().reshape(self.count, self.height, self.width, 3)
        return np.ascontiguousarray(rows[:, :, : self.image_width])


def to_batch(images: Any, device: str | None = None) -> Batch:
    """Convert images to a batch.

    Args:
        images: uint8 [H, W, 3] or [B, H, W, 3], numpy or torch, or torch float32 [B, 3, H, W] in [0, 1].
        device: "cpu" or "cuda..."; None: that of the images.

    Raises:
        ConfigError: The images have another shape or type.
    """
    if isinstance(images, Batch):
        return images
    start_warp_quietly()
    # Not imported: without torch loaded, no image can be a tensor, and shifts work without it.
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(images, torch.Tensor):
        values = images.detach()
        if values.is_floating_point():
            if values.ndim != 4 or values.shape[1] != 3:
                raise ConfigError(f"float images must be [B, 3, H, W], not {list(values.shape)}")
            values = (values.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
        target_device = device or ("cpu" if values.device.type == "cpu" else f"cuda:{values.device.index or 0}")
        if values.device.type == "cpu":
            return to_batch(values.numpy(), target_device)
        count, height, width = _shape(tuple(values.shape))
        pixel_rows = values.reshape(count, height, width, 3)
        padding = -width % 4
        if padding:
            pixel_rows = torch.cat([pixel_rows, pixel_rows[:, :, -1:].expand(-1, -1, padding, -1)], 2)
        return Batch(
            wp.from_torch(pixel_rows.reshape(-1).clone()), count, height, width + padding, width, target_device
        )
    array = np.asarray(images)
    if array.dtype != np.uint8:
        raise ConfigError(f"images must be uint8 [H, W, 3] or [B, H, W, 3], not {array.dtype} {list(array.shape)}")
    count, height, width = _shape(array.shape)
    pixels = np.ascontiguousarray(array).reshape(count, height, width, 3)
    padding = -width % 4
    if padding:
        pixels = np.pad(pixels, ((0, 0), (0, 0), (0, padding), (0, 0)), mode="edge")
    flat_bytes = wp.array(pixels.reshape(-1), dtype=wp.uint8, device=device or "cpu", copy=False)
    return Batch(flat_bytes, count, height, width + padding, width, device or "cpu")


def _shape(shape: tuple[int, ...]) -> tuple[int, int, int]:
    if len(shape) == 3:
        shape = (1, *shape)
    if len(shape) != 4 or shape[3] != 3:
        raise ConfigError(f"images must be [H, W, 3] or [B, H, W, 3] with three colours, not {list(shape)}")
    if min(shape) < 1 or shape[1] < 8 or shape[2] < 8:
        raise ConfigError(f"images must be at least 8 x 8, not {shape[2]} x {shape[1]}")
    return shape[0], shape[1], shape[2]


def like_input(batch: Batch, images: Any) -> Any:
    """Convert a batch to the type, shape and device of the input images."""
    if isinstance(images, Batch):
        return batch
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(images, torch.Tensor):
        flat_bytes = wp.to_torch(batch.data).to(images.device)
        values = flat_bytes.reshape(batch.count, batch.height, batch.width, 3)[:, :, : batch.image_width]
        if images.is_floating_point():
            return values.permute(0, 3, 1, 2).to(images.dtype) / 255
        return values.reshape(images.shape).clone()
    return batch.numpy().reshape(np.asarray(images).shape)


def to_device(batch: Batch, values: Any, dtype: Any = wp.float32) -> Any:
    """Copy small parameters to the device of a batch."""
    return wp.array(values, dtype=dtype, device=batch.device)


def keys_on(batch: Batch, keys: Sequence[int]) -> Any:
    """Copy 64-bit keys to the device of a batch."""
    return to_device(batch, np.asarray(keys, np.uint64), wp.uint64)


def file_keys(batch: Batch, specs: Sequence[ShiftSpec], frames: Sequence[Frame], purpose: str) -> Any:
    """Return a separate key for each file, on the device of a batch."""
    keys = [
        spec.key(purpose, frame.scene, frame.sample, frame.camera.channel)
        for spec, frame in zip(specs, frames, strict=True)
    ]
    return keys_on(batch, keys)


def check_batch(batch: Batch, frames: Sequence[Frame]) -> None:
    """Raise ConfigError unless there is a frame of the right size for each image."""
    if len(frames) != batch.count:
        raise ConfigError(f"{batch.count} images, but {len(frames)} frames")
    for frame in frames:
        camera = frame.camera
        if (camera.height, camera.width) != (batch.height, batch.image_width):
            raise ConfigError(
                f"camera {camera.channel} is {camera.width} x {camera.height}, "
                f"its image {batch.image_width} x {batch.height}"
            )


def structs(batch: Batch, rows: Sequence[tuple[Any, ...]], kind: Any) -> Any:
    """Copy rows of a kernel's struct to the device of a batch."""
    return to_device(batch, np.array(rows, dtype=kind.numpy_dtype()), kind)
