"""A table of physical attacks of a suite: its recordings, and its rows as plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from ssad.core.errors import ConfigError
from ssad.core.schema import Names, Schema
from ssad.experiments.perception.digital.points import named
from ssad.experiments.perception.open_loop import CellDescription
from ssad.recorders.nuscenes import WEATHERS
from ssad.recorders.target_recording import AZIMUTHS, ELEVATIONS, TargetRecording
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.hours import at_hour
from ssad.rendering.target import Target, TargetCar, parse_target
from ssad.scenarios.static.physical import CONTROLS, default_carrier, make_carrier, make_physical
from ssad.scenarios.static.physical.lights import Projector, make_light
from ssad.scenarios.static.physical.lights.folder import budget_of
from ssad.scenarios.static.physical.textures.card import load_texture

CLEAN, RANDOM = "clean", "random"
DRIVE, APPROACH, GRID = "drive", "approach", "grid"
VIEWS = (DRIVE, APPROACH, GRID)


class Pair(Schema):
    """Two towns, for the training and the test of textures, and their numbers of images.

    Attributes:
        train: Town of the training.
        test: Town of the test, another.
        train_images: Number of images of the training.
        test_images: Number of images of the test.
    """

    train: str
    test: str
    train_images: int = Field(default=600, ge=1)
    test_images: int = Field(default=400, ge=1)

    @model_validator(mode="after")
    def _held_out(self) -> Self:
        """Reject a test in the town of the training: it would say nothing about other images."""
        if self.train == self.test:
            raise ValueError(f"trained and tested in {self.train}: name another town for the test")
        return self


class Grid(Schema):
    """Views from all around the target: each combination once in each town of a test.

    Attributes:
        distances: distances from the camera to the target, m.
        azimuths: angles of the camera, degrees from the front to the left of the target.
        elevations: angles of the camera above the target, degrees.
        weathers: kinds of weather (`ssad.recorders.nuscenes.WEATHERS`).
        towns: towns of the tests with a grid; None: all.
    """

    distances: list[float] = Field(default=[5.0, 10.0, 15.0, 20.0, 30.0], min_length=1)
    azimuths: list[float] = Field(default=list(AZIMUTHS), min_length=1)
    elevations: list[float] = Field(default=list(ELEVATIONS), min_length=1)
    weathers: list[str] = Field(default=list(WEATHERS), min_length=1)
    towns: list[str] | None = None

    @property
    def count(self) -> int:
        """Number of views."""
        return len(self.distances) * len(self.azimuths) * len(self.elevations) * len(self.weathers)


class ApproachViews(Schema):
    """Views on the way to the target, from far to near: in each town of a test, and of a training.

    The camera has the focal length of all recordings, 1.1 times the side of the image. A car 1.43 m high is 80 m away
    25 px high in images of 1280 px.

    Attributes:
        distances: distances to the target, m: of a car of way behind it, of another target in the air.
        images: number of images in each town of a test; 25 are of one drive.
        size: side of the images, px, also of those that textures are trained on.
        train: whether textures are trained on views at these distances, in place of those of the test.
    """

    distances: list[float] = Field(default=[5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0, 80.0], min_length=2)
    images: int = Field(default=500, ge=1)
    size: int = Field(default=1280, ge=64)
    train: bool = True


class Entry(Schema):
    """Row of the table.

    Attributes:
        name: an attack (`ssad.scenarios.static.physical`), or a control: random, noise, grey, shuffled.
        carrier: what the texture covers, with settings in `options`; default: the attack's own.
        options: settings of the carrier.
        settings: fields of `TextureAttack` that differ; titles name those in which two rows of one attack differ.
        around: number of images from all around the target, in the town of the training, that the texture is
            trained on beside those from behind.
        of: for the control shuffled: the attack whose texture is shuffled. Among several rows of this attack it is
            the one with the same `around` and with all values of carrier, options, settings and texture that are
            set here; among several such rows, the one that sets nothing beyond the others.
        texture: a shipped texture, or the card of one (NAME.json), that is shown instead of training one; carrier,
            options and the detector of its training are those of the card.
        project: for a texture: whether its colours are first moved to the nearest that inks can give.
    """

    name: str = Field(min_length=1)
    carrier: Literal["patch", "camouflage", "road"] | None = None
    options: dict[str, Any] = Field(default={})
    settings: dict[str, Any] = Field(default={})
    around: int = Field(default=0, ge=0)
    of: str | None = None
    texture: str | None = None
    project: bool = False


class TargetLightEntry(Schema):
    """Rows of the table for one light: searched, and with settings drawn at random.

    Attributes:
        name: an attack (`ssad.scenarios.static.physical.lights`).
        hour: hour of the day: noon, low_sun, night, or recorded for that of each image.
        options: fields of the attack that differ.
        settings: settings of its search (`Budget`); for a projector, of `TextureAttack`.
    """

    name: str = Field(min_length=1)
    hour: str = "night"
    options: dict[str, Any] = Field(default={})
    settings: dict[str, Any] = Field(default={})


class TargetTable(Schema):
    """Textures on a target and lights on it, trained on drives in one town and tested in another.

    Attributes:
        name: of the table.
        seed: root of all random numbers.
        detectors: detectors with a class `car`, 2D or, for textures, 3D; of 3D detectors the hulls of their boxes
            in the image count.
        judges: further detectors, 2D or 3D, that no texture is trained against and that all are shown to.
        transfer: whether a texture is shown to the other detectors too.
        target: a car, stop_sign or pedestrian, as for `ssad record --target`; the latter two are seen from all
            around.
        pairs: pairs of towns.
        attacks: names, or mappings with the keys of a texture entry.
        lights: names of light attacks, or mappings with the keys of `TargetLightEntry`.
        epochs: epochs of all trained textures, in place of their own; None: their own.
        window: side of the part around the target that trainings show to a 2D detector, px, a multiple of 32; None:
            whole images, as for 3D detectors always. A window of 192 takes a sixth of the time.
        seeds: draws of each control that is random.
        inks: whether textures are trained in tones of inks, and controls have colours that inks can give; False: any
            colour, which no printer may give.
        grid: views from all around, beside those from behind; None: none.
        approach: views on the way to the target, beside those from behind; None: none.
        behind: distance from the camera to a driving car, m.
        distances: distances from the camera to any other target, m.
        size: side of the images, px.
    """

    name: str
    seed: int
    detectors: Names = Field(default=["yolov5n", "yolov3-tiny"], min_length=1)
    judges: list[str] = Field(default=[])
    transfer: bool = False
    target: str = "sedan:silver:0"
    pairs: list[Pair] = Field(default=[Pair(train="Twinford", test="Oldmarket")], min_length=1)
    attacks: list[Entry] = Field(default=[])
    lights: list[TargetLightEntry] = Field(default=[])
    epochs: int | None = Field(default=None, ge=1)
    window: int | None = None
    seeds: int = Field(default=3, ge=1)
    inks: bool = True
    grid: Grid | None = None
    approach: ApproachViews | None = None
    behind: float = Field(default=20.0, ge=3.0, le=60.0)
    distances: list[float] = Field(default=[5.0, 10.0, 15.0, 20.0], min_length=1)
    size: int = Field(default=640, ge=64)

    @field_validator("attacks", "lights", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """Turn a bare name into an entry with default settings."""
        return named(value)

    @model_validator(mode="after")
    def _some(self) -> Self:
        """Reject a table without attacks and lights."""
        if not self.attacks and not self.lights:
            raise ValueError("name attacks, lights or both")
        return self

    @property
    def place(self) -> float | list[float]:
        """Place of the camera: m behind a car, or the distances of other targets."""
        return self.behind if isinstance(parse_target(self.target), TargetCar) else self.distances

    def seen_around(self, pair: Pair) -> bool:
        """Return True if the test of a pair includes the grid."""
        return self.grid is not None and (self.grid.towns is None or pair.test in self.grid.towns)

    @property
    def training_size(self) -> int:
        """Side of the images that textures are trained on, px."""
        return self.approach.size if self.approach is not None and self.approach.train else self.size

    def recordings(self, folder: Path, device: str) -> list[TargetRecording]:
        """Return the recordings below a folder: drives of each town, approaches, the grid, and views from all around.

        Raises:
            ConfigError: A value that cannot be.
            UnknownNameError: A town, or a weather.
        """
        images: dict[str, int] = {}
        approach_images: dict[str, int] = {}
        trains_on_approach = self.approach is not None and self.approach.train
        for pair in self.pairs:
            for town, count in ((pair.train, pair.train_images), (pair.test, pair.test_images)):
                # A town may train one pair and test another; one recording serves both. Lights are searched from
                # behind, whatever textures are trained on.
                is_needed = town == pair.test or self.lights or not trains_on_approach
                images |= {town: max(images.get(town, 0), count)} if is_needed else {}
            if self.approach is not None:
                counts = {pair.test: self.approach.images} | (
                    {pair.train: pair.train_images} if self.approach.train else {}
                )
                for town, count in counts.items():
                    approach_images[town] = max(approach_images.get(town, 0), count)
        target = target_of(self)
        make_recording = partial(TargetRecording, held_out=(), target=target, seed=self.seed, device=device)
        mode: Literal["drive", "orbit"] = "drive" if isinstance(target, TargetCar) else "orbit"
        recordings_by_name = [
            make_recording(
                folder / "data" / town,
                ((town, count),),
                mode=mode,
                size=self.size,
                behind=self.behind,
                distances=tuple(self.distances),
            )
            for town, count in images.items()
        ]
        if self.approach is not None:
            distances = {"approach" if mode == "drive" else "distances": tuple(self.approach.distances)}
            recordings_by_name += [
                make_recording(
                    folder / "data" / f"{town}-{APPROACH}",
                    ((town, count),),
                    mode=mode,
                    size=self.approach.size,
                    behind=self.behind,
                    **distances,  # type: ignore[arg-type]
                )
                for town, count in approach_images.items()
            ]
        if self.grid is not None:
            grid = self.grid
            recordings_by_name += [
                make_recording(
                    folder / "data" / f"{town}-grid",
                    ((town, grid.count),),
                    mode="orbit",
                    size=self.size,
                    distances=tuple(grid.distances),
                    azimuths=tuple(grid.azimuths),
                    elevations=tuple(grid.elevations),
                    weathers=tuple(grid.weathers),
                )
                for town in dict.fromkeys(pair.test for pair in self.pairs if self.seen_around(pair))
            ]
        around_count = max((entry.around for entry in self.attacks), default=0)
        for town in dict.fromkeys(pair.train for pair in self.pairs) if around_count else ():
            recordings_by_name.append(
                make_recording(
                    folder / "data" / f"{town}-around", ((town, around_count),), mode="orbit", size=self.training_size
                )
            )
        return recordings_by_name


def rows_of(table: TargetTable) -> Iterator[CellDescription]:
    """Yield all rows of a table: textures, each beside the clean images, then lights.

    Raises:
        UnknownNameError: Unknown attack.
        ConfigError: An attack or a carrier has no such setting.
    """
    entry_rows = [row_of(table, entry) for entry in table.attacks]
    for row in entry_rows:
        try:
            # A carrier that does not fit should fail before anything is recorded.
            make_carrier(row["carrier"], row["options"]).on(target_of(table).mesh())
        except ConfigError as error:
            raise ConfigError(f"attack {row['attack']}: {error}") from None
    titled_rows = [({"attack": None}, CLEAN), *((row, _title(table, row, entry_rows)) for row in entry_rows)]
    for pair, view, detector in product(table.pairs, VIEWS, [*table.detectors, *table.judges]):
        if (view == GRID and not table.seen_around(pair)) or (view == APPROACH and table.approach is None):
            continue
        for row, title in titled_rows if entry_rows or not table.lights else []:
            yield from _texture_rows(table, pair, view, detector, row, title)
    yield from _light_rows(table)


def _texture_rows(  # noqa: PLR0917
    table: TargetTable, pair: Pair, view: str, detector: str, row: Mapping[str, Any], called: str
) -> Iterator[CellDescription]:
    """A texture before a detector, from each detector that it is trained against, and with each seed."""
    attack = row["attack"]
    is_trained = attack is not None and (attack not in CONTROLS or row["of"] is not None)
    is_transferred = is_trained and ((table.transfer and row["of"] is None) or detector in table.judges)
    sources = [row["source"]] if "file" in row else table.detectors if is_transferred else [detector]
    seeds = range(table.seeds) if attack in ("random", "noise", "shuffled") else (0,)
    for source, seed in product(sources, seeds):
        spec = {"pair": pair.model_dump(), "number": seed, "view": view, "file": None, "around": 0, **row}
        if is_trained and table.approach is not None and table.approach.train:
            spec["approach"] = True
        spec["source"] = source if is_trained else ""
        fields = {
            "test": pair.test,
            "train": pair.train,
            "view": view,
            "detector": detector,
            "carrier": carrier_title(row),
            "attack": called,
            "source": spec["source"],
            "number": seed,
        }
        title_parts = [detector, pair.test, fields["attack"], fields["carrier"], source, seed]
        title = "/".join(map(str, title_parts)) + (f"/{view}" if view != DRIVE else "")
        yield CellDescription(title, detector, fields, spec)


def _light_rows(table: TargetTable) -> Iterator[CellDescription]:
    """Yield, for each view and hour, the clean images, then each light and its controls."""
    check_lights(table)
    views = [DRIVE] if table.approach is None else [DRIVE, APPROACH]
    for pair, view, detector in product(table.pairs, views, table.detectors):
        rows: list[dict[str, Any]] = [
            {"attack": None, "of": None, "options": {}, "settings": {}, "hour": hour}
            for hour in dict.fromkeys(entry.hour for entry in table.lights)
        ]
        for entry in table.lights:
            common = {"of": None, "options": entry.options, "settings": entry.settings, "hour": entry.hour}
            rows.append({"attack": entry.name, **common})
            rows += [
                {**common, "attack": RANDOM, "of": entry.name, "settings": {}, "number": number}
                for number in range(table.seeds)
            ]
        for row in rows:
            source = detector if row["attack"] not in (None, RANDOM) else ""
            light = {"number": 0, **row, "source": source, "pair": pair.model_dump()}
            fields = {
                "test": pair.test,
                "train": pair.train,
                "view": view,
                "detector": detector,
                "carrier": carrier_title({**row, "carrier": f"light, {row['hour']}"}),
                "attack": _light_title(table, row),
                "source": source,
                "number": light["number"],
            }
            title_parts = [detector, pair.test, fields["attack"], row["hour"], options_title(row), light["number"]]
            title = "/".join(map(str, title_parts)) + (f"/{view}" if view != DRIVE else "")
            yield CellDescription(title, detector, fields, {"attack": None, "light": light})


def _title(table: TargetTable, row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the name of a row in tables, such as "shuffled vanishing, all sides" or "vanishing, rate 0.01"."""

    def row_identity(one: Mapping[str, Any]) -> tuple[str, str, bool]:
        return one["of"] or one["attack"], carrier_title(one), bool(one["around"])

    def sources(one: Mapping[str, Any]) -> set[str]:
        return {one["source"]} if "file" in one else set(table.detectors)

    similar_settings = [
        _stated_settings(table, other_row)
        for other_row in rows
        if row_identity(other_row) == row_identity(row) and sources(other_row) & sources(row)
    ]
    name, _, around = row_identity(row)
    side_text, prefix = ", all sides" if around else "", "shuffled " if row["of"] else ""
    return f"{prefix}{name}{side_text}{_differing_settings(_stated_settings(table, row), similar_settings)}"


