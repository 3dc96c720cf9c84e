"""Names, severities and random keys of shifts.

The 11 shifts are those of the paper (III.A.2), plus a few more. There are two calibrations: `paper`, the published
severity tables of 3D_Corruptions_AD (Dong et al., CVPR 2023), image by image; `physical` (default), parameters with
units, one weather in the world for all cameras and the LiDAR, object by object.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import digest, generator

Calibration = Literal["physical", "paper"]
Family = Literal["environment", "sensor", "object"]
SHIFTS: Final[dict[str, tuple[Family, str]]] = {
    "snow": ("environment", "falling snow: flakes in the air of the world, and the veil of those far away"),
    "rain": ("environment", "falling rain: streaks of drops in the air, the veil of those far away, and a wet road"),
    "fog": ("environment", "fog by depth (Koschmieder), patchy in the world"),
    "sunlight": ("environment", "a low sun in front of some cameras: glare, bloom, ghosts"),
    "uniform": ("sensor", "uniform noise"),
    "gaussian": ("sensor", "gaussian noise"),
    "impulse": ("sensor", "salt and pepper, some of it stuck pixels"),
    "scale": ("object", "objects larger or smaller"),
    "shear": ("object", "objects sheared"),
    "rotation": ("object", "objects turned about the vertical"),
    "motion_blur": ("object", "objects blurred along their motion"),
}
# additions to the paper's, used only if named: suites and tables default to the paper's
EXTRA: Final[dict[str, tuple[Family, str]]] = {
    "overexposure": ("sensor", "exposed for too long: bright parts are white"),
    "anomaly": ("environment", "objects of no class on the road: debris, animals, overturned vehicles, fallen trees"),
}
KNOWN: Final = SHIFTS | EXTRA
PLACING: Final = ("anomaly",)  # shifts that add objects to the scene
CAMERA_ONLY: Final = ("overexposure",)  # no LiDAR twin
SEVERITIES: Final = (1, 2, 3, 4, 5)
# a change of what a shift computes changes its bits, hence its keys and manifests
VERSIONS: Final[dict[Calibration, int]] = {"physical": 4, "paper": 3}
# the same of LiDAR points alone; random numbers do not depend on it
LIDAR_VERSIONS: Final[dict[Calibration, int]] = {"physical": 1, "paper": 2}


@dataclass(frozen=True, slots=True)
class ShiftSpec:
    """Shift to apply.

    Random numbers depend on the seed, the shift and their purpose, not on the severity: a sun stays in place as it
    gets stronger, so that severities can be compared in pairs.

    Attributes:
        name: Name of the shift.
        severity: 0 (identity) to 5.
        seed: Seed of its random numbers.
        calibration: Calibration of its severities.

    Raises:
        ConfigError: There is no such shift, severity or calibration.
    """

    name: str
    severity: int = 3
    seed: int = 0
    calibration: Calibration = "physical"

    def __post_init__(self) -> None:
        if self.name not in KNOWN:
            raise unknown_name("shift", self.name, KNOWN)
        if isinstance(self.severity, bool) or self.severity not in (0, *SEVERITIES):
            raise ConfigError(f"severity {self.severity!r} of shift '{self.name}': expected 0 to 5")
        if self.calibration not in get_args(Calibration):
            raise unknown_name("calibration", self.calibration, get_args(Calibration))

    @property
    def family(self) -> Family:
        """Family of the shift: environment, sensor or object."""
        return KNOWN[self.name][0]

    @property
    def places_objects(self) -> bool:
        """True if the shift adds objects to the scene, which its sensors then observe."""
        return self.name in PLACING

    def at(self, severity: int) -> ShiftSpec:
        """Return the same shift at another severity."""
        return replace(self, severity=severity)

    def key(self, *scope: object) -> int:
        """Return a key of 64 bits for a purpose of random numbers, such as ("air", scene)."""
        return int(digest("shift", VERSIONS[self.calibration], self.name, self.calibration, self.seed, *scope)[:16], 16)

    def generator(self, *scope: object) -> np.random.Generator:
        """Return the generator for a purpose of random numbers."""
        return generator("shift", VERSIONS[self.calibration], self.name, self.calibration, self.seed, *scope)


def random_severity(spec: ShiftSpec, scene: str, sample: str) -> int:
    """Draw severity 1 to 5 for "random": by sample in the paper's calibration, by scene in the physical one.

    The paper only says that the strength is a random value from 1 to 5; weather does not change twice a second.
    """
    scope = sample if spec.calibration == "paper" else scene
    return int(spec.generator("severity", scope).integers(1, 6))


def deal_severities(spec: ShiftSpec, scenes: Iterable[str]) -> dict[str, int]:
    """Deal severities 1 to 5 to scenes, each as often as any other, plus or minus one.

    For the physical calibration, which has one severity per scene. Independent draws (`random_severity`) leave the
    mean severity of a few dozen scenes to chance; dealing makes it depend on the set of scenes instead.
    """
    order = sorted(set(scenes), key=lambda scene: (spec.key("deal", scene), scene))
    first = int(spec.generator("deal").integers(5))
    return {scene: 1 + (first + index) % 5 for index, scene in enumerate(order)}
