"""The shifts on images: one image, a batch on any device, or the files of a folder go through here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Applied, Camera, Frame, SceneContext, camera_to_world
from ssad.core.types import F32, U8
from ssad.scenarios.static.shifts.batch import Batch, check_batch, like_input, to_batch
from ssad.scenarios.static.shifts.exposure import overexpose
from ssad.scenarios.static.shifts.noise import add_impulses, add_noise
from ssad.scenarios.static.shifts.objects import move_objects
from ssad.scenarios.static.shifts.spec import ShiftSpec
from ssad.scenarios.static.shifts.sun import add_sun
from ssad.scenarios.static.shifts.weather import add_fog, add_precipitation

_ENOUGH = 100  # pixels of sky, of a picture looked at in 160 columns


def shift_images(
    images: Any,
    frames: Sequence[Frame] | Frame | None,
    spec: ShiftSpec | Sequence[ShiftSpec],
    *,
    contexts: Mapping[str, SceneContext] | None = None,
    device: str | None = None,
) -> tuple[Any, list[Applied]]:
    """Apply a shift to images.

    The result for an image depends only on its frame and spec, never on the rest of the batch.

    Args:
        images: uint8 RGB [H, W, 3] or [B, H, W, 3] (numpy or torch), or torch float32 [B, 3, H, W] in [0, 1] (a camera
            has 8 bits: they are rounded to 255 levels).
        frames: What is known of each; None: a typical camera, and a different sample for each.
        spec: One for all or one for each, of one name and calibration.
        contexts: What is constant over a scene, by its key; missing: measured on each image alone.
        device: Where to compute; None: where the images are.

    Returns:
        The images, in the kind and shape in which they came, and what was done to each.

    Raises:
        ConfigError: The arguments do not fit together.
    """
    batch = to_batch(images, device)
    if frames is None:
        cameras = Camera.typical(batch.seen, batch.height)
        frames = [Frame(cameras, sample=str(b)) for b in range(batch.count)]
    elif isinstance(frames, Frame):
        frames = [frames]
    specs = [spec] * batch.count if isinstance(spec, ShiftSpec) else list(spec)
    check_batch(batch, frames)
    if len(specs) != batch.count:
        raise ConfigError(f"{batch.count} images, but {len(specs)} shift specs")
    if len({(s.name, s.calibration) for s in specs}) > 1:
        raise ConfigError("a batch has one shift and one calibration; severities and seeds may differ")
    chosen = [b for b, s in enumerate(specs) if s.severity > 0]
    if not chosen:
        return images, [Applied(True, {"severity": 0}) for _ in specs]
    if len(chosen) < batch.count:
        return _some(images, batch, frames=list(frames), specs=specs, chosen=chosen, contexts=contexts)
    out, done = _dispatch(batch, frames, specs, contexts)
    return like_input(out, images), done


def _some(
    images: Any,
    batch: Batch,
    *,
    frames: list[Frame],
    specs: list[ShiftSpec],
    chosen: list[int],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Any, list[Applied]]:
    """Severity 0 among others: only the others are computed."""
    pixels = batch.numpy().copy()
    part, records = shift_images(
        pixels[chosen], [frames[b] for b in chosen], [specs[b] for b in chosen], contexts=contexts, device=batch.device
    )
    pixels[chosen] = part
    done = [Applied(True, {"severity": 0})] * batch.count
    for b, record in zip(chosen, records, strict=True):
        done[b] = record
    return like_input(to_batch(pixels, batch.device), images), done


def _dispatch(
    batch: Batch,
    frames: Sequence[Frame],
    specs: Sequence[ShiftSpec],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Batch, list[Applied]]:
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
        from ssad.scenarios.static.shifts.paper import paper_shift

        if name in ("snow", "rain", "fog", "sunlight", "motion_blur"):
            return paper_shift(batch, frames, specs)
    if specs[0].family == "object":
        return move_objects(batch, frames, specs)
    known = [_context(batch, b, frame, contexts) for b, frame in enumerate(frames)]
    if name == "sunlight":
        return add_sun(batch, frames, specs, known)
    return (add_fog if name == "fog" else add_precipitation)(batch, frames, specs, known)


def _context(batch: Batch, b: int, frame: Frame, contexts: Mapping[str, SceneContext] | None) -> SceneContext:
    if contexts is not None and frame.scene in contexts:
        return contexts[frame.scene]
    return SceneContext(frame.scene, sky_light([batch.picture(b)], [frame.depth]), viewing_direction(frame))


def sky_light(images: Sequence[U8], depths: Sequence[F32 | None] = (), *, night: bool = False) -> float:
    """Brightness in [0, 1] of the brightest thirtieth of the sky, which is what fog scatters.

    Where too little of the sky is known, the upper halves of all images stand for it; by night their median, since
    lamps and walls in lamp light are brighter than the sky.

    Args:
        images: Pictures [H, W, 3].
        depths: Maps [h, w] of any size, inf where there is sky; None for images without one.
        night: Whether it is night.
    """
    found, sky = [], []
    for n, image in enumerate(images):
        step = max(1, image.shape[1] // 160)
        light = image[: max(1, image.shape[0] // 2) : step, ::step].astype(np.float32)
        light = light @ np.array([0.299, 0.587, 0.114], np.float32)
        found.append(light.ravel())
        depth = depths[n] if n < len(depths) else None
        if depth is not None:
            y = np.arange(light.shape[0]) * step * depth.shape[0] // image.shape[0]
            x = np.arange(light.shape[1]) * step * depth.shape[1] // image.shape[1]
            sky.append(light[np.isinf(depth[y][:, x])])
    known = np.concatenate(sky) if sky else np.zeros(0)
    enough = len(known) >= _ENOUGH
    seen = known if enough else np.concatenate(found)
    return float(np.clip(np.quantile(seen, 0.5 if night and not enough else 0.97) / 255, 0.06, 1.0))


def viewing_direction(frame: Frame) -> float:
    """Heading of the optical axis in the world, radians."""
    axis = camera_to_world(frame)[:3, 2]
    return float(np.arctan2(axis[1], axis[0]))
