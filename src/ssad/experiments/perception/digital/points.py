"""A table of digital attacks as a suite says it, and the points that follow: what each system is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.schema import Schema
from ssad.experiments.perception.digital.attacked_scenes import AttackSpec, takes
from ssad.scenarios.static.digital import default_loss, make_objective
from ssad.scenarios.static.digital.budget import Norm
from ssad.scenarios.static.digital.defences import make_defence
from ssad.scenarios.static.digital.objectives import UNDIVIDED
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.digital.victim import Precision

Radius = Annotated[float, Field(ge=0.0, le=255.0 * 4000, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=1)]
Scenes = Annotated[int, Field(ge=1)]
ENSEMBLE = "ensemble"
DRAWS = 4  # of a random defence that an attack knows, if the suite does not say it


class Method(Schema):
    """An attack as a suite names it.

    Attributes:
        name: of the attack (`ssad list attacks`).
        loss: what it ascends (default: what the attack is about).
        norm: of the budget.
        options: further settings, such as restarts.
        precision: of the gradients, where it is not the suite's.
    """

    name: str = Field(min_length=1)
    loss: str | None = None
    norm: Literal["linf", "l2"] = "linf"
    options: dict[str, Any] = Field(default={})
    precision: Precision | None = None


class Row(Method):
    """An attack with its settings.

    Attributes:
        radius: Radius in 8-bit code values, where it is not the suite's.
        steps: Number of steps, where it is not the suite's.
        scenes: The attack runs on this many first scenes of each town; None: on all.
    """

    radius: Radius | None = None
    steps: Steps | None = None
    scenes: Scenes | None = None


class Guard(Schema):
    """A defence before the detector: its name (jpeg, bits, blur, resize) and further settings."""

    name: str = Field(min_length=1)
    options: dict[str, Any] = Field(default={})


class Entry(Row):
    """A row of a table.

    Attributes:
        defence: what stands before the detector; the clean data are scored behind it as well.
        aware: whether the attack knows the defence; it then ascends the loss through it, of a random one the mean over
            `draws` draws (default: 4). An attack that does not know it is made against the bare detector.
        draws: see `aware`.
        classes: the classes whose objects are attacked; empty: all.
        becomes: class -> class that its objects should be taken for.
        object: the one object of each moment that is attacked: "nearest" (of `classes`, or of the classes that become
            others, if they are given), or the token of an instance; None: all.
        members: of the attack `ensemble`: the attacks of which the worst is kept at each moment.
    """

    defence: Guard | None = None
    aware: bool | None = None
    draws: Steps | None = None
    classes: list[str] = Field(default=[])
    becomes: dict[str, str] = Field(default={})
    object: Annotated[str, Field(min_length=1)] | None = None
    members: list[Row] = Field(default=[])

    @field_validator("defence", "members", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone has nothing else said."""
        return {"name": value} if isinstance(value, str) else named(value)


class Sweep(Method):
    """A curve: an attack over radii at the suite's steps, and over steps at the suite's radius; scenes as in `Row`."""

    radii: list[Radius] = Field(default=[])
    steps: list[Steps] = Field(default=[])
    scenes: Scenes | None = None


def named(value: Any) -> Any:
    """Names in a list of attacks as attacks with nothing else said."""
    return [{"name": one} if isinstance(one, str) else one for one in value] if isinstance(value, list) else value


