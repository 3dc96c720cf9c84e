"""What a suite of the kind `physical` says, and its rows as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from ssad.bench.kind import Names, SuiteBase
from ssad.camera.render import Weather
from ssad.core.errors import ConfigError
from ssad.evaluation.digital_points import named
from ssad.recording.clips import AZIMUTHS, ELEVATIONS
from ssad.recording.lit_clips import at_hour
from ssad.recording.nuscenes_recorder import WEATHERS
from ssad.recording.target import Target, TargetCar, parse_target
from ssad.scenarios.static.physical import CONTROLS, default_carrier, make_carrier, make_physical
from ssad.scenarios.static.physical.noninvasive import Projector, make_light
from ssad.scenarios.static.physical.noninvasive.kept import budget_of
from ssad.scenarios.static.physical.shipped import load_texture

_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True)


class Pair(BaseModel):
    """Where textures are trained and where they are tested: towns, and numbers of pictures."""

    model_config = _STRICT

    train: str
    test: str
    train_images: int = Field(default=600, ge=1)
    test_images: int = Field(default=400, ge=1)


class Grid(BaseModel):
    """Views from all around the target: each combination once in each town of a test.

    Attributes:
        distances: m.
        azimuths: degrees from the front to the left of the target.
        elevations: degrees.
        weathers: kinds (`ssad.recording.nuscenes_recorder.WEATHERS`).
        towns: Of the tests that are seen from all around; None: all.
    """

    model_config = _STRICT

    distances: list[float] = Field(default=[5.0, 10.0, 15.0, 20.0, 30.0], min_length=1)
    azimuths: list[float] = Field(default=list(AZIMUTHS), min_length=1)
    elevations: list[float] = Field(default=list(ELEVATIONS), min_length=1)
    weathers: list[str] = Field(default=list(WEATHERS), min_length=1)
    towns: list[str] | None = None

    @property
    def count(self) -> int:
        """Number of views."""
        return len(self.distances) * len(self.azimuths) * len(self.elevations) * len(self.weathers)


class Entry(BaseModel):
    """A row of the table.

    Attributes:
        name: an attack (`ssad.scenarios.static.physical`), or a control: random, noise, grey, shuffled.
        carrier: patch, camouflage or road, with its settings as `options`; default: the attack's own.
        options: of the carrier.
        settings: fields of `TextureAttack` that differ.
        around: pictures from all around the target, in the town of the training, that the texture is trained on beside
            those from behind.
        of: of the control shuffled: the attack whose texture is shuffled (the one with the same `around`).
        texture: a shipped texture, or the card of one (NAME.json): it is shown in place of training; carrier, options
            and the detector that it was trained against are those of the card.
    """

    model_config = _STRICT

    name: str = Field(min_length=1)
    carrier: Literal["patch", "camouflage", "road"] | None = None
    options: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    around: int = Field(default=0, ge=0)
    of: str | None = None
    texture: str | None = None


class LightEntry(BaseModel):
    """Rows of the table for one light: searched, and with settings drawn at random.

    Attributes:
        name: an attack (`ssad.scenarios.static.physical.noninvasive`).
        hour: noon, low_sun, night, or recorded: as the pictures were.
        options: fields of the attack that differ.
        settings: of its search (`Budget`); of a projector, of `TextureAttack`.
    """

    model_config = _STRICT

    name: str = Field(min_length=1)
    hour: str = "night"
    options: dict[str, Any] = {}
    settings: dict[str, Any] = {}


class PhysicalSuite(SuiteBase):
    """One table: 2D detectors x textures on a car, each trained on drives in one town and tested in another.

    Attributes:
        detectors: 2D detectors with a class `car`.
        target: a car, stop_sign or pedestrian, as for `ssad record --target`; what is no car is seen from all around.
        pairs: towns.
        attacks: names, or mappings with the keys of `Entry`.
        lights: names of light attacks, or mappings with the keys of `LightEntry`.
        epochs: of all trained textures, in place of their own; None: their own.
        window: side of the part around the target that trainings show to a detector, px, a multiple of 32; None: whole
            pictures. A window of 192 takes a sixth of the time.
        seeds: of each control that is drawn at random.
        transfer: whether a texture is shown to the other detectors too.
        judges: further detectors, 2D or 3D, that no texture is trained against and that all are shown to; of 3D
            detectors the hulls of their boxes in the picture count.
        grid: views from all around, beside those from behind; None: none.
        behind: m from the camera to a car that drives.
        distances: m from the camera to a target that is no car.
        size: of the pictures, px a side.
        floor: least AP50 of the clean pictures, below which no attack is reported.
        replicates: of the bootstrap over drives.
    """

    kind: Literal["physical"]
    detectors: Names = Field(default=["yolov5n", "yolov3-tiny"], min_length=1)
    target: str = "sedan:silver:0"
    pairs: list[Pair] = Field(default=[Pair(train="Twinford", test="Oldmarket")], min_length=1)
    attacks: list[Entry] = Field(default=[])
    lights: list[LightEntry] = Field(default=[])
    epochs: int | None = Field(default=None, ge=1)
    window: int | None = None
    seeds: int = Field(default=3, ge=1)
    transfer: bool = False
    judges: list[str] = Field(default=[])
    grid: Grid | None = None
    behind: float = Field(default=20.0, ge=3.0, le=60.0)
    distances: list[float] = Field(default=[5.0, 10.0, 15.0, 20.0], min_length=1)
    size: int = Field(default=640, ge=64)
    floor: float = Field(default=0.9, ge=0.0, le=1.0)
    replicates: int = Field(default=100, ge=0, le=10_000)

    @property
    def place(self) -> float | list[float]:
        """Where the camera is: m behind a car, or the distances of what is no car."""
        return self.behind if isinstance(parse_target(self.target), TargetCar) else self.distances

    @field_validator("attacks", "lights", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone is an attack with nothing else said."""
        return named(value)

    @model_validator(mode="after")
    def _some(self) -> Self:
        """There must be something to test."""
        if not self.attacks and not self.lights:
            raise ValueError("name attacks, lights or both")
        return self


