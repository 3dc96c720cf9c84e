"""Natural distribution shifts on images and LiDAR sweeps: the 11 of the paper (III.A.2) and a few more.

`shift_images` for cameras, `shift_points` for the LiDAR twin, `transformed_boxes` for labels that follow the objects.
"""

from ssad.scenarios.static.shifts.apply import shift_images, sky_light, viewing_direction
from ssad.scenarios.static.shifts.lidar import shift_points
from ssad.scenarios.static.shifts.objects import transformed_boxes
from ssad.scenarios.static.shifts.spec import (
    EXTRA,
    KNOWN,
    SEVERITIES,
    SHIFTS,
    VERSIONS,
    Calibration,
    ShiftSpec,
    deal_severities,
    random_severity,
)

__all__ = [
    "EXTRA",
    "KNOWN",
    "SEVERITIES",
    "SHIFTS",
    "VERSIONS",
    "Calibration",
    "ShiftSpec",
    "deal_severities",
    "random_severity",
    "shift_images",
    "shift_points",
    "sky_light",
    "transformed_boxes",
    "viewing_direction",
]
