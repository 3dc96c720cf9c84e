"""Parts of a perceiving driver of another author: a perceiver of brightness, a tracker without memory, a planner."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssad.core.geometry import to_local
from ssad.core.perception import Tracks
from ssad.core.types import AgentKind
from ssad.drivers.perceiving.ego_boxes import EgoBoxes
from ssad.rendering.camera.rig import rig_camera


def boxes(*centres: tuple[float, float], label: int = 0, score: float = 0.9) -> EgoBoxes:
    """Boxes of cars at x, y in the frame of an ego."""
    n = len(centres)
    return EgoBoxes(
        centre=np.array([(x, y, 0.8) for x, y in centres], float).reshape(n, 3),
        size_lwh=np.tile([4.5, 1.9, 1.6], (n, 1)),
        yaw=np.zeros(n),
        velocity=np.full((n, 2), np.nan),
        label=np.full(n, label),
        score=np.full(n, score),
    )


class Ahead:
    """A car ahead, as sure as the image is bright; an image that is 0 everywhere is no reading."""

    sensors, classes = ("CAM_FRONT",), ("car", "stop_sign")

    def __init__(self, distance: float = 14.0, width: int = 64) -> None:
        self.distance = distance
        self.cameras = {"CAM_FRONT": rig_camera("CAM_FRONT", width)}

    def reset(self, episodes: Any) -> None: ...

    def perceive(self, view: Any, rows: Any) -> list[EgoBoxes | None]:
        assert not view.others.any(), "the truth is hidden from it"
        images = np.asarray(view.readings["CAM_FRONT"])[rows]
        return [
            boxes((self.distance, 0.0), score=float(image.mean()) / 255) if image.any() else None for image in images
        ]


class Last:
    """Believes the objects of the last look, where they were."""

    def __init__(self, *, least: float = 0.1) -> None:
        self.least = least

    def reset(self, episodes: Any) -> None:
        self.found: dict[int, Any] = {}

    def update(self, scenes: Any, times: Any, found: Any, poses: Any) -> None:
        assert poses.shape == (len(scenes), 3)
        for scene in scenes.tolist():
            self.found[scene] = found.take((found.scene == scene) & (found.score >= self.least))

    def confirmed(self, scenes: Any, times: Any) -> Tracks:
        parts = [self.found[scene] for scene in scenes.tolist() if scene in self.found]
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts] or [np.zeros((0, *shape))])
            for name, shape in {"scene": (), "place": (2,), "yaw": (), "size": (2,), "kind": (), "score": ()}.items()
        }
        count = len(columns["scene"])
        for name in ("scene", "kind"):
            columns[name] = columns[name].astype(np.int64)
        return Tracks(ident=np.arange(count), velocity=np.zeros((count, 2)), **columns)


class Brake:
    """Goes straight on at half throttle, and brakes for anything believed within a distance ahead."""

    def __init__(self, distance: float = 20.0) -> None:
        self.distance = distance

    def reset(self, episodes: Any) -> None: ...

    def plan(self, view: Any, belief: Any) -> Any:
        assert not view.others.any()
        assert not len(view.readings)
        place = to_local(view.pose[:, None], belief.pose[..., :2])
        ahead = (place[..., 0] > 0) & (place[..., 0] < self.distance) & (np.abs(place[..., 1]) < 2.0)
        danger = (ahead & (belief.kind != AgentKind.NONE)).any(1)
        return np.stack([0.5 * ~danger, danger, np.zeros(len(danger))], 1).astype(np.float32)


class NoPerceive:
    sensors, classes = ("CAM_FRONT",), ("car",)

    def reset(self, episodes: Any) -> None: ...


class NoLists(Ahead):
    classes = "car"  # type: ignore[assignment]
