"""Film of a recorded drive with an attack: the ego's camera, clean beside attacked, with the detected boxes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ssad.core.frames import Camera
from ssad.core.images import add_caption
from ssad.core.lane_graph import LaneGraph
from ssad.core.protocols import Detector
from ssad.core.types import U8, AgentKind, EpisodeTrace
from ssad.detectors.drawing import draw_clear_detections
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.onboard import DAY, Onboard

FILMING_RANGE = 40.0  # m ahead of the ego within which an agent is worth filming


def agent_ahead(trace: EpisodeTrace, kind: AgentKind = AgentKind.CAR) -> int | None:
    """The agent of a kind that is longest before the ego, within `NEAR` m and in its camera's view; None if none is."""
    dx, dy = trace.x - trace.x[:, :1], trace.y - trace.y[:, :1]
    cos, sin = np.cos(trace.yaw[:, :1]), np.sin(trace.yaw[:, :1])
    forward, lateral = dx * cos + dy * sin, dy * cos - dx * sin
    # A cone of 27 degrees to either side stands for the view of the camera.
    is_ahead = trace.active & (forward > 2.0 * np.abs(lateral)) & (forward < FILMING_RANGE) & (trace.kind == kind)
    visible_steps = is_ahead[:, 1:].sum(0)
    return int(visible_steps.argmax()) + 1 if visible_steps.size and visible_steps.max() > 0 else None


def attacked_frames(
    trace: EpisodeTrace,
    graph: LaneGraph,
    attack: AgentEdit,
    *,
    detector: Detector | None = None,
    width: int = 640,
    frame_stride: int = 2,
    weather: SceneWeather = DAY,
) -> Iterator[U8]:
    """The drive as the ego's camera sees it, without the attack on the left and with it on the right.

    Args:
        trace: The drive.
        graph: Its town.
        attack: What is changed.
        detector: Whose boxes are drawn; None: none.
        width: Of each of the two pictures, px.
        frame_stride: Steps from one frame to the next.
        weather: Of the drive.

    Yields:
        RGB frames [H, W, 3].

    Raises:
        ConfigError: The attack does not fit on its agent.
    """
    camera_model = Camera.typical(width, width * 9 // 16)
    intrinsic = torch.tensor(camera_model.intrinsic, dtype=torch.float32)
    appearance_variants = [
        (title, Onboard(weather=weather, attack=variant_edit).camera(camera_model))
        for title, variant_edit in (("clean", None), (f"agent {attack.agent} attacked", attack))
    ]
    for step in range(0, len(trace.x), frame_stride):
        tiles = []
        for title, onboard_camera in appearance_variants:
            (rendered,) = onboard_camera.of_trace(trace, graph, steps=[step])
            image = np.ascontiguousarray(np.moveaxis(rendered, 0, -1))
            if detector is not None:
                image = draw_clear_detections(
                    detector, torch.from_numpy(rendered.copy())[None].float() / 255, intrinsic
                )
            tiles.append(add_caption(image, f"{title}, {step * trace.dt:.1f} s", width))
        yield np.hstack(tiles)