def _stated_settings(table: TargetTable, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a row beyond its attack, its carrier and the defaults of the table."""
    table_defaults = {"epochs": table.epochs, "window": table.window}
    further = {"around": row["around"] or None, "texture": row.get("file")}
    further |= {"project": True} if row.get("file") and row["inks"] else {}
    return {key: value for key, value in {**row["settings"], **further}.items() if value != table_defaults.get(key)}


def _differing_settings(own_settings: Mapping[str, Any], other_settings: Sequence[Mapping[str, Any]]) -> str:
    """Stealth, and what others do not say alike: such as ", rate 0.01"."""
    differences = (
        (key, value)
        for key, value in own_settings.items()
        if (key == "stealth" and value) or any(other.get(key) != value for other in other_settings)
    )
    return "".join(f", {key} {_words(value)}" for key, value in differences)


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key} {_words(nested)}" for key, nested in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def _light_title(table: TargetTable, row: Mapping[str, Any]) -> str:
    if row["attack"] is None:
        return CLEAN
    if row["of"]:
        return f"{RANDOM} {row['of']}"
    light_identity = row["attack"], row["hour"], row["options"]
    similar_settings = [
        other_entry.settings
        for other_entry in table.lights
        if (other_entry.name, other_entry.hour, other_entry.options) == light_identity
    ]
    return f"{row['attack']}{_differing_settings(row['settings'], similar_settings)}"


def options_title(row: Mapping[str, Any]) -> str:
    """Format the options of a light."""
    return ",".join(f"{key}={value}" for key, value in row["options"].items()) or "as it is"


def row_of(table: TargetTable, entry: Entry) -> dict[str, Any]:
    """Return an entry as plain data: attack, carrier, options, settings, of.

    Raises:
        UnknownNameError, ConfigError: Unknown attack, or unknown settings.
    """
    if (entry.name == "shuffled") != (entry.of is not None):
        raise ConfigError(f"suite {table.name}: shuffled, and it alone, says of which attack (of: NAME)")
    if entry.of is not None:
        return {**_shuffled(table, entry), "attack": "shuffled", "of": entry.of}
    carrier = entry.carrier or default_carrier(entry.name)
    row: dict[str, Any] = {"attack": entry.name, "carrier": carrier, "options": dict(entry.options), "settings": {}}
    row |= {"of": None, "around": entry.around, "inks": table.inks}
    if entry.project and entry.texture is None:
        raise ConfigError(f"suite {table.name}: {entry.name}: project is for a texture; others have colours of inks")
    if entry.texture is not None:
        return row | _card_fields(table, entry) | {"inks": entry.project}
    if entry.name not in CONTROLS:
        settings = {"epochs": table.epochs, "window": table.window}
        settings = {key: value for key, value in settings.items() if value is not None} | entry.settings
        make_physical(entry.name, **settings)
        return row | {"settings": settings}
    if entry.settings or entry.around:
        raise ConfigError(f"suite {table.name}: {entry.name} is not trained and has no settings")
    return row


def _shuffled(table: TargetTable, entry: Entry) -> dict[str, Any]:
    """The row whose texture is shuffled (see `Entry.of`). ConfigError: there is none, or more than one."""
    rows = [
        row_of(table, candidate)
        for candidate in table.attacks
        if (candidate.name, candidate.around) == (entry.of, entry.around) and candidate.name not in CONTROLS
    ]
    matching_rows = [
        row
        for row in rows
        if entry.carrier in (None, row["carrier"])
        and entry.texture in (None, row.get("file"))
        and _is_subset({**entry.options, **entry.settings}, {**row["options"], **row["settings"]})
    ]
    row_settings = [
        {"carrier": row["carrier"], **row["options"], **_stated_settings(table, row)} for row in matching_rows
    ]
    plainest = [
        row
        for row, candidate_settings in zip(matching_rows, row_settings, strict=True)
        if all(_is_subset(candidate_settings, other_settings) for other_settings in row_settings)
    ]
    if not plainest:
        choices = "; ".join(
            f"{carrier_title(row)}{_differing_settings(_stated_settings(table, row), [{}])}"
            for row in matching_rows or rows
        )
        hint = (
            f"; {'several fit' if matching_rows else 'none fits'}, say carrier, options, settings or "
            f"texture of one: {choices}"
        )
        raise ConfigError(
            f"suite {table.name}: shuffled of '{entry.of}': there must be one such attack{hint if rows else ''}"
        )
    return plainest[0]


def _is_subset(subset: Mapping[str, Any], superset: Mapping[str, Any]) -> bool:
    """Whether all that one says the other says too."""
    return {**superset, **subset} == superset


def check_lights(table: TargetTable) -> None:
    """Raise ConfigError or UnknownNameError for an attack, an hour or a setting that does not exist."""
    for entry in table.lights:
        attack = make_light(entry.name, entry.options)
        at_hour(SceneWeather(), entry.hour)
        if isinstance(attack, Projector):
            attack.training(**entry.settings)
        else:
            budget_of(entry.settings, entry.name)


def carrier_title(row: Mapping[str, Any]) -> str:
    """Format the carrier of a row and its options, such as "patch, height 0.86, width 1.9"; "" for no texture."""
    options = sorted((row.get("options") or {}).items())
    return ", ".join([row.get("carrier", ""), *(f"{key} {value}" for key, value in options)])


def _card_fields(table: TargetTable, entry: Entry) -> dict[str, Any]:
    """Return the fields of a row that the card of a texture sets.

    Raises:
        ConfigError: The suite contradicts the card.
    """
    assert entry.texture is not None
    colour, card = load_texture(entry.texture)
    if entry.carrier or entry.options or entry.settings or entry.around:
        raise ConfigError(f"suite {table.name}: texture {entry.texture}: its card says carrier, options and settings")
    if (card.attack, card.target) != (entry.name, table.target):
        raise ConfigError(
            f"suite {table.name}: texture {entry.texture} is of {card.attack} on {card.target}, not of {entry.name} on "
            f"{table.target}"
        )
    size = make_carrier(card.carrier, card.options).on(target_of(table).mesh()).size
    if tuple(colour.shape[1:]) != size:
        raise ConfigError(f"texture {entry.texture}: {list(colour.shape[1:])} texels, its surface has {list(size)}")
    card_fields = {"carrier": card.carrier, "options": dict(card.options), "source": card.source}
    return card_fields | {"file": entry.texture, "hash": card.hash}


def target_of(table: TargetTable) -> Target:
    """Return the target of a table.

    Raises:
        ConfigError: The table requests lights or `around` for a target other than a car.
    """
    target = parse_target(table.target)
    if not isinstance(target, TargetCar) and (table.lights or any(entry.around for entry in table.attacks)):
        raise ConfigError(f"suite {table.name}: target {table.target}: lights and around are for cars")
    return target
