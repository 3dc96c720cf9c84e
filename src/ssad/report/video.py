"""Top-view videos of an episode: mp4 or GIF, in the colours of the page's replay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import atomic_path
from ssad.core.top_view import Frame, TopView, TopViewScene, lit_turn_signals
from ssad.core.types import EpisodeTrace

CODECS = ("vp09", "mp4v")  # VP9, which browsers play; where it is missing MPEG-4 part 2, which most players know


def frames(trace: EpisodeTrace, graph: LaneGraph, *, size: tuple[int, int] = (960, 540)) -> Iterator[Frame]:
    """Yield RGB frames [H, W, 3], one a step, the camera following the ego from above."""
    top_view = TopView(graph, size=size)
    pose, sizes = np.stack([trace.x, trace.y, trace.yaw], -1), np.stack([trace.length, trace.width], -1)
    first_hit = next(iter(np.flatnonzero(trace.contact)), None)
    signal_positions = graph.signal_xy[trace.signal_ids].tolist()
    for step in range(len(trace.accel)):
        captions = [
            f"{step * trace.dt:5.1f} s   {trace.speed[step, 0]:5.1f} m/s   route {trace.route_complete[step]:3.0f} %"
        ]
        if step == len(trace.accel) - 1:
            captions.append(trace.end.replace("_", " "))
        signals = [(x, y, int(state)) for (x, y), state in zip(signal_positions, trace.signal[step], strict=True)]
        steps_since_contact = None if first_hit is None or step < first_hit else step - int(first_hit)
        shows_signals = trace.turn_signal.size > 0
        lit_signals = lit_turn_signals(trace.turn_signal[step], step * trace.dt) if shows_signals else None
        trail = pose[max(step - 30, 0) : step + 1, 0, :2]
        yield top_view.draw(
            TopViewScene(
                pose[step],
                sizes,
                trace.kind,
                trace.active[step],
                trace.route,
                trail,
                signals,
                hit=steps_since_contact,
                words=captions,
                turn_signal=lit_signals,
            )
        )


def write_video(trace: EpisodeTrace, graph: LaneGraph, path: Path | str) -> Path:
    """Write the episode as .mp4 (10 frames a second) or .gif (every second frame), whole or not at all.

    Raises:
        ConfigError: Another suffix, or no encoder is available.
        StoreError: The folder cannot be written.
    """
    path = Path(path)
    if path.suffix == ".gif":
        return save_frames(frames(trace, graph, size=(640, 360)), path, dt=trace.dt)
    return save_frames(frames(trace, graph), path, dt=trace.dt)


def save_frames(images: Iterable[Frame], path: Path, *, dt: float) -> Path:
    """Write frames as .mp4 or .gif (every second frame), whole or not at all.

    Args:
        images: RGB, uint8 [H, W, 3], one size.
        path: Output file.
        dt: Time between two frames, s.

    Raises:
        ConfigError: Another suffix, no frames, or no encoder is available.
        StoreError: The folder cannot be written.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: a video is .mp4 or .gif")
    with atomic_path(path) as temporary:
        (_mp4 if path.suffix == ".mp4" else _gif)(iter(images), temporary, dt)
    return path


def _mp4(images: Iterator[Frame], path: Path, dt: float) -> None:
    first_image = next(images, None)
    if first_image is None:
        raise ConfigError(f"{path}: a video without frames")
    size = first_image.shape[1], first_image.shape[0]
    for codec in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), round(1.0 / dt), size)
        if writer.isOpened():
            break
    else:
        raise ConfigError(f"{path}: OpenCV has no mp4 encoder here; write a .gif")
    try:
        for frame in chain([first_image], images):
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()


def _gif(images: Iterator[Frame], path: Path, dt: float) -> None:
    palette_images = [Image.fromarray(frame).quantize(64) for index, frame in enumerate(images) if index % 2 == 0]
    if not palette_images:
        raise ConfigError(f"{path}: a video without frames")
    palette_images[0].save(
        path, save_all=True, append_images=palette_images[1:], duration=round(2000 * dt), loop=0, optimize=False
    )
