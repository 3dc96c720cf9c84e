"""The nuScenes schema: one typed record for each of its 13 tables.

Tokens are strings (32 hexadecimal digits in the original; any non-empty text here). Frames: global (x east, y north,
z up, metres), ego (x forward, y left, z up), sensor (camera: x right, y down, z forward). Quaternions are (w, x, y, z),
sizes (width, length, height), times in microseconds. Source: nuscenes.org, schema of version 1.0.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Microseconds = Annotated[int, msgspec.Meta(ge=-(1 << 60), le=1 << 60)]
Count = Annotated[int, msgspec.Meta(ge=-1, le=(1 << 30) - 1)]
"""A number of points or pixels; -1 where it is not known. Sums of two fit 32 bits."""


class TableRecord(msgspec.Struct, frozen=True, gc=False):
    """A row of a table."""

    token: str


class Attribute(TableRecord, frozen=True, gc=False):
    """A property of an instance that may change, such as vehicle.parked."""

    name: str
    description: str = ""


class CalibratedSensor(TableRecord, frozen=True, gc=False):
    """Pose of a sensor on the ego; `camera_intrinsic` is 3 x 3, empty for other sensors."""

    sensor_token: str
    translation: Vector
    rotation: Quaternion
    camera_intrinsic: tuple[tuple[float, ...], ...]


class Category(TableRecord, frozen=True, gc=False):
    """An object category such as vehicle.car."""

    name: str
    description: str = ""


class EgoPose(TableRecord, frozen=True, gc=False):
    """Pose of the ego in the global frame."""

    translation: Vector
    rotation: Quaternion
    timestamp: Microseconds


class Instance(TableRecord, frozen=True, gc=False):
    """An object followed over a scene."""

    category_token: str
    nbr_annotations: Count = 0
    first_annotation_token: str = ""
    last_annotation_token: str = ""


class Log(TableRecord, frozen=True, gc=False):
    """A drive from which scenes were cut."""

    logfile: str = ""
    vehicle: str = ""
    date_captured: str = ""
    location: str = ""


class Map(TableRecord, frozen=True, gc=False):
    """A top view of a place, shared by logs."""

    log_tokens: tuple[str, ...] = ()
    category: str = ""
    filename: str = ""


class Sample(TableRecord, frozen=True, gc=False):
    """A key frame, annotated twice a second."""

    timestamp: Microseconds
    scene_token: str
    prev: str = ""
    next: str = ""


class SampleAnnotation(TableRecord, frozen=True, gc=False):
    """A 3D box of an instance in a sample, in the global frame."""

    sample_token: str
    instance_token: str
    visibility_token: str
    attribute_tokens: tuple[str, ...]
    translation: Vector
    size: Vector
    rotation: Quaternion
    num_lidar_pts: Count = 0
    num_radar_pts: Count = 0
    prev: str = ""
    next: str = ""


class SampleData(TableRecord, frozen=True, gc=False):
    """A file of a sensor; those between key frames (sweeps) carry the token of the sample that follows."""

    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: Microseconds
    is_key_frame: bool
    filename: str
    fileformat: str = ""
    height: Count | None = None
    width: Count | None = None
    prev: str = ""
    next: str = ""


class Scene(TableRecord, frozen=True, gc=False):
    """A part of a log of about 20 s."""

    name: str
    log_token: str = ""
    description: str = ""
    nbr_samples: Count = 0
    first_sample_token: str = ""
    last_sample_token: str = ""


class Sensor(TableRecord, frozen=True, gc=False):
    """A sensor: channel such as CAM_FRONT, modality camera, lidar or radar."""

    channel: str
    modality: str


class Visibility(TableRecord, frozen=True, gc=False):
    """Fraction of an object seen over all six cameras: tokens '1' (0-40 %) to '4' (80-100 %)."""

    level: str
    description: str = ""


# File name of each table, without .json -> its record.
TABLES: Final[dict[str, type[TableRecord]]] = {
    "attribute": Attribute,
    "calibrated_sensor": CalibratedSensor,
    "category": Category,
    "ego_pose": EgoPose,
    "instance": Instance,
    "log": Log,
    "map": Map,
    "sample": Sample,
    "sample_annotation": SampleAnnotation,
    "sample_data": SampleData,
    "scene": Scene,
    "sensor": Sensor,
    "visibility": Visibility,
}