def row_of(suite: PhysicalSuite, entry: Entry) -> dict[str, Any]:
    """A row as plain data: attack, carrier, options, settings, of.

    Raises:
        UnknownNameError, ConfigError: No such attack, or settings that it does not have.
    """
    carrier = entry.carrier or default_carrier(entry.of or entry.name)
    found: dict[str, Any] = {"attack": entry.name, "carrier": carrier, "options": dict(entry.options), "settings": {}}
    found |= {"of": None, "around": entry.around}
    if entry.texture is not None:
        return found | _ready(suite, entry)
    if entry.name not in CONTROLS:
        settings = {"epochs": suite.epochs, "window": suite.window}
        settings = {key: value for key, value in settings.items() if value is not None} | entry.settings
        make_physical(entry.name, **settings)
        return found | {"settings": settings}
    if entry.settings or (entry.around and entry.of is None):
        raise ConfigError(f"suite {suite.name}: {entry.name} is not trained and has no settings")
    if (entry.name == "shuffled") != (entry.of is not None):
        raise ConfigError(f"suite {suite.name}: shuffled, and it alone, says of which attack (of: NAME)")
    if entry.of is None:
        return found
    sources = [
        one for one in suite.attacks
        if (one.name, one.around) == (entry.of, entry.around) and one.name not in CONTROLS
    ]  # fmt: skip
    if len(sources) != 1:
        raise ConfigError(f"suite {suite.name}: shuffled of '{entry.of}': there must be one such attack")
    return {**row_of(suite, sources[0]), "attack": "shuffled", "of": entry.of}


def check_lights(suite: PhysicalSuite) -> None:
    """ConfigError, UnknownNameError: an attack, an hour or a setting that does not exist."""
    for entry in suite.lights:
        attack = make_light(entry.name, entry.options)
        at_hour(Weather(), entry.hour)
        try:
            if isinstance(attack, Projector):
                attack.training(**entry.settings)
            else:
                budget_of(entry.settings)
        except (TypeError, ConfigError) as error:
            raise ConfigError(f"suite {suite.name}: {entry.name}: {error}") from None


def carrier_title(row: Mapping[str, Any]) -> str:
    """The carrier of a row and its options, in words: such as "patch, height 0.86, width 1.9"; "" for no texture."""
    options = sorted((row.get("options") or {}).items())
    return ", ".join([row.get("carrier", ""), *(f"{key} {value}" for key, value in options)])


def _ready(suite: PhysicalSuite, entry: Entry) -> dict[str, Any]:
    """What the card of a texture says of a row. ConfigError: the suite says otherwise."""
    assert entry.texture is not None
    colour, card = load_texture(entry.texture)
    if entry.carrier or entry.options or entry.settings or entry.of or entry.around:
        raise ConfigError(f"suite {suite.name}: texture {entry.texture}: its card says carrier, options and settings")
    if (card.attack, card.target) != (entry.name, suite.target):
        raise ConfigError(
            f"suite {suite.name}: texture {entry.texture} is of {card.attack} on {card.target}, not of {entry.name} on "
            f"{suite.target}"
        )
    size = make_carrier(card.carrier, card.options).on(target_of(suite).mesh()).size
    if tuple(colour.shape[1:]) != size:
        raise ConfigError(f"texture {entry.texture}: {list(colour.shape[1:])} texels, its surface has {list(size)}")
    about = {"carrier": card.carrier, "options": dict(card.options), "source": card.source}
    return about | {"file": entry.texture, "hash": card.hash}


def target_of(suite: PhysicalSuite) -> Target:
    """The target of a suite. ConfigError: what it asks for is only there for cars."""
    target = parse_target(suite.target)
    if not isinstance(target, TargetCar) and (suite.lights or any(entry.around for entry in suite.attacks)):
        raise ConfigError(f"suite {suite.name}: target {suite.target}: lights and around are for cars")
    return target
