"""A recorded drive filmed again with an attack in it: the ego's camera, clean beside attacked, and what is detected."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ssad.core.frames import Camera
from ssad.core.images import captioned
from ssad.core.lane_graph import LaneGraph
from ssad.core.protocols import Detector
from ssad.core.types import U8, AgentKind, EpisodeTrace
from ssad.detectors.drawing import marked
from ssad.rendering.agent_edit import LiveAttack
from ssad.rendering.camera.render import Weather
from ssad.rendering.onboard import DAY, Onboard

NEAR = 40.0  # m ahead of the ego within which an agent is worth filming


def first_ahead(trace: EpisodeTrace, kind: AgentKind = AgentKind.CAR) -> int | None:
    """The agent of a kind that is longest before the ego, within `NEAR` m and in its camera's view; None if none is."""
    dx, dy = trace.x - trace.x[:, :1], trace.y - trace.y[:, :1]
    cos, sin = np.cos(trace.yaw[:, :1]), np.sin(trace.yaw[:, :1])
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    seen = trace.active & (ahead > 2.0 * np.abs(aside)) & (ahead < NEAR) & (trace.kind == kind)
    steps = seen[:, 1:].sum(0)
    return int(steps.argmax()) + 1 if steps.size and steps.max() > 0 else None


def attacked_frames(
    trace: EpisodeTrace,
    graph: LaneGraph,
    attack: LiveAttack,
    *,
    detector: Detector | None = None,
    width: int = 640,
    every: int = 2,
    weather: Weather = DAY,
) -> Iterator[U8]:
    """The drive as the ego's camera sees it, without the attack on the left and with it on the right.

    Args:
        trace: The drive.
        graph: Its town.
        attack: What is changed.
        detector: Whose boxes are drawn; None: none.
        width: Of each of the two pictures, px.
        every: Steps from one frame to the next.
        weather: Of the drive.

    Yields:
        RGB frames [H, W, 3].

    Raises:
        ConfigError: The attack does not fit on its agent.
    """
    front = Camera.typical(width, width * 9 // 16)
    lens = torch.tensor(front.intrinsic, dtype=torch.float32)
    sides = [
        (title, Onboard(weather=weather, attack=one).camera(front))
        for title, one in (("clean", None), (f"agent {attack.agent} attacked", attack))
    ]
    for step in range(0, len(trace.x), every):
        tiles = []
        for title, camera in sides:
            (picture,) = camera.of_trace(trace, graph, steps=[step])
            image = np.ascontiguousarray(np.moveaxis(picture, 0, -1))
            if detector is not None:
                image = marked(detector, torch.from_numpy(picture.copy())[None].float() / 255, lens)
            tiles.append(captioned(image, f"{title}, {step * trace.dt:.1f} s", width))
        yield np.hstack(tiles)
