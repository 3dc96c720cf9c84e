"""Settings of `ssad record --clips`: towns, target, camera, and the checks of their values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.wording import counted
from ssad.recorders.drives import check_streets
from ssad.recorders.nuscenes import HELD_OUT, WEATHERS
from ssad.recorders.parts import PartsFolder
from ssad.recorders.randomisation import NO_RANDOMISATION, Randomisation
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, check_effects
from ssad.rendering.camera.render import RenderQuality
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
MAX_DISTANCE: Final = 80.0  # m


@dataclass(frozen=True, slots=True)
class TargetRecording:
    """Settings of a recording of target images.

    Attributes:
        out: Folder of the recording.
        images: Town and number of its images.
        held_out: Towns of the test split.
        mode: "drive" follows the driving target; "orbit" shows it from all around.
        size: Side of the square images, px.
        target: Car, stop sign or walker to show; None: another car in each part.
        behind, height: Place of the following camera, m.
        distances, azimuths, elevations: Grid of an orbit, m and degrees. Empty azimuths or elevations take the
            defaults of the target. A sign has one elevation, 0, which stands for the heights of cameras of cars.
        seed: Root of the random numbers.
        quality: Quality of JPEG files.
        device: Device that renders.
        streets: See `drive_street`.
        weathers: Further axis of the grid of an orbit; empty: drawn as for drives.
        randomisation: What is drawn for each image and for each vehicle of a drive.
        approach: Distances of the following camera in place of `behind`, m of way, in turn; empty: `behind` alone.
        effects: Effects of the rendering, see `ssad.rendering.camera.effects`.

    Raises:
        ConfigError: A value is out of range, or the values do not fit together.
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
    randomisation: Randomisation = NO_RANDOMISATION
    approach: tuple[float, ...] = ()
    effects: frozenset[str] = DEFAULT_EFFECTS

    def __post_init__(self) -> None:
        check_effects(self.effects)
        for town in (*(name for name, _ in self.images), *self.held_out):
            if not is_town(town):
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
        check_streets(self.streets)
        if not self.images or self.mode not in ("drive", "orbit"):
            raise ConfigError("name a town to record, and drive or orbit")
        for town, count in self.images:
            if count < 1:
                raise ConfigError(f"{town}: {counted(count, 'picture')}; ask for one or more")
            if sum(name == town for name, _ in self.images) > 1:
                raise ConfigError(f"{town} is named twice; name each town once")
        if not 3.0 <= self.behind <= 60.0 or not 0.5 <= self.height <= 30.0 or not 1 <= self.quality <= 100:
            raise ConfigError("behind: 3 to 60 m; height: 0.5 to 30 m; quality: 1 to 100")
        is_sign = isinstance(self.target, TargetSign)
        # The dataclass is frozen, so defaults that depend on the target are set past it.
        object.__setattr__(self, "azimuths", self.azimuths or (SIGN_AZIMUTHS if is_sign else AZIMUTHS))
        is_walker = isinstance(self.target, TargetWalker)
        object.__setattr__(self, "elevations", self.elevations or ((0.0,) if is_sign or is_walker else ELEVATIONS))
        if (is_sign or is_walker) and self.mode != "orbit":
            complaint = "stop sign stands still" if is_sign else "walker is not followed"
            raise ConfigError(f"a {complaint}: record it with --clips orbit")
        if not self.distances:
            raise ConfigError("an orbit needs distances")
        if not all(3.0 <= distance <= MAX_DISTANCE for distance in self.distances) or not all(
            0.0 <= elevation <= 75.0 for elevation in self.elevations
        ):
            raise ConfigError(f"distances: 3 to {MAX_DISTANCE:g} m; elevations: 0 to 75 degrees")
        for weather in self.weathers:
            if weather not in WEATHERS:
                raise unknown_name("weather", weather, WEATHERS)
        if self.weathers and self.mode != "orbit":
            raise ConfigError("weathers are those of an orbit; a drive has its own")
        if not np.isfinite(self.azimuths).all():
            raise ConfigError("azimuths: finite numbers of degrees")
        if is_sign and (np.cos(np.radians(self.azimuths)) < np.cos(np.radians(BEHIND))).any():
            raise ConfigError(f"azimuths of a sign: less than {BEHIND:g} degrees to either side of its front")
        if is_sign and self.elevations != (0.0,):
            raise ConfigError("a sign is seen from the heights of cars: give no elevations")
        if self.approach and self.mode != "drive":
            raise ConfigError("approach: it needs a camera that follows the target; give distances for an orbit")
        if not all(3.0 <= distance <= MAX_DISTANCE for distance in self.approach):
            values = ", ".join(f"{distance:g}" for distance in self.approach)
            raise ConfigError(f"approach: {values} m; give distances from 3 to {MAX_DISTANCE:g} m")
        max_distance = max(self.approach or (self.behind,)) if self.mode == "drive" else max(self.distances)
        target_kind = "sign" if is_sign else "walker" if is_walker else "car"
        # The smallest side of the farthest target must still span MIN_BOX_SIDE pixels.
        if not FOCAL * self.size * TALL[target_kind] / max_distance >= SMALL or self.size > 4096:
            min_size = int(np.ceil(SMALL * max_distance / FOCAL / TALL[target_kind]))
            raise ConfigError(
                f"pictures of {self.size} pixels: a {target_kind} {max_distance:g} m away needs "
                f"{min_size}, and 4096 is the most"
            )

    @property
    def parts(self) -> PartsFolder:
        """The parts of the recording."""
        return PartsFolder(self.out, self.identity())

    @property
    def render_quality(self) -> RenderQuality:
        """Quality of the rendering: everything, with the effects of the recording."""
        return RenderQuality(effects=self.effects)

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the bytes of the recording, as plain data."""
        settings = asdict(replace(self, out=Path())) | {
            "clips": self.mode,
            "images": [list(pair) for pair in self.images],
            "randomisation": self.randomisation.identity(),
            "effects": sorted(self.effects),
        }
        # Empty values are left out, so that recordings without them keep their identity.
        optional = ("weathers", "randomisation", "approach")
        excluded = {"out", "mode"} | {name for name in optional if not settings[name]}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in settings.items()
            if name not in excluded
        }


def height_in_pixels(metres: float, distance: float, size: int) -> float:
    """Return the height of an upright object in the image of a level pinhole camera, px.

    Args:
        metres: Its height, m.
        distance: Distance from the camera, m.
        size: Side of the image, px, of which the focal length is `FOCAL` times.
    """
    return FOCAL * size * metres / distance


def pair_images(towns: Sequence[str], images: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Pair towns with their numbers of images; a single number applies to all towns.

    Raises:
        ConfigError: The numbers are not whole, or do not match the towns.
    """
    try:
        counts = [int(text) for text in images]
    except ValueError:
        raise ConfigError(f"--images {','.join(images)}: expected whole numbers with commas between them") from None
    counts = counts * len(towns) if len(counts) == 1 else counts
    if len(counts) != len(towns):
        raise ConfigError(f"--images: {len(counts)} numbers for {len(towns)} towns; give one for each, or one for all")
    return tuple(zip(towns, counts, strict=True))