class AttackTable(Schema):
    """Digital attacks, beside the clean data and random noise of the same size.

    Attributes:
        name: of the suite.
        attacks: names, or mappings with the keys of `Entry`.
        sweeps: curves.
        transfer: attacks whose pictures, made against each detector, are shown to every other.
        radius: 8-bit code values that a picture may be moved by, where an attack does not say it.
        steps: gradient steps, likewise.
        batch: camera images that are attacked at once on a GPU; where memory does not suffice they are fewer.
        precision: of the gradients: bfloat16 is faster on a GPU. Losses that decide, and scores, are exact.
    """

    name: str
    attacks: list[Entry] = Field(
        default=[Entry(name="fgsm"), Entry(name="pgd"), Entry(name="cw"), Entry(name="pgd", loss="margin")],
        min_length=1,
    )
    sweeps: list[Sweep] = Field(default=[])
    transfer: list[Row] = Field(default=[])
    radius: Radius = Field(default=5.0, gt=0.0)
    steps: Steps = 10
    batch: int = Field(default=12, ge=1)
    precision: Precision = "float32"

    @field_validator("attacks", "sweeps", "transfer", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone is an attack with nothing else said."""
        return named(value)


@dataclass(frozen=True)
class Guarded:
    """A defence with its settings: name, and options in order of their names."""

    name: str
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def text(self) -> str:
        """Such as "jpeg quality=50"."""
        return " ".join([self.name, *(f"{key}={value}" for key, value in self.options)])


@dataclass(frozen=True)
class Point:
    """What a system is shown: the clean data, or attacks (several: the worst of them at each moment).

    Attributes:
        specs: the attacks; none: clean data.
        defence: before the detector.
        aware: whether the attacks know it.
        source: detector that is attacked, if it is not the one that is shown the pictures.
        scenes: the first of each town; 0: all.
        row: whether it stands in the main table.
    """

    specs: tuple[AttackSpec, ...] = ()
    defence: Guarded | None = None
    aware: bool = False
    source: str = ""
    scenes: int = 0
    row: bool = field(default=False, compare=False)

    @property
    def attack(self) -> str:
        """Name of the attack; "clean" without one."""
        return self.specs[0].name if len(self.specs) == 1 else ENSEMBLE if self.specs else "clean"

    @property
    def fields(self) -> dict[str, Any]:
        """Columns of a record that tell what its system was shown."""
        about = {
            "source": self.source,
            "defence": self.defence.text if self.defence else "",
            "aware": self.aware,
            "subset": self.scenes,
            "row": self.row,
        }
        if not self.specs:
            none = dict.fromkeys(("attack", "loss", "norm"))
            return {**none, "radius": 0.0, "steps": 0, "options": "", "target": "", **about}
        spec = self.specs[0]
        found = {
            "attack": spec.attack,
            "loss": spec.loss if spec.attack != "noise" else None,
            "norm": spec.norm,
            "radius": spec.radius,
            "steps": spec.steps,
            "options": _options(spec),
            "target": spec.target,
            **about,
        }
        if len(self.specs) > 1:
            members = ", ".join(" ".join(filter(None, [one.attack, one.loss, _options(one)])) for one in self.specs)
            found |= {"attack": ENSEMBLE, "loss": None, "steps": 0, "options": f"of {members}"}
        return found


def system_name(detector: str, guard: Guarded | None) -> str:
    """What a detector behind a defence is called."""
    return detector if guard is None else f"{detector}+{guard.text.replace(' ', '-')}"


def guard_of(suite: AttackTable, entry: Entry) -> Guarded | None:
    """The defence of a row; it is built in order to see whether it accepts its options.

    Raises:
        ConfigError: It does not, or there is no such defence.
    """
    if entry.defence is None:
        if entry.aware:
            raise ConfigError(f"suite {suite.name}: attack {entry.name}: aware of which defence? it names none")
        return None
    make_defence(entry.defence.name, **entry.defence.options)
    found = Guarded(entry.defence.name, tuple(sorted(entry.defence.options.items())))
    if any(not isinstance(value, str | int | float) for _, value in found.options):
        raise ConfigError(f"suite {suite.name}: defence {found.name}: options are numbers and words")
    return found


def rows_of(suite: AttackTable) -> list[Point]:
    """The rows of the tables.

    Raises:
        ConfigError: An attack does not exist or refuses a setting, or one appears twice.
    """
    found = []
    for one in suite.attacks:
        guard = guard_of(suite, one)
        if bool(one.members) != (one.name == ENSEMBLE):
            raise ConfigError(f"suite {suite.name}: attack {one.name}: an ensemble has members, no other attack has")
        specs = [_spec(suite, member, member.radius or one.radius, member.steps) for member in one.members]
        if len({(spec.norm, spec.radius) for spec in specs}) > 1:
            raise ConfigError(f"suite {suite.name}: attack {ENSEMBLE}: its members have different budgets")
        if not specs:
            draws = (one.draws or DRAWS) if guard and one.aware and hasattr(make_defence(guard.name), "drawn") else 0
            classes, becomes = tuple(one.classes), tuple(sorted(one.becomes.items()))
            for name in [*classes, *one.becomes, *one.becomes.values()]:
                if name not in MMDET3D_CLASSES:
                    raise unknown_name("class", name, MMDET3D_CLASSES)
            if becomes and (one.loss or default_loss(one.name)) != "mislabel":
                raise ConfigError(f"suite {suite.name}: attack {one.name}: becomes needs loss: mislabel")
            spec = replace(
                _spec(suite, one, one.radius, one.steps),
                classes=classes,
                becomes=becomes,
                draws=draws,
                object=one.object or "",
            )
            if not spec.aim.everything and spec.loss in UNDIVIDED:
                raise ConfigError(
                    f"suite {suite.name}: attack {one.name}: loss {spec.loss} is of all objects; to attack some "
                    "choose loss: vanish, margin, hide or mislabel"
                )
            specs = [spec]
        found.append(
            Point(tuple(specs), guard, bool(one.aware), "", one.scenes or 0, row=guard is None and not one.scenes)
        )
    if len(set(found)) != len(found):
        raise ConfigError(f"suite {suite.name}: attacks: one of them appears twice")
    return found


def points_of(suite: AttackTable) -> list[Point]:
    """All conditions that every detector is shown, each once, without the transfer of attacks to other detectors.

    The clean data come first, then noise, rows and curves. Clean data on fewer scenes, or behind a defence, are
    included where something else is compared with them.

    Raises:
        ConfigError: An attack does not exist or refuses a setting, or an attack appears twice.
    """
    rows, curves, moved = rows_of(suite), _swept(suite, suite.sweeps), transfers_of(suite)
    bare = [
        replace(one, specs=(replace(one.specs[0], draws=0),), defence=None, aware=False, row=False)
        for one in rows
        if one.defence
    ]
    return _with_controls([*rows, *curves, *bare, *moved])


def _with_controls(points: Sequence[Point]) -> list[Point]:
    """Clean data and noise that points are compared with, and then these, each once."""
    noise = [
        replace(one, specs=(AttackSpec("noise", default_loss("noise"), one.specs[0].norm, one.specs[0].radius),))
        for one in points
        if one.defence is None
    ]
    clean = [Point(scenes=one.scenes, defence=one.defence) for one in points]
    return list(dict.fromkeys([Point(row=True), *clean, *noise, *points]))


def bystander_points(suite: AttackTable) -> list[Point]:
    """The conditions of a detector that takes part in the transfer alone: clean data, and the attacks made against it.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    moved = transfers_of(suite)
    return list(dict.fromkeys([*(Point(scenes=one.scenes) for one in moved), *moved]))


def hardened_points(suite: AttackTable) -> list[Point]:
    """The conditions of adversarially trained weights: clean data, noise, the main table, and the curves over radii.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    over_radii = [one.model_copy(update={"steps": []}) for one in suite.sweeps if one.radii]
    return _with_controls([*(one for one in rows_of(suite) if one.row), *_swept(suite, over_radii)])


def transfers_of(suite: AttackTable) -> list[Point]:
    """The attacks whose pictures are shown to other detectors.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    return [Point((_spec(suite, one, one.radius, one.steps),), scenes=one.scenes or 0) for one in suite.transfer]


def _spec(suite: AttackTable, method: Method, radius: float | None, steps: int | None) -> AttackSpec:
    """An attack with all its settings; it is built, to see whether it takes them. ConfigError."""
    options = dict(method.options)
    if steps is not None or takes(method.name, "steps"):
        options.setdefault("steps", suite.steps if steps is None else steps)
    loss = method.loss or default_loss(method.name)
    make_objective(loss)
    norm: Norm = method.norm
    size = suite.radius if radius is None else radius
    if not size > 0:
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: the radius must be above 0; clean data always run"
        )
    try:
        safeio.dump_json(options)
        hash(spec := AttackSpec(method.name, loss, norm, float(size), tuple(sorted(options.items()))))
    except (TypeError, ValueError):
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: options are numbers and words, not {options}"
        ) from None
    made = spec.make()
    graded = made.access == "white-box" or isinstance(made, UniversalFit)
    return replace(spec, precision=method.precision or suite.precision) if graded else spec


def _swept(suite: AttackTable, sweeps: Sequence[Sweep]) -> list[Point]:
    """The points of the curves; a radius of 0 is the clean data. ConfigError."""
    found = []
    for one in sweeps:
        if not one.radii and not one.steps:
            raise ConfigError(f"suite {suite.name}: sweeps: {one.name} has neither radii nor steps")
        specs = [_spec(suite, one, radius, None) for radius in one.radii if radius > 0]
        specs += [_spec(suite, one, None, steps) for steps in one.steps]
        found += [Point((spec,), scenes=one.scenes or 0) for spec in specs]
    return found


def _options(spec: AttackSpec) -> str:
    others = [(key, value) for key, value in spec.options if key != "steps"]
    others += [("draws", spec.draws)] if spec.draws else []
    others += [("precision", spec.precision)] if spec.precision != "float32" else []
    return " ".join(f"{key}={value}" for key, value in others)
