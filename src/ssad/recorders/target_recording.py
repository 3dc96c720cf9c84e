"""What `ssad record --clips` records: towns, target, camera, and what cannot be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ssad.core.errors import ConfigError, unknown_name
from ssad.recorders.drives import check_streets
from ssad.recorders.nuscenes import HELD_OUT, WEATHERS
from ssad.rendering.target import Target, TargetSign, TargetWalker
from ssad.world.roads import is_town

AZIMUTHS: Final = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)  # of an orbit, degrees
ELEVATIONS: Final = (0.0, 15.0, 30.0)
SIGN_AZIMUTHS: Final = (0.0, 30.0, 60.0, 300.0, 330.0)  # as long as its face is seen
TALL: Final = {"car": 1.35, "walker": 0.5, "sign": 0.35}  # m, least extent of a target
BEHIND: Final = 75.0  # degrees from the front of a sign from which its face is hardly seen: it is crowd then
IMAGES: Final = {"Twinford": 600, "Crossgate": 400, "Oldmarket": 400, "Larkhill": 400}
FOCAL: Final = 1.1  # focal length in widths of the picture: 49 degrees across
SMALL: Final = 8.0  # px of a side of a target


@dataclass(frozen=True, slots=True)
class Clips:
    """What to record.

    images: town -> how many pictures; mode; size: pixels a side; target: the car (None: another one in each part), or
    the stop sign that an orbit shows; behind, height: m of the following camera; distances (m), azimuths, elevations
    (degrees) of an orbit, those of the target where none are given (round a sign: one elevation, 0, which stands for
    the heights of cameras of cars); weathers: of an orbit, a further factor of its cells (none: drawn as they come);
    quality: of JPEG files; device: where pictures are rendered; streets: see `drive_street`.
    ConfigError for what cannot be.
    """

    out: Path
    images: tuple[tuple[str, int], ...] = tuple(IMAGES.items())
    held_out: tuple[str, ...] = HELD_OUT
    mode: Literal["drive", "orbit"] = "drive"
    size: int = 640
    target: Target | None = None
    behind: float = 20.0
    height: float = 2.0
    distances: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 30.0)
    azimuths: tuple[float, ...] = ()
    elevations: tuple[float, ...] = ()
    seed: int = 0
    quality: int = 92
    device: str = "cpu"
    streets: str = "town"
    weathers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for town in (*(t for t, _ in self.images), *self.held_out):
            if not is_town(town):
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
        check_streets(self.streets)
        if not self.images or self.mode not in ("drive", "orbit"):
            raise ConfigError("name a town to record, and drive or orbit")
        for town, count in self.images:
            if count < 1:
                raise ConfigError(f"{town}: {count} pictures; ask for one or more")
            if sum(t == town for t, _ in self.images) > 1:
                raise ConfigError(f"{town} is named twice; name each town once")
        if not 3.0 <= self.behind <= 60.0 or not 0.5 <= self.height <= 30.0 or not 1 <= self.quality <= 100:
            raise ConfigError("behind: 3 to 60 m; height: 0.5 to 30 m; quality: 1 to 100")
        sign = isinstance(self.target, TargetSign)
        object.__setattr__(self, "azimuths", self.azimuths or (SIGN_AZIMUTHS if sign else AZIMUTHS))
        walker = isinstance(self.target, TargetWalker)
        object.__setattr__(self, "elevations", self.elevations or ((0.0,) if sign or walker else ELEVATIONS))
        if (sign or walker) and self.mode != "orbit":
            who = "stop sign stands still" if sign else "walker is not followed"
            raise ConfigError(f"a {who}: record it with --clips orbit")
        if not self.distances:
            raise ConfigError("an orbit needs distances")
        if not all(3.0 <= d <= 80.0 for d in self.distances) or not all(0.0 <= e <= 75.0 for e in self.elevations):
            raise ConfigError("distances: 3 to 80 m; elevations: 0 to 75 degrees")
        for weather in self.weathers:
            if weather not in WEATHERS:
                raise unknown_name("weather", weather, WEATHERS)
        if self.weathers and self.mode != "orbit":
            raise ConfigError("weathers are those of an orbit; a drive has its own")
        if not np.isfinite(self.azimuths).all():
            raise ConfigError("azimuths: finite numbers of degrees")
        if sign and (np.cos(np.radians(self.azimuths)) < np.cos(np.radians(BEHIND))).any():
            raise ConfigError(f"azimuths of a sign: less than {BEHIND:g} degrees to either side of its front")
        if sign and self.elevations != (0.0,):
            raise ConfigError("a sign is seen from the heights of cars: give no elevations")
        far = self.behind if self.mode == "drive" else max(self.distances)
        what = "sign" if sign else "walker" if walker else "car"
        if not FOCAL * self.size * TALL[what] / far >= SMALL or self.size > 4096:
            least = int(np.ceil(SMALL * far / FOCAL / TALL[what]))
            raise ConfigError(
                f"pictures of {self.size} pixels: a {what} {far:g} m away needs {least}, and 4096 is the most"
            )

    def identity(self) -> dict[str, Any]:
        """What decides the bytes."""
        found = asdict(replace(self, out=Path())) | {"clips": self.mode, "images": [list(pair) for pair in self.images]}
        skipped = {"out", "mode"} | ({"weathers"} if not self.weathers else set())
        return {k: list(v) if isinstance(v, tuple) else v for k, v in found.items() if k not in skipped}


def pair_images(towns: Sequence[str], images: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Towns with their numbers of pictures; one number stands for all. ConfigError."""
    try:
        counts = [int(text) for text in images]
    except ValueError:
        raise ConfigError(f"--images {','.join(images)}: expected whole numbers with commas between them") from None
    counts = counts * len(towns) if len(counts) == 1 else counts
    if len(counts) != len(towns):
        raise ConfigError(f"--images: {len(counts)} numbers for {len(towns)} towns; give one for each, or one for all")
    return tuple(zip(towns, counts, strict=True))
