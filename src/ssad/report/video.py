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
from ssad.core.top_view import Frame, Moment, TopView
from ssad.core.types import EpisodeTrace

CODECS = ("vp09", "mp4v")  # VP9, which browsers play; where it is missing MPEG-4 part 2, which most players know


def frames(trace: EpisodeTrace, graph: LaneGraph, *, size: tuple[int, int] = (960, 540)) -> Iterator[Frame]:
    """RGB frames [H, W, 3], one a step, the camera following the ego from above."""
    view = TopView(graph, size=size)
    pose, size_of = np.stack([trace.x, trace.y, trace.yaw], -1), np.stack([trace.length, trace.width], -1)
    first_hit = next(iter(np.flatnonzero(trace.contact)), None)
    places = graph.signal_xy[trace.signal_ids].tolist()
    for t in range(len(trace.accel)):
        words = [f"{t * trace.dt:5.1f} s   {trace.speed[t, 0]:5.1f} m/s   route {trace.route_complete[t]:3.0f} %"]
        if t == len(trace.accel) - 1:
            words.append(trace.end.replace("_", " "))
        lamps = [(x, y, int(state)) for (x, y), state in zip(places, trace.signal[t], strict=True)]
        hit = None if first_hit is None or t < first_hit else t - int(first_hit)
        past = pose[max(t - 30, 0) : t + 1, 0, :2]
        yield view.draw(
            Moment(pose[t], size_of, trace.kind, trace.active[t], trace.route, past, lamps, hit=hit, words=words)
        )


def write_video(trace: EpisodeTrace, graph: LaneGraph, path: Path | str) -> Path:
    """Write the episode as .mp4 (10 frames a second) or .gif (every second frame), whole or not at all.

    ConfigError for another suffix or when no encoder answers; StoreError for a folder that cannot be written.
    """
    path = Path(path)
    if path.suffix == ".gif":
        return save_frames(frames(trace, graph, size=(640, 360)), path, dt=trace.dt)
    return save_frames(frames(trace, graph), path, dt=trace.dt)


def save_frames(shown: Iterable[Frame], path: Path, *, dt: float) -> Path:
    """Write frames as .mp4 or .gif (every second frame), whole or not at all.

    Args:
        shown: RGB, uint8 [H, W, 3], one size.
        path: Where to.
        dt: From one frame to the next, s.

    Raises:
        ConfigError: Another suffix, no frames, or no encoder answers.
        StoreError: The folder cannot be written.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: a video is .mp4 or .gif")
    with atomic_path(path) as temporary:
        (_mp4 if path.suffix == ".mp4" else _gif)(iter(shown), temporary, dt)
    return path


def _mp4(shown: Iterator[Frame], path: Path, dt: float) -> None:
    first = next(shown, None)
    if first is None:
        raise ConfigError(f"{path}: a video without frames")
    size = first.shape[1], first.shape[0]
    for code in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), round(1.0 / dt), size)
        if writer.isOpened():
            break
    else:
        raise ConfigError(f"{path}: OpenCV has no mp4 encoder here; write a .gif")
    try:
        for frame in chain([first], shown):
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()


def _gif(shown: Iterator[Frame], path: Path, dt: float) -> None:
    pictures = [Image.fromarray(f).quantize(64) for k, f in enumerate(shown) if k % 2 == 0]
    if not pictures:
        raise ConfigError(f"{path}: a video without frames")
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(2000 * dt), loop=0, optimize=False)
