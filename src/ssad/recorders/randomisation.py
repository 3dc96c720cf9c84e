"""Randomisation of recordings: paint and dirt of vehicles, cameras, their colours, noise and compression.

Training on varied images helps detectors on cameras and cars that they were not trained on (Tobin et al. 2017, "Domain
randomization for transferring deep neural networks from simulation to the real world"). Each dimension has a name, can
be switched off, and is drawn from the seed of the recording alone. The dataset contains the drawn values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.frames import Camera
from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.rendering.bodies import PAINTS
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.camera.scene import Finish
from ssad.rendering.camera.sensor import SensorModel

if TYPE_CHECKING:
    from ssad.rendering.scene_objects import ObjectBody


@dataclass(frozen=True, slots=True)
class Dimension:
    """Dimension of the randomisation.

    Attributes:
        name: Name on the command line, in files and in datasets.
        summary: Phrase that says what is drawn.
        low: Least value by default.
        high: Largest value by default.
        bounds: Least and largest value that a range may have.
        scale: Distribution over the range: uniform, or uniform in the logarithm.
        subject: Subject of each draw: a vehicle, or a camera in a scene (with `--clips`: an image).
    """

    name: str
    summary: str
    low: float
    high: float
    bounds: tuple[float, float]
    scale: Literal["uniform", "log"] = "uniform"
    subject: Literal["vehicle", "camera"] = "camera"

    def describe(self) -> str:
        """Return subject, summary and default range in words."""
        scale = ", logarithmic" if self.scale == "log" else ""
        values = f"{self.low:g}" if self.low == self.high else f"{self.low:g} to {self.high:g}"
        return f"{self.subject}: {self.summary}; {values}{scale}"


# Axalta, 68th Global Automotive Color Popularity Report (2020), per cent of new cars; 4 % of other colours.
COLOUR_SHARES: Final[Mapping[str, float]] = {
    "white": 38,
    "black": 19,
    "grey": 15,
    "silver": 9,
    "blue": 7,
    "red": 5,
    "brown": 3,
    "other": 4,
}
COLOUR_PAINTS: Final[Mapping[str, tuple[str, ...]]] = {
    "white": ("white", "white", "pearl"),
    "black": ("black",),
    "grey": ("grey", "graphite"),
    "silver": ("silver",),
    "blue": ("blue", "navy", "sky"),
    "red": ("red", "red", "maroon"),
    "brown": ("brown", "beige"),
    "other": ("green", "olive", "orange", "yellow", "teal"),
}
DIMENSIONS: Final[Mapping[str, Dimension]] = {
    dimension.name: dimension
    for dimension in (
        Dimension(
            "paint",
            "colour of cars by published shares, with this deviation of the logarithm of its brightness",
            0.15,
            0.15,
            (0.0, 1.0),
            subject="vehicle",
        ),
        Dimension("metallic", "strength of effect pigments in the paint", 0.0, 0.8, (0.0, 1.0), subject="vehicle"),
        Dimension("dirt", "dirt and dust on vehicles", 0.0, 0.7, (0.0, 1.0), subject="vehicle"),
        Dimension("wear", "chalking, scratches and rust", 0.0, 0.5, (0.0, 1.0), subject="vehicle"),
        Dimension("focal", "factor of the focal length", 0.8, 1.3, (0.2, 5.0), "log"),
        Dimension("height", "offset of the camera's height, m", -0.25, 0.5, (-1.0, 3.0)),
        Dimension("pitch", "pitch of the camera, degrees, upwards", -2.0, 2.0, (-20.0, 20.0)),
        Dimension("exposure", "error of the exposure, stops", -0.8, 0.8, (-4.0, 4.0)),
        Dimension("white-balance", "error of the white balance, mired, to the warm side", -35.0, 35.0, (-150.0, 150.0)),
        Dimension("tint", "error of the white balance in green, share", -0.04, 0.04, (-0.3, 0.3)),
        Dimension("saturation", "saturation", 0.7, 1.2, (0.0, 2.0)),
        Dimension("gamma", "exponent of the code", 0.85, 1.15, (0.2, 5.0), "log"),
        Dimension("contrast", "strength of an S-curve on the code", -0.15, 0.5, (-0.5, 0.9)),
        Dimension("noise", "deviation at full light by day", 0.004, 0.03, (0.0001, 0.5), "log"),
        Dimension("blur", "standard deviation of the point spread, px", 0.35, 0.7, (0.0, 0.7)),
        Dimension("glare", "scattered light, times that of the eye", 0.03, 0.8, (0.001, 3.0), "log"),
        Dimension("flare", "strength of ghosts", 0.2, 8.0, (0.001, 100.0), "log"),
        Dimension("compression", "quality of JPEG", 60.0, 96.0, (5.0, 100.0)),
    )
}
PAINT_KIND: Final = "car"  # kind of body whose paint is drawn by the shares
VEHICLES: Final = ("car", "truck", "bus", "trailer", "construction", "motorcycle")
WAVELENGTHS: Final = (600.0, 540.0, 450.0)  # nm, of red, green and blue
RADIATION: Final = 1.4388e7  # nm K, second radiation constant


@dataclass(frozen=True, slots=True)
class CameraDraw:
    """Drawn values of a camera, by the name of their dimension; dimensions that are off are missing."""

    values: Mapping[str, float]

    def camera(self, camera: Camera) -> Camera:
        """Return a camera at another height and pitch, with another focal length.

        Args:
            camera: The camera; `to_ego` is its place on the vehicle, z up.
        """
        intrinsic = camera.intrinsic.copy()
        intrinsic[0, 0] *= self.values.get("focal", 1.0)
        intrinsic[1, 1] *= self.values.get("focal", 1.0)
        return replace(camera, intrinsic=intrinsic, to_ego=self.pose(camera.to_ego))

    def pose(self, pose: F64, *, raised: bool = True) -> F64:
        """Return the pose [4, 4] of a camera (x right, y down, z forward) at another height and pitch.

        Args:
            pose: The pose; z of its frame points up.
            raised: Whether the height changes.
        """
        angle = math.radians(self.values.get("pitch", 0.0))
        cosine, sine = math.cos(angle), math.sin(angle)
        rotated = pose.copy()
        if angle:
            rotated[:3, :3] = pose[:3, :3] @ np.array([[1.0, 0, 0], [0, cosine, sine], [0, -sine, cosine]]).T
        if raised:
            rotated[2, 3] += self.values.get("height", 0.0)
        return rotated

    def weather(self, weather: SceneWeather) -> SceneWeather:
        """Return the weather with the error of the exposure."""
        return replace(weather, exposure=weather.exposure + self.values.get("exposure", 0.0))

    def sensor(self, sensor: SensorModel, camera: Camera) -> SensorModel:
        """Return the sensor with the drawn colours, noise and lens.

        Args:
            sensor: The sensor.
            camera: Camera whose focal length scales the glare.
        """
        balance = white_balance(self.values.get("white-balance", 0.0), self.values.get("tint", 0.0))
        changes: dict[str, Any] = {
            name: self.values[name]
            for name in ("saturation", "gamma", "contrast", "noise", "blur", "glare", "flare")
            if name in self.values
        }
        if balance != (1.0, 1.0, 1.0):
            changes["balance"] = balance
        if "glare" in changes or "flare" in changes:
            changes["focal"] = float(camera.intrinsic[0, 0]) / camera.width
        return replace(sensor, **changes)

    def quality(self, quality: int) -> int:
        """Return the quality of JPEG files."""
        return round(self.values.get("compression", quality))


def white_balance(mired: float, tint: float) -> tuple[float, float, float]:
    """Return the factors of red, green and blue of a camera that is balanced for another light.

    By Wien's law, the light of a black body at a wavelength changes with the reciprocal of its temperature as
    exp(-c / wavelength * change); green keeps its light but for the tint.

    Args:
        mired: Change of 1e6 / temperature; above 0 the image is warmer.
        tint: Additional share of green.
    """
    red, green, blue = (
        math.exp(RADIATION * (1.0 / WAVELENGTHS[1] - 1.0 / wavelength) * mired * 1e-6) for wavelength in WAVELENGTHS
    )
    return red, green * (1.0 + tint), blue


@dataclass(frozen=True, slots=True)
class Randomisation:
    """Dimensions that are drawn, with their ranges.

    Attributes:
        ranges: Name, least and largest value of each dimension that is on.

    Raises:
        UnknownNameError: There is no such dimension.
        ConfigError: A range is reversed, or goes beyond the bounds of its dimension.
    """

    ranges: tuple[tuple[str, float, float], ...] = ()

    def __post_init__(self) -> None:
        for name, low, high in self.ranges:
            if name not in DIMENSIONS:
                raise unknown_name("dimension", name, DIMENSIONS)
            lower_bound, upper_bound = DIMENSIONS[name].bounds
            if not lower_bound <= low <= high <= upper_bound:
                raise ConfigError(
                    f"randomisation: {name} from {low:g} to {high:g}; give a range within {lower_bound:g} to "
                    f"{upper_bound:g}"
                )

    def __bool__(self) -> bool:
        return bool(self.ranges)

    def identity(self) -> dict[str, list[float]]:
        """Return the ranges by the names of their dimensions, as plain data."""
        return {name: [low, high] for name, low, high in self.ranges}

    @staticmethod
    def of(ranges: Mapping[str, Sequence[float]]) -> Randomisation:
        """Return the randomisation that `identity` describes."""
        return Randomisation(tuple((name, float(low), float(high)) for name, (low, high) in ranges.items()))

    def draw_camera(self, key: tuple[object, ...]) -> CameraDraw:
        """Draw the values of a camera.

        Args:
            key: Key of the draws.
        """
        return CameraDraw(self._draw("camera", key))

    def randomise_bodies(self, bodies: Sequence[ObjectBody], key: tuple[object, ...]) -> list[ObjectBody]:
        """Return the bodies of a drive, vehicles with drawn paint and finish.

        Args:
            bodies: Bodies; each draws by its tag.
            key: Key of the draws.
        """
        return [self.randomise_body(body, (*key, body.tag)) for body in bodies]

    def randomise_body(self, body: ObjectBody, key: tuple[object, ...], *, has_paint: bool = True) -> ObjectBody:
        """Return a body with drawn paint and finish; a body that is no vehicle is returned as it is.

        Args:
            body: The body.
            key: Key of the draws.
            has_paint: Whether its paint is drawn.
        """
        if body.kind not in VEHICLES:
            return body
        values = self._draw("vehicle", key)
        if "paint" in values and body.kind == PAINT_KIND and has_paint:
            body = replace(body, paint=_draw_colour(values["paint"], key))
        amounts = {name: values[name] for name in ("metallic", "dirt", "wear") if name in values}
        if not amounts:
            return body
        seed = int(generator("randomise pattern", *key).integers(4096))
        return replace(body, finish=Finish(**amounts, seed=seed))

    def _draw(self, subject: str, key: tuple[object, ...]) -> dict[str, float]:
        values = {}
        for name, low, high in self.ranges:
            dimension = DIMENSIONS[name]
            if dimension.subject == subject:
                # A generator for each dimension: switching one off changes no other.
                share = float(generator("randomise", name, *key).uniform())
                if dimension.scale == "log":
                    values[name] = low * (high / low) ** share
                else:
                    values[name] = low + (high - low) * share
        return values


NO_RANDOMISATION: Final = Randomisation()
FULL_RANDOMISATION: Final = Randomisation(
    tuple((dimension.name, dimension.low, dimension.high) for dimension in DIMENSIONS.values())
)


def describe_bodies(bodies: Sequence[ObjectBody]) -> dict[str, dict[str, Any]]:
    """Return paint and finish of vehicles by their tag, as plain data."""
    return {str(body.tag): describe_body(body) for body in bodies if body.kind in VEHICLES}


def describe_body(body: ObjectBody) -> dict[str, Any]:
    """Return paint (linear RGB) and finish of a body, as plain data."""
    finish = {} if body.finish is None else asdict(body.finish)
    return {"paint": [round(value, 5) for value in body.paint]} | finish


def _draw_colour(deviation: float, key: tuple[object, ...]) -> tuple[float, float, float]:
    """Draw a paint (linear RGB) by `COLOUR_SHARES`."""
    rng = generator("randomise colour", *key)
    shares = np.array(list(COLOUR_SHARES.values()), float)
    paints = COLOUR_PAINTS[str(rng.choice(list(COLOUR_SHARES), p=shares / shares.sum()))]
    paint = np.array(PAINTS[paints[int(rng.integers(len(paints)))]])
    red, green, blue = np.minimum(
        paint * np.exp(deviation * rng.normal(size=1) + 0.3 * deviation * rng.normal(size=3)), 0.88
    )
    return float(red), float(green), float(blue)


def parse_randomisation(text: str) -> Randomisation:
    """Return the randomisation of `ssad record --randomise`.

    Args:
        text: `none`; `all`; names of dimensions with commas between them, a minus in front of those that are off
            (`all,-focal`); or a YAML file (`.yaml`, `.yml`) that maps names to true, false or [least, largest].

    Raises:
        UnknownNameError: There is no such dimension.
        ConfigError: The file cannot be read, or a range is wrong.
    """
    if Path(text).suffix in (".yaml", ".yml"):
        return _read_randomisation(Path(text))
    ranges: dict[str, tuple[float, float]] = {}
    for word in (part.strip() for part in text.split(",")):
        name = word.removeprefix("-")
        if name == "none":
            continue
        names = list(DIMENSIONS) if name == "all" else [name]
        for dimension_name in names:
            if dimension_name not in DIMENSIONS:
                raise unknown_name("dimension", dimension_name, DIMENSIONS)
            if word.startswith("-"):
                ranges.pop(dimension_name, None)
            else:
                ranges[dimension_name] = DIMENSIONS[dimension_name].low, DIMENSIONS[dimension_name].high
    # The order of the names does not matter.
    return Randomisation(tuple((name, *ranges[name]) for name in DIMENSIONS if name in ranges))


def _read_randomisation(path: Path) -> Randomisation:
    """Read a randomisation from a YAML file."""
    settings = safeio.parse_yaml(safeio.read_text(path), str(path))
    if not isinstance(settings, dict):
        raise ConfigError(f"{path}: expected names of dimensions, each with true, false or [least, largest]")
    ranges: dict[str, tuple[float, float]] = {}
    for name, setting in settings.items():
        if name not in DIMENSIONS:
            raise unknown_name("dimension", str(name), DIMENSIONS)
        if setting is True:
            ranges[name] = DIMENSIONS[name].low, DIMENSIONS[name].high
        elif (
            isinstance(setting, list) and len(setting) == 2 and all(isinstance(value, int | float) for value in setting)
        ):
            ranges[name] = float(setting[0]), float(setting[1])
        elif setting is not False:
            raise ConfigError(f"{path}: {name}: expected true, false or [least, largest], not {setting!r}")
    return Randomisation(tuple((name, *ranges[name]) for name in DIMENSIONS if name in ranges))
