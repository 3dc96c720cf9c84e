"""Edits of a street on recorded images: behind a recorded target, and painted on the road of a recorded scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from torch import Tensor

from ssad.core.boxes import UNIT_CORNERS
from ssad.core.frames import Camera
from ssad.core.images import decode_srgb, encode_srgb
from ssad.core.rotations import upright_pose
from ssad.core.types import F32, F64, U8
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.perturbation import PerturbedScene, RecordedScene

ROAD_ALBEDO: Final = 0.09  # assumed albedo of the asphalt in a recorded image
MIN_DEPTH: Final = 0.5  # m before the camera, below which points are not projected


def behind_target(edit: SceneEdit, distance: float) -> SceneEdit:
    """Return an edit of the street in the frame of a target: its place lies behind the rear, on the road.

    Args:
        edit: The edit in the frame of its place.
        distance: m from the rear of a car to the place.
    """
    lower, _ = TargetCar().mesh().bounds()
    shift = np.eye(4)
    shift[0, 3] = float(lower[0]) - distance
    return replace(
        edit,
        lamps=tuple(replace(lamp, pose=shift @ lamp.pose) for lamp in edit.lamps),
        decals=tuple(replace(decal, pose=shift @ decal.pose) for decal in edit.decals),
    )


def painted_scene(
    scene: RecordedScene,
    colour: Tensor,
    size: tuple[float, float],
    *,
    distance: float,
    light: float | None = None,
    mask: F32 | None = None,
) -> PerturbedScene:
    """Return the camera images of a recorded scene with a texture on the road ahead of the ego's first pose.

    The road is the plane under the wheels of the ego at that moment. Annotated boxes stand before the texture; nothing
    else hides it.

    Args:
        scene: The recorded scene.
        colour: Linear albedo, or share of the projected light [3, H, W], rows from the far edge to the near one.
        size: m along and across the road.
        distance: m from the first pose of the ego to the middle of the texture.
        light: Light of a white texel, as a multiple of the light that the road receives; None: the texture is painted.
        mask: Opacity of each texel [H, W]; None: 1.
    """
    cameras = [frame for frame in scene.data.frames if frame.modality == "camera"]
    place = cameras[0].ego_to_world @ upright_pose(distance, 0.0, 0.0) if cameras else np.eye(4)
    texture = np.moveaxis(colour.numpy().astype(np.float32), 0, -1)
    opacity = np.ones(texture.shape[:2], np.float32) if mask is None else mask

    def load(frames: Sequence[SensorFrame]) -> list[U8]:
        images = []
        for frame in frames:
            image = read_frame_image(scene.root, frame)
            if frame.intrinsic is not None:
                camera = Camera(image.shape[1], image.shape[0], frame.intrinsic, frame.sensor_to_ego, frame.channel)
                hidden = _outlines(scene, frame, camera)
                image = paint_road(
                    image, camera, frame.ego_to_world, place, size, texture, light=light, opacity=opacity, hidden=hidden
                )
            images.append(image)
        return images

    return PerturbedScene(load)


def paint_road(  # noqa: PLR0917  # plain values
    image: U8,
    camera: Camera,
    ego_to_world: F64,
    place: F64,
    size: tuple[float, float],
    texture: F32,
    *,
    light: float | None,
    opacity: F32,
    hidden: Sequence[F32] = (),
) -> U8:
    """Return an image with a texture on the road.

    Args:
        image: uint8 [H, W, 3].
        camera: Its camera.
        ego_to_world: Pose of the ego [4, 4].
        place: Pose of the middle of the texture [4, 4]: x along the road, y to the left, on the road.
        size: m along and across the road.
        texture: Linear RGB [h, w, 3].
        light: Light of a white texel, as in `painted_scene`.
        opacity: [h, w].
        hidden: Outlines [N, 2], px, of what stands before it.
    """
    road_length, road_width = size
    road_corners = np.array([(0.5 * road_length, 0.5 * road_width), (0.5 * road_length, -0.5 * road_width)])
    road_corners = np.concatenate([road_corners, -road_corners])  # far left, far right, near right, near left
    world_points = np.column_stack([road_corners, np.zeros(4), np.ones(4)]) @ place.T
    to_camera = np.linalg.inv(ego_to_world @ camera.to_ego)
    camera_points = (world_points @ to_camera.T)[:, :3]
    if (camera_points[:, 2] < MIN_DEPTH).any():
        return image  # partly behind the camera
    pixel_corners = camera_points @ camera.intrinsic.T
    pixel_corners = (pixel_corners[:, :2] / pixel_corners[:, 2:]).astype(np.float32)
    texel_rows, texel_columns = opacity.shape
    texel_corners = np.array([(0, 0), (texel_columns, 0), (texel_columns, texel_rows), (0, texel_rows)], np.float32)
    # Pixel centres lie at half numbers in the image, at whole numbers in OpenCV.
    homography = cv2.getPerspectiveTransform(texel_corners - 0.5, pixel_corners - 0.5)
    frame_size = (image.shape[1], image.shape[0])
    # Beyond its edge the texture goes on, and its opacity ends.
    warped_texture = cv2.warpPerspective(
        texture, homography, frame_size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    warped_opacity = cv2.warpPerspective(opacity.astype(np.float32), homography, frame_size, flags=cv2.INTER_LINEAR)
    for hidden_outline in hidden:
        cv2.fillConvexPoly(warped_opacity, np.rint(hidden_outline).astype(np.int32), 0.0)
    road_light = decode_srgb(image)
    changed_light = (
        road_light * warped_texture / ROAD_ALBEDO if light is None else road_light * (1.0 + light * warped_texture)
    )
    return encode_srgb(road_light + warped_opacity[..., None] * (changed_light - road_light))


def _outlines(scene: RecordedScene, frame: SensorFrame, camera: Camera) -> list[F32]:
    """Return the outlines [N, 2] of the annotated boxes that lie in front of a camera, px."""
    boxes = scene.data.annotations_at(frame.timestamp_us)
    corners = boxes.corners().reshape(-1, 3)
    in_camera = (corners - (frame.ego_to_world @ camera.to_ego)[:3, 3]) @ (frame.ego_to_world @ camera.to_ego)[:3, :3]
    outlines = []
    for box in in_camera.reshape(-1, len(UNIT_CORNERS), 3):
        if (box[:, 2] > MIN_DEPTH).all():
            pixels = box @ camera.intrinsic.T
            outlines.append(cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.float32))[:, 0])
    return outlines
