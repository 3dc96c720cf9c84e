"""Phantoms: pictures of people and signs that a projector throws onto the road or onto a screen beside it.

Source: Nassi et al., Phantom of the ADAS: Securing Advanced Driver-Assistance Systems from Split-Second Phantom Attacks
(CCS 2020): objects without depth, projected or shown for a moment, that a system takes for real ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.frames import Camera
from ssad.core.images import decode_srgb
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, Episode
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.effects import NO_EFFECTS
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.photometry import illuminance
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.hours import HOURS, SUN, at_hour
from ssad.rendering.meshes.mesh import Material, Mesh
from ssad.rendering.meshes.mesh import build as build_mesh
from ssad.rendering.street_edit import StreetEdit
from ssad.scenarios.static.perturbation import (
    EGO,
    Perturbation,
    PerturbedScene,
    RecordedScene,
    SceneVictim,
    TargetImages,
)
from ssad.scenarios.static.physical.lights.light import aimed_poses, first_array
from ssad.scenarios.static.physical.street.dirty_road import EDGE, has_place
from ssad.scenarios.static.physical.street.placing import behind_target, painted_scene

if TYPE_CHECKING:
    from ssad.core.detections import Truth
    from ssad.rendering.sensor_suite import SensorSuite

# picture -> kind and style of the body that it shows, and width and height of what is projected, m
PICTURES: Final = {
    "person": ("pedestrian", "standing", (1.0, 1.9)),
    "child": ("pedestrian", "standing", (0.7, 1.2)),
    "stop-sign": ("stop_sign", "standard", (0.9, 0.9)),
    "yield-sign": ("yield_sign", "standard", (0.9, 0.9)),
}
BLANK: Final = "blank"
SURFACES: Final = ("road", "screen")
LUMENS: Final = (20.0, 60.0, 200.0, 600.0, 2000.0)  # flux of a white picture by severity; a pocket projector: 100
TEXELS: Final = 96  # along the longer side of a picture
STRETCH: Final = 4.0  # factor of the length of a picture on the road, which the ego sees foreshortened
SCREEN_WIDTH, SCREEN_HEIGHT = 2.4, 2.4  # m
SCREEN: Final = Material("screen", (0.75, 0.75, 0.73))
PROJECTOR: Final = (6.0, 5.0)  # m before a screen, and m above the road (on a drone or a mast)
LEAK: Final = 0.001  # light that black parts of a picture pass, as a share of white


@dataclass(frozen=True)
class Phantom(Perturbation):
    """Picture of a person or a sign in the light of a projector.

    Attributes:
        picture: Name in `PICTURES`, or "blank": a control that spreads the light of the person evenly.
        onto: "road": in the middle of the lane, stretched along it; "screen": a pale board beside the road, which
            also stands there under the control.
        distance: Place along the route, m.
        lateral: m to the left of the middle of the lane; None: 0 on the road, 3.2 m to the right for a screen.
        lumens: Luminous flux of a white picture; None: by severity.
        hour: Hour of the episode (`ssad.rendering.hours.HOURS`); by day a projector shows nothing.
        severity: 1 to 5, the luminous flux.

    Raises:
        ConfigError: A value is unknown or out of its range.
    """

    picture: str = "person"
    onto: str = "road"
    distance: float = 90.0
    lateral: float | None = None
    lumens: float | None = None
    hour: str = "night"
    severity: int = 3
    family: str = field(default="light", init=False)

    def __post_init__(self) -> None:
        if self.picture not in (*PICTURES, BLANK):
            raise unknown_name("picture of a phantom", self.picture, (*PICTURES, BLANK))
        if self.onto not in SURFACES:
            raise unknown_name("surface of a phantom", self.onto, SURFACES)
        if self.hour not in HOURS:
            raise unknown_name("hour", self.hour, HOURS)
        lumens = LUMENS[0] if self.lumens is None else self.lumens
        if self.severity not in range(1, 6) or not 0.0 <= self.distance < 1e5 or not 0.0 <= lumens <= 1e6:
            raise ConfigError(
                f"phantom: severity {self.severity}, distance {self.distance:g} m, {lumens:g} lumens; give 1 to 5, a "
                "distance from 0, and 0 to 1e6 lumens"
            )

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        settings = {"lateral": self.lateral, "lumens": self.lumens}
        texts = [f"{key}={value:g}" for key, value in settings.items() if value is not None]
        texts += [f"distance={self.distance:g}"] if self.distance != 90.0 else []
        texts += [f"hour={self.hour}"] if self.hour != "night" else []
        base = f"phantom-{self.picture}-{self.onto}"
        return f"{base}?{'&'.join(texts)}" if texts else base

    @property
    def place_distance(self) -> float:
        """Distance along the route of the picture, m."""
        return self.distance

    @property
    def needs_place(self) -> bool:
        """True: the route must pass its place."""
        return True

    @property
    def flux(self) -> float:
        """Luminous flux of a white picture, lumen."""
        return LUMENS[self.severity - 1] if self.lumens is None else float(self.lumens)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of what is projected, m; on the road the height lies along it."""
        width, height = PICTURES["person" if self.picture == BLANK else self.picture][2]
        return (width, height * STRETCH) if self.onto == "road" else (width, height)

    def light(self) -> Tensor:
        """Return the share of the light that each texel passes [3, H, W]."""
        if self.picture != BLANK:
            return _picture_light(self.picture)
        person = _picture_light("person")
        # The same light, spread evenly.
        return person.mean((1, 2), keepdim=True).expand_as(person).contiguous()

    def edit(self) -> SceneEdit:
        """Return the projector in the frame of the place: x along the road, y to the left; power in lumen."""
        width, height = self.size
        if self.onto == "road":
            # Straight from above: the top of the picture is far from who drives along x.
            pose: F64 = np.eye(4)
            pose[:3, 0], pose[:3, 1], pose[:3, 2] = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
            pose[2, 3] = PROJECTOR[1]
            reach = PROJECTOR[1]
        else:
            aim = [0.0, 0.0, 0.5 * SCREEN_HEIGHT]
            positions = ([-PROJECTOR[0], 0.0, 0.5 * SCREEN_HEIGHT], aim)
            pose = first_array(aimed_poses(*(torch.tensor([values], dtype=torch.float64) for values in positions)))
            reach = PROJECTOR[0]
        spread = (0.5 * width / reach, 0.5 * height / reach)
        lamp = SceneLamp(pose, self.flux, spread, square=True, texture=0)
        return SceneEdit(lamps=(lamp,), textures={0: self.light()})

    def street_edit(self) -> StreetEdit:
        """Return the projector and its screen at their place on the route."""
        lateral = self.lateral
        if lateral is None:
            lateral = 0.0 if self.onto == "road" else -3.2
        bodies = ((screen_mesh(), np.eye(4)),) if self.onto == "screen" else ()
        return StreetEdit(self.edit(), (self.distance, lateral), bodies)

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if its route passes the place."""
        return EGO if has_place(episode, self.distance) else None

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with the projector at its place, at its hour."""
        suite = replace(suite, weather=at_hour(suite.weather, self.hour))
        return suite.with_street_edit(self.street_edit())

    def clean_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target at the hour of the phantom, without it."""
        return images.lit(self.hour, SceneEdit()) if self.hour != "recorded" else images.clean()

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target with the phantom on the road behind it, 4 m from its rear.

        Raises:
            ConfigError: The phantom is on a screen, which recorded targets do not have.
        """
        if self.onto != "road":
            raise ConfigError(f"{self.name}: a recorded target has no screen; write onto: road")
        return images.lit(self.hour, behind_target(self.edit(), 4.0 + 0.5 * self.size[1]))

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return the images of a scene with the phantom on the road ahead of where the ego was at its start.

        The light of the recording is taken as that of the hour.

        Raises:
            ConfigError: The phantom is on a screen.
        """
        if self.onto != "road":
            raise ConfigError(f"{self.name}: a recorded scene has no screen; write onto: road")
        width, height = self.size
        lux = self.flux / (width * height)
        ambient = max(illuminance(SUN.get(self.hour, SUN["noon"])), 10.0)
        return painted_scene(scene, self.light(), (height, width), distance=EDGE, light=lux / ambient)


def screen_mesh() -> Mesh:
    """Return a board that faces against x, with its foot on the ground."""
    half, thickness = 0.5 * SCREEN_WIDTH, 0.04
    front = np.array([(0, half, 0), (0, -half, 0), (0, -half, SCREEN_HEIGHT), (0, half, SCREEN_HEIGHT)], np.float64)
    back = front + np.array([thickness, 0.0, 0.0])
    points = np.concatenate([front, back])
    quads = [(0, 3, 2, 1), (4, 5, 6, 7), (3, 7, 6, 2), (0, 4, 7, 3), (1, 2, 6, 5)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, c, b), (a, d, c))])
    return build_mesh(points, faces, materials=SCREEN, smooth=0.0)


@lru_cache(maxsize=8)
def _picture_light(picture: str) -> Tensor:
    """Return the share of the light that each texel of a picture passes [3, H, W]: a body before a black background."""
    body_kind, body_style, (picture_width, picture_height) = PICTURES[picture]
    body_generator = generator("phantom", picture)
    is_sign = body_kind.endswith("sign")
    body_size = {"child": (0.35, 0.42, 1.15), "person": (0.45, 0.55, 1.78)}.get(picture, (0.08, 0.8, 2.8))
    body_mesh = make_body(body_kind, style=body_style, size=body_size, generator=body_generator)
    body_scene = RenderScene(None, [body_mesh])
    row_count = TEXELS if picture_height >= picture_width else round(TEXELS * picture_height / picture_width)
    column_count = max(round(row_count * picture_width / picture_height), 8)
    camera_distance = 30.0
    focal_length = row_count / picture_height * camera_distance
    # A sign is shown without its post: the picture ends below the plate.
    centre_height = body_size[2] - 0.5 * picture_height + 0.05 if is_sign else 0.5 * picture_height
    intrinsic = np.array([[focal_length, 0.0, column_count / 2], [0.0, focal_length, row_count / 2], [0.0, 0.0, 1.0]])
    camera_pose = upright_pose(camera_distance, 0.0, np.pi, centre_height) @ np.array(
        [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    )
    picture_camera = Camera(column_count, row_count, intrinsic)
    picture_view = View(
        picture_camera, camera_pose, (SceneObject(0, np.eye(4), (0.45, 0.1, 0.08), 1),), SceneWeather(0.9, 0.0, 0.3)
    )
    # A slide shows the body alone: air and lens add their light when the picture of the street is taken.
    rendering = render(body_scene, [picture_view], quality=RenderQuality(effects=NO_EFFECTS))
    linear_image = decode_srgb(np.asarray(rendering.image[0]))
    shown_light: F32 = np.where((np.asarray(rendering.tag[0]) == 1)[..., None], linear_image, 0.0).astype(np.float32)
    peak_light = (
        max(float(np.quantile(shown_light[shown_light > 0.0], 0.98)), 1e-3) if (shown_light > 0.0).any() else 1.0
    )
    passed_light = LEAK + (1.0 - LEAK) * (shown_light / peak_light).clip(0.0, 1.0)
    return torch.from_numpy(np.moveaxis(passed_light, -1, 0).astype(np.float32).copy())
