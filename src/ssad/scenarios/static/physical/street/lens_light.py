"""Light into the lens: a laser or a torch that is aimed at the camera, with its veil and its spot.

A lens scatters a small share of the light that enters it over the whole image. The veil
follows the equation of disability glare, L = 10 E / (angle^2 + core^2) (CIE 146:2002; L in cd/m^2, E the illuminance at
the lens in lux, angles in degrees), times a factor of the lens. Near the source it exceeds what the sensor can hold.
Petit et al., Remote Attacks on Automated Vehicles Sensors (Black Hat Europe 2015), blinded a camera with such lights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from ssad.core.colours import LUMINANCE
from ssad.core.driving import Frames, Generators
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.images import decode_srgb, encode_srgb
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, U8, Episode
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.rendering.camera.photometry import illuminance
from ssad.rendering.hours import SUN
from ssad.rendering.street_edit import route_pose
from ssad.scenarios.static.perturbation import (
    EGO,
    Perturbation,
    PerturbedScene,
    RecordedScene,
    SceneVictim,
    TargetImages,
)
from ssad.scenarios.static.physical.street.dirty_road import EDGE, has_place

if TYPE_CHECKING:
    from torch import Tensor

    from ssad.core.detections import Truth
    from ssad.rendering.sensor_suite import SensorSuite

GLARE: Final = 10.0  # of the equation of disability glare
CORE: Final = 0.05  # degrees: radius of the image of a point
WHITE: Final = 1.28  # reflectance that fills the sensor under the light of the hour
DARKEST: Final = 10.0  # lux of a street at night, with lamps
POWERS: Final = (0.01, 0.1, 1.0, 10.0, 100.0)  # factor of the usual power of a source, by severity
SOURCES: Final = ("laser", "torch")
LASER_WATTS: Final = 0.05  # W; pointers have 0.001 to 0.005
LASER_EFFICACY: Final = 604.0  # lm/W at 532 nm
LASER_BEAM: Final = 0.001  # rad, half angle of the widened beam
TORCH_LUMENS: Final = 3000.0
TORCH_BEAM: Final = 0.08  # rad, half angle
COLOURS: Final = {"laser": (0.08, 1.0, 0.12), "torch": (1.0, 0.97, 0.90)}
MAX_DISTANCE: Final = 150.0  # m from the lens, beyond which a source is left out


@dataclass(frozen=True)
class LensLight(Perturbation):
    """Light that a person beside the road holds into the camera.

    Attributes:
        source: laser (green, 532 nm) or torch.
        distance: Place of the person along the route, m.
        lateral: m to the left of the lane's middle.
        height: m above the road.
        power: Optical power of a laser, W, or luminous flux of a torch, lm; None: by severity.
        beam: Half angle of the beam, rad; None: that of the source.
        scatter: Scattered light of the lens, as a multiple of that of the eye: 0.3 for a clean lens, 3 for a dirty one.
        aim: Share of the images in which the beam of a shaking hand meets the lens.
        severity: 1 to 5, the power.

    Raises:
        ConfigError: A value is unknown or out of its range.
    """

    source: str = "laser"
    distance: float = 90.0
    lateral: float = -4.0
    height: float = 1.6
    power: float | None = None
    beam: float | None = None
    scatter: float = 1.0
    aim: float = 0.7
    severity: int = 3
    family: str = field(default="light", init=False)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ConfigError(f"lens-light: source '{self.source}'; choose {' or '.join(SOURCES)}")
        numbers = [self.distance, self.lateral, self.height, self.scatter, self.aim, self.half_angle]
        if self.power is not None:
            numbers.append(self.power)
        is_valid = bool(np.isfinite(numbers).all()) and min(self.distance, self.scatter, self.aim) >= 0.0
        is_valid &= self.aim <= 1.0 and 1e-5 <= self.half_angle <= 1.5 and self.severity in range(1, 6)
        if not is_valid or (self.power is not None and self.power < 0.0):
            raise ConfigError(
                f"{self.name}: a value is out of its range; give finite numbers: distance, power and scatter from 0, "
                "aim from 0 to 1, beam from 1e-5 to 1.5 rad, severity 1 to 5"
            )

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name in tables and slices."""
        defaults = {"distance": 90.0, "lateral": -4.0, "height": 1.6, "power": None, "beam": None, "scatter": 1.0}
        values = {key: getattr(self, key) for key in (*defaults, "aim")}
        text = "&".join(f"{key}={values[key]:g}" for key in values if values[key] != {**defaults, "aim": 0.7}[key])
        return f"lens-{self.source}?{text}" if text else f"lens-{self.source}"

    @property
    def half_angle(self) -> float:
        """Half angle of the beam, rad."""
        return (LASER_BEAM if self.source == "laser" else TORCH_BEAM) if self.beam is None else self.beam

    @property
    def lumens(self) -> float:
        """Luminous flux of the source, lm."""
        usual = LASER_WATTS if self.source == "laser" else TORCH_LUMENS
        power = POWERS[self.severity - 1] * usual if self.power is None else self.power
        return power * (LASER_EFFICACY if self.source == "laser" else 1.0)

    def lux(self, distance: float) -> float:
        """Return the illuminance at a lens in the beam, lux.

        Args:
            distance: m from the source.
        """
        radius = 0.002 + distance * np.tan(self.half_angle)
        return self.lumens / float(np.pi * radius * radius)

    @property
    def place_distance(self) -> float:
        """Distance along the route of the source, m."""
        return self.distance

    @property
    def needs_place(self) -> bool:
        """True: the route must pass its place."""
        return True

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:
        """Return the ego, if its route passes the place."""
        return EGO if has_place(episode, self.distance) else None

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with the light in all its cameras.

        Raises:
            ConfigError: The suite has no camera.
        """
        if not suite.cameras:
            raise ConfigError(f"{self.name} needs a camera; this system has {', '.join(suite.sensors) or 'no sensors'}")
        for name, camera in suite.cameras.items():
            suite = suite.with_reading_change(name, _LensFlare(self, camera, full_scale(suite.weather.sun_height)))
        return suite

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return the images of a scene with the source ahead of the ego's first pose, in the light of noon."""
        cameras = [frame for frame in scene.data.frames if frame.modality == "camera"]
        place = cameras[0].ego_to_world @ upright_pose(EDGE, self.lateral, 0.0, self.height) if cameras else np.eye(4)
        scale = full_scale(SUN["noon"])

        def load(frames: Sequence[SensorFrame]) -> list[U8]:
            images = []
            for frame in frames:
                image = read_frame_image(scene.root, frame)
                beam_hits = generator("lens light", scene.seed, frame.scene_token, frame.token).random() < self.aim
                if frame.intrinsic is not None and beam_hits:
                    camera = Camera(image.shape[1], image.shape[0], frame.intrinsic, frame.sensor_to_ego, frame.channel)
                    image = self.shine(image, camera, frame.ego_to_world, place[:3, 3], scale)
                images.append(image)
            return images

        return PerturbedScene(load)

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target with the source at its right edge, 20 m from the camera."""
        scale = full_scale(SUN["noon"])
        for number, (drive, image, truth) in enumerate(images.clean()):
            if generator("lens light", drive, number).random() >= self.aim:
                yield drive, image, truth
                continue
            pixels = np.rint(255.0 * np.moveaxis(image[0].cpu().numpy(), 0, -1)).astype(np.uint8)
            camera = Camera.typical(pixels.shape[1], pixels.shape[0])
            _, top, right, bottom = truth.box[0].tolist()
            veil = self.veil(camera, np.array([right, 0.5 * (top + bottom)]), 20.0, scale)
            lit = encode_srgb(decode_srgb(pixels) + veil)
            yield drive, torch.from_numpy(np.moveaxis(lit, -1, 0).copy())[None].to(image) / 255.0, truth

    def shine(self, image: U8, camera: Camera, ego_to_world: F64, place: F64, scale: float) -> U8:
        """Return an image [H, W, 3] with the light of a source; unchanged where the source is not ahead.

        Args:
            image: uint8 RGB.
            camera: Its camera.
            ego_to_world: Pose of the ego [4, 4].
            place: Place of the source [3], m.
            scale: Luminance that fills the sensor, cd/m^2.
        """
        to_camera = np.linalg.inv(ego_to_world @ camera.to_ego)
        right, down, depth = (to_camera @ np.append(place, 1.0))[:3]
        distance = float(np.sqrt(right * right + down * down + depth * depth))
        if depth < 0.5 or distance > MAX_DISTANCE:
            return image
        pixel_column, pixel_row, _ = camera.intrinsic @ np.array([right, down, depth]) / depth
        return encode_srgb(decode_srgb(image) + self.veil(camera, np.array([pixel_column, pixel_row]), distance, scale))

    def veil(self, camera: Camera, pixel: F64, distance: float, scale: float) -> F32:
        """Return the linear light [H, W, 3] that a source adds to an image, 1 where it fills the sensor.

        Args:
            camera: The camera.
            pixel: Place of the source in the image [2], px.
            distance: m from the source.
            scale: Luminance that fills the sensor, cd/m^2.
        """
        pixel_columns, pixel_rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        pixel_rays = (
            np.stack([pixel_columns, pixel_rows, np.ones_like(pixel_columns)], -1) @ np.linalg.inv(camera.intrinsic).T
        )
        pixel_rays /= np.linalg.norm(pixel_rays, axis=-1, keepdims=True)
        source_ray = np.linalg.inv(camera.intrinsic) @ np.append(pixel, 1.0)
        source_ray /= np.linalg.norm(source_ray)
        angle_degrees = np.degrees(np.arccos(np.clip(pixel_rays @ source_ray, -1.0, 1.0)))
        luminance = self.scatter * GLARE * self.lux(distance) / (angle_degrees * angle_degrees + CORE * CORE)
        # Colours share the luminance: a saturated colour fills its channel sooner.
        source_colour = np.array(COLOURS[self.source])
        colour_luminance = float(source_colour @ LUMINANCE)
        return np.asarray((luminance / scale)[..., None] * source_colour / colour_luminance, np.float32)


def full_scale(sun_height: float) -> float:
    """Return the luminance that fills the sensor at an hour, cd/m^2: its exposure follows the light of the street.

    Args:
        sun_height: rad.
    """
    return WHITE * max(illuminance(sun_height), DARKEST) / float(np.pi)


@dataclass(frozen=True, slots=True)
class _LensFlare:
    """Change of the images of one camera."""

    light: LensLight
    camera: Camera
    scale: float

    def apply(self, frames: Frames, victim: Any, truth: Any, generators: Generators) -> Frames:
        """Add the light to the images of all egos, uint8 [N, 3, H, W]."""
        changed_frames = frames.copy()
        for scene_row, (ego_frame, frame_generator) in enumerate(zip(frames, generators, strict=True)):
            beam_hits = frame_generator.random() < self.light.aim
            first_point, point_count = truth.route[scene_row, EGO].tolist()
            if not ego_frame.any() or not beam_hits or not point_count:
                continue
            route_points = truth.roads.path[first_point : first_point + point_count, :2].astype(np.float64)
            source_place = route_pose(route_points, self.light.distance, self.light.lateral)[:3, 3] + [
                0.0,
                0.0,
                self.light.height,
            ]
            x, y, yaw = truth.pose[scene_row, EGO].astype(np.float64).tolist()
            clean_image = np.ascontiguousarray(np.moveaxis(ego_frame, 0, -1))
            lit_image = self.light.shine(clean_image, self.camera, upright_pose(x, y, yaw), source_place, self.scale)
            changed_frames[scene_row] = np.moveaxis(lit_image, -1, 0)
        return changed_frames
