"""Application of shifts to images: a single image, a batch on any device, or the files of a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera, Frame, SceneContext, ShiftReport, camera_to_world
from ssad.core.types import F32, U8
from ssad.scenarios.static.shifts.batch import Batch, check_batch, like_input, to_batch
from ssad.scenarios.static.shifts.exposure import overexpose
from ssad.scenarios.static.shifts.noise import add_impulses, add_noise
from ssad.scenarios.static.shifts.objects import move_objects
from ssad.scenarios.static.shifts.spec import ShiftSpec
from ssad.scenarios.static.shifts.sun import add_sun
from ssad.scenarios.static.shifts.weather import add_fog, add_precipitation

MIN_SKY_PIXELS = 100  # minimum number of sky pixels, of an image sampled in 160 columns


def shift_images(
    images: Any,
    frames: Sequence[Frame] | Frame | None,
    spec: ShiftSpec | Sequence[ShiftSpec],
    *,
    contexts: Mapping[str, SceneContext] | None = None,
    device: str | None = None,
) -> tuple[Any, list[ShiftReport]]:
    """Apply a shift to images.

    The result for an image depends only on its frame and spec, never on the rest of the batch.

    Args:
        images: uint8 RGB [H, W, 3] or [B, H, W, 3] (numpy or torch), or torch float32 [B, 3, H, W] in [0, 1] (a
            camera has 8 bits: they are rounded to 255 levels).
        frames: Frame of each image; None: a typical camera, and a different sample for each.
        spec: One for all or one for each, of one name and calibration.
        contexts: Constants of each scene, by its key; missing ones are measured on each image alone.
        device: Device of the computation; None: that of the images.

    Returns:
        The images, in the type and shape of the input, and a record of the shift for each.

    Raises:
        ConfigError: The arguments do not fit together.
    """
    batch = to_batch(images, device)
    if frames is None:
        cameras = Camera.typical(batch.image_width, batch.height)
        frames = [Frame(cameras, sample=str(index)) for index in range(batch.count)]
    elif isinstance(frames, Frame):
        frames = [frames]
    specs = [spec] * batch.count if isinstance(spec, ShiftSpec) else list(spec)
    check_batch(batch, frames)
    if len(specs) != batch.count:
        raise ConfigError(f"{batch.count} images, but {len(specs)} shift specs")
    # A batch is one sequence of kernel launches, hence of one shift.
    if len({(image_spec.name, image_spec.calibration) for image_spec in specs}) > 1:
        raise ConfigError("a batch has one shift and one calibration; severities and seeds may differ")
    shifted_indices = [index for index, image_spec in enumerate(specs) if image_spec.severity > 0]
    if not shifted_indices:
        return images, [ShiftReport(True, {"severity": 0}) for _ in specs]
    if len(shifted_indices) < batch.count:
        return _shift_selected(
            images, batch, frames=list(frames), specs=specs, shifted_indices=shifted_indices, contexts=contexts
        )
    result, records = _dispatch(batch, frames, specs, contexts)
    return like_input(result, images), records


def _shift_selected(
    images: Any,
    batch: Batch,
    *,
    frames: list[Frame],
    specs: list[ShiftSpec],
    shifted_indices: list[int],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Any, list[ShiftReport]]:
    """Shift the images of severity 1 or more; those of severity 0 stay unchanged."""
    pixels = batch.numpy().copy()
    shifted_pixels, records = shift_images(
        pixels[shifted_indices],
        [frames[index] for index in shifted_indices],
        [specs[index] for index in shifted_indices],
        contexts=contexts,
        device=batch.device,
    )
    pixels[shifted_indices] = shifted_pixels
    all_records = [ShiftReport(True, {"severity": 0})] * batch.count
    for index, record in zip(shifted_indices, records, strict=True):
        all_records[index] = record
    return like_input(to_batch(pixels, batch.device), images), all_records


def _dispatch(
    batch: Batch,
    frames: Sequence[Frame],
    specs: Sequence[ShiftSpec],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Batch, list[ShiftReport]]:
    name, calibration = specs[0].name, specs[0].calibration
    if name == "impulse":
        return add_impulses(batch, frames, specs)
    if name in ("uniform", "gaussian"):
        return add_noise(batch, frames, specs)
    if name == "overexposure":
        return overexpose(batch, specs)
    if specs[0].places_objects:
        from ssad.scenarios.static.shifts.anomaly import add_anomalies

        return add_anomalies(batch, frames, specs, contexts)
    if calibration == "paper":
        from ssad.scenarios.static.shifts.paper_calibration import paper_shift

        if name in ("snow", "rain", "fog", "sunlight", "motion_blur"):
            return paper_shift(batch, frames, specs)
    if specs[0].family == "object":
        return move_objects(batch, frames, specs)
    image_contexts = [_context(batch, index, frame, contexts) for index, frame in enumerate(frames)]
    if name == "sunlight":
        return add_sun(batch, frames, specs, image_contexts)
    return (add_fog if name == "fog" else add_precipitation)(batch, frames, specs, image_contexts)


def _context(batch: Batch, index: int, frame: Frame, contexts: Mapping[str, SceneContext] | None) -> SceneContext:
    if contexts is not None and frame.scene in contexts:
        return contexts[frame.scene]
    return SceneContext(frame.scene, sky_light([batch.image(index)], [frame.depth]), viewing_direction(frame))


def sky_light(images: Sequence[U8], depths: Sequence[F32 | None] = (), *, night: bool = False) -> float:
    """Return the brightness in [0, 1] of the brightest thirtieth of the sky, which fog scatters.

    If too little of the sky is known, the upper halves of all images stand for it; by night their median, since
    lamps and lit walls are brighter than the sky.

    Args:
        images: Images [H, W, 3].
        depths: Depth maps [h, w] of any size, inf in the sky; None for images without one.
        night: True by night.
    """
    brightness, sky_pixels = [], []
    for index, image in enumerate(images):
        step = max(1, image.shape[1] // 160)
        luminance = image[: max(1, image.shape[0] // 2) : step, ::step].astype(np.float32)
        luminance = luminance @ np.array([0.299, 0.587, 0.114], np.float32)
        brightness.append(luminance.ravel())
        depth = depths[index] if index < len(depths) else None
        if depth is not None:
            rows = np.arange(luminance.shape[0]) * step * depth.shape[0] // image.shape[0]
            columns = np.arange(luminance.shape[1]) * step * depth.shape[1] // image.shape[1]
            sky_pixels.append(luminance[np.isinf(depth[rows][:, columns])])
    known_sky = np.concatenate(sky_pixels) if sky_pixels else np.zeros(0)
    has_sky = len(known_sky) >= MIN_SKY_PIXELS
    sample = known_sky if has_sky else np.concatenate(brightness)
    return float(np.clip(np.quantile(sample, 0.5 if night and not has_sky else 0.97) / 255, 0.06, 1.0))


def viewing_direction(frame: Frame) -> float:
    """Return the heading of the optical axis in the world, radians."""
    axis = camera_to_world(frame)[:3, 2]
    return float(np.arctan2(axis[1], axis[0]))
