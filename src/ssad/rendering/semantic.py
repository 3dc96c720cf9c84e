"""Semantic camera: what each pixel shows, with the numbers of CARLA 0.9.14 and later, which are those of Cityscapes.

Agents have the class of their kind; everything else that of its material. Source of the numbers: CARLA's reference of
sensors, semantic segmentation camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.driving import Simulator
from ssad.core.frames import Camera
from ssad.core.types import I32, U8, AgentKind
from ssad.rendering.camera.render import render

if TYPE_CHECKING:
    from ssad.rendering.onboard import AgentView, Onboard


class SemanticClass(IntEnum):
    """Class of a pixel."""

    UNLABELED = 0
    ROAD = 1
    SIDEWALK = 2
    BUILDING = 3
    WALL = 4
    FENCE = 5
    POLE = 6
    TRAFFIC_LIGHT = 7
    TRAFFIC_SIGN = 8
    VEGETATION = 9
    TERRAIN = 10
    SKY = 11
    PEDESTRIAN = 12
    RIDER = 13
    CAR = 14
    TRUCK = 15
    BUS = 16
    MOTORCYCLE = 18
    BICYCLE = 19
    STATIC = 20
    ROAD_LINE = 24
    GROUND = 25


_MATERIALS: Final = {
    SemanticClass.ROAD: ("asphalt", "asphalt_patch", "asphalt_worn", "cobbles"),
    SemanticClass.SIDEWALK: ("paving", "kerb"),
    SemanticClass.BUILDING: (
        *("awning", "boards", "brick", "cladding", "door", "plaster", "plinth", "roof_tiles", "roofing_felt", "sheet"),
        *("shop_window", "window", "window_blind", "window_frame"),
        *("shop_back", "shop_ceiling", "shop_goods", "window_curtain", "window_room"),
    ),
    SemanticClass.WALL: ("stone",),
    SemanticClass.FENCE: ("wood",),
    SemanticClass.POLE: ("lamp_post", "lamp_light", "galvanised", "cast_iron", "pole"),
    SemanticClass.TRAFFIC_LIGHT: ("signal_red", "signal_amber", "signal_green", "black_plastic"),
    SemanticClass.TRAFFIC_SIGN: ("sign_white", "sign_red", "sign_blue", "sign_yellow", "sign_back", "sign_ink"),
    SemanticClass.VEGETATION: (
        *(
            "leaves_round",
            "leaves_tall",
            "leaves_birch",
            "leaves_conifer",
            "twigs",
            "hedge",
            "bark",
            "forest",
            "tree_line",
        ),
    ),
    SemanticClass.TERRAIN: (
        *("meadow", "dry_grass", "grass", "grass_blades", "soil", "lawn", "hills"),
        *("field_meadow", "field_crop", "field_stubble", "field_soil"),
    ),
    SemanticClass.ROAD_LINE: ("marking_white", "marking_yellow"),
    SemanticClass.GROUND: ("driveway", "parking_bay"),
}
CLASS_OF_MATERIAL: Final = {name: label for label, names in _MATERIALS.items() for name in names}
"""Class of a material of the street by its name; others are static objects."""
CLASS_OF_KIND: Final = {
    AgentKind.CAR: SemanticClass.CAR,
    AgentKind.TRUCK: SemanticClass.TRUCK,
    AgentKind.BUS: SemanticClass.BUS,
    AgentKind.MOTORCYCLE: SemanticClass.MOTORCYCLE,
    AgentKind.BICYCLE: SemanticClass.BICYCLE,
    AgentKind.WALKER: SemanticClass.PEDESTRIAN,
    AgentKind.PROP: SemanticClass.STATIC,
}
"""Class of an agent by its kind. Riders have the class of what they ride."""


@dataclass(frozen=True, slots=True)
class OnboardSemanticCamera:
    """Semantic camera that agents carry.

    Attributes:
        onboard: Sensors with which it shares its scenes.
        camera: Lens, and place on the agent.
    """

    onboard: Onboard
    camera: Camera

    def follow(self, simulator: Simulator) -> None:
        """Record the poses of this step for the shared scenes."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> U8:
        """Return `SemanticClass` [N, H, W] of agents [N, 2] (scene, agent); UNLABELED if the episode has ended."""
        shape = (len(agents), self.camera.height, self.camera.width)
        labels = np.full(shape, SemanticClass.UNLABELED, np.uint8)
        kinds = simulator.state().kind
        for sight in self.onboard.agent_views(simulator, agents):
            labels[sight.row] = self._read(sight, kinds[int(agents[sight.row, 0])])
        return labels

    def _read(self, sight: AgentView, kinds: Sequence[int] | I32) -> U8:
        scene = sight.town.scene
        view, quality = self.onboard.view(sight, self.camera), self.onboard.quality
        rendering = render(scene, [view], quality=quality, linear=False, materials=True)
        assert rendering.material is not None
        by_material = [CLASS_OF_MATERIAL.get(name, SemanticClass.STATIC) for name in scene.material_names]
        # The last entry is that of row -1, the sky.
        labels: U8 = np.array([*by_material, SemanticClass.SKY], np.uint8)[rendering.material[0]]
        tags = rendering.tag[0]
        by_agent = [CLASS_OF_KIND.get(AgentKind(int(kind)), SemanticClass.STATIC) for kind in kinds]
        is_agent = (tags > 0) & (tags <= len(by_agent))
        labels[is_agent] = np.array(by_agent, np.uint8)[tags[is_agent] - 1]
        return labels
