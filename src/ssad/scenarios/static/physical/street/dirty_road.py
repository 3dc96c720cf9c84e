"""Dirty road patch: dirt on the road that leads a lane keeper out of its lane, and its controls.

Source: Sato et al., Dirty Road Can Attack: Security of Deep Learning based Automated Lane Centering under
Physical-World Attack (USENIX Security 2021): a grey patch in the lane that looks like dirt, between the lines, which
stay visible.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import F64, Episode
from ssad.rendering.camera.scene import TextureDecal
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.camera.texture import to_linear
from ssad.rendering.street_edit import StreetEdit
from ssad.scenarios.static.perturbation import (
    EGO,
    Perturbation,
    PerturbedScene,
    RecordedScene,
    SceneVictim,
    TargetImages,
)
from ssad.scenarios.static.physical.textures.card import load_texture

if TYPE_CHECKING:
    from ssad.core.detections import Truth
    from ssad.rendering.sensor_suite import SensorSuite

DIRT: Final = (0.05, 0.19)  # linear albedo: from wet dirt to dry dust; asphalt has 0.09
ASPHALT_ALBEDO: Final = 0.09
CELL: Final = (0.5, 0.1)  # m: size of a texel along and across the road
LENGTH: Final = 24.0  # m along the road
COVERING_WIDTH: Final = 5.2  # m across the road: the patch covers the lines of the lane
INNER_WIDTH: Final = 2.9  # m: the patch lies between them
SHIPPED_PATCHES: Final = {name: Path(__file__).parent / "trained" / f"{name}.json" for name in ("over", "between")}
PATTERNS: Final = (*SHIPPED_PATCHES, "shuffled", "random", "clean")
EDGE: Final = 20.0  # m of the route behind a place; on recordings, m from the first pose to a place


@dataclass(frozen=True)
class DirtyRoad(Perturbation):
    """Dirt on the road in the lane of the ego.

    Attributes:
        pattern: Trained against the lane keeper: "over", which covers the lines of the lane, or "between" them, as in
            the source. A control: "shuffled", the texels of "over" in random order; "random", dirt over the whole range
            of greys, far stronger than the patch; or "clean", an even patch as dark as the road. Or the path of a card
            (NAME.json beside NAME.png).
        distance: Place of its middle along the route, m.
        width: m across the road, of a control.
        mirrored: Whether left and right are exchanged, so that the patch leads to the other side.
        seed: Seed of the order, and of random dirt.

    Raises:
        ConfigError: There is no such pattern, or the distance is below 0.
        FormatError: A file is missing or broken.
    """

    pattern: str = "over"
    distance: float = 90.0
    width: float = COVERING_WIDTH
    mirrored: bool = False
    seed: int = 0
    severity: int = field(default=1, init=False)
    family: str = field(default="texture", init=False)

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS and not self.pattern.endswith(".json"):
            raise ConfigError(f"dirty-road: pattern '{self.pattern}'; choose {', '.join(PATTERNS)} or a card NAME.json")
        if not 0.0 <= self.distance < 1e5 or not 0.5 <= self.width <= 12.0:
            raise ConfigError(
                f"dirty-road: distance {self.distance:g} and width {self.width:g}; expected m along the route, from 0, "
                "and 0.5 to 12 m across it"
            )
        self.albedo()

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        pattern = Path(self.pattern).stem if self.pattern.endswith(".json") else self.pattern
        fields = {"mirrored": False, "distance": 90.0, "width": COVERING_WIDTH, "seed": 0}
        values = {key: getattr(self, key) for key in fields}
        text = "&".join(f"{key}={values[key]:g}" for key, default in fields.items() if values[key] != default)
        base = "dirty-road" if pattern == "over" else f"dirty-road-{pattern}"
        return f"{base}?{text}" if text else base

    @property
    def place_distance(self) -> float:
        """Distance along the route of its near edge, m."""
        return max(self.distance - 0.5 * LENGTH, 0.0)

    def version(self) -> str:
        """Return the hash of the trained patch; "" for the controls."""
        if self.pattern in ("random", "clean"):
            return ""
        pattern = "over" if self.pattern == "shuffled" else self.pattern
        return load_texture(_card_path(pattern))[1].hash[:12]

    def albedo(self) -> Tensor:
        """Return the linear albedo [3, H, W]: rows from the far edge to the near one, columns from left to right."""
        cells = round(LENGTH / CELL[0]), max(round(self.width / CELL[1]), 1)
        if self.pattern == "clean":
            grey = torch.full(cells, ASPHALT_ALBEDO)
        elif self.pattern == "random":
            values = generator("dirty road", self.seed).uniform(*DIRT, cells)
            grey = torch.from_numpy(values.astype(np.float32))
        elif self.pattern == "shuffled":
            trained = _load_patch("over")
            order = generator("dirty road order", self.seed).permutation(trained.numel())
            grey = trained.flatten()[torch.from_numpy(order)].reshape(trained.shape)
        else:
            grey = _load_patch(self.pattern)
        grey = grey.flip(1) if self.mirrored else grey
        return grey.expand(3, *grey.shape).contiguous()

    def edit(self) -> SceneEdit:
        """Return the patch in the frame of its middle: x along the road, y to the left."""
        albedo = self.albedo()
        return SceneEdit(decals=(road_decal(patch_size(albedo)),), textures={0: albedo})

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if its route is long enough for the patch and the way behind it."""
        return EGO if has_place(episode, self.distance) else None

    @property
    def needs_place(self) -> bool:
        """True: the route must pass its place."""
        return True

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite in which the patch lies on the road."""
        return suite.with_street_edit(StreetEdit(self.edit(), (self.distance, 0.0)))

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target with the patch on the road behind it, 1 m from its rear."""
        from ssad.scenarios.static.physical.street.placing import behind_target

        return images.lit("recorded", behind_target(self.edit(), 1.0 + 0.5 * LENGTH))

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return the images of a scene with the patch on the road ahead of where the ego was at its start."""
        from ssad.scenarios.static.physical.street.placing import painted_scene

        albedo = self.albedo()
        return painted_scene(scene, albedo, patch_size(albedo), distance=EDGE + 0.5 * LENGTH)


def patch_size(albedo: Tensor) -> tuple[float, float]:
    """Return the size of a patch [3, H, W] along and across the road, m."""
    return albedo.shape[1] * CELL[0], albedo.shape[2] * CELL[1]


def road_decal(size: tuple[float, float]) -> TextureDecal:
    """Return a decal of texture 0 on the road, with its upper edge at the far end for traffic along x.

    Args:
        size: m along and across the road.
    """
    pose: F64 = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
    return TextureDecal(0, pose, (size[1], size[0]), depth=0.1, tag=0)


def has_place(episode: Episode, distance: float) -> bool:
    """Return True if the route of an episode's ego passes a place and goes on for `EDGE` m."""
    route = episode.agents[EGO].route
    if route is None:
        return False
    return float(np.hypot(*np.diff(route.xy.astype(np.float64), axis=0).T).sum()) > distance + EDGE


@lru_cache(maxsize=16)
def _load_patch(pattern: str) -> Tensor:
    """Return the linear albedo [H, W] of a trained patch."""
    texture, _ = load_texture(_card_path(pattern))
    return to_linear(texture).mean(0)


def _card_path(pattern: str) -> str:
    """Return the path of the card of a trained patch."""
    return str(SHIPPED_PATCHES.get(pattern, pattern))
