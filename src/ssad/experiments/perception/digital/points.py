"""A table of digital attacks of a suite, and the conditions that follow from it for each system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.schema import Schema
from ssad.core.source import plugin_version
from ssad.scenarios.static.digital import default_loss, make_objective
from ssad.scenarios.static.digital.budget import Norm
from ssad.scenarios.static.digital.defences import DEFENCES, Defence, RandomDefence, make_defence
from ssad.scenarios.static.digital.objectives import UNDIVIDED
from ssad.scenarios.static.digital.spec import AttackSpec, has_option
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.digital.victim import Precision

Radius = Annotated[float, Field(ge=0.0, le=255.0 * 4000, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=1)]
Scenes = Annotated[int, Field(ge=1)]
ENSEMBLE = "ensemble"
DRAWS = 4  # of a random defence that an attack knows, if the suite does not say it


class Method(Schema):
    """Attack as a suite names it.

    Attributes:
        name: name of the attack (`ssad list attacks`).
        loss: objective of the ascent (default: that of the attack).
        norm: norm of the budget.
        options: further settings, such as restarts.
        precision: precision of the gradients, if it differs from the suite's.
    """

    name: str = Field(min_length=1)
    loss: str | None = None
    norm: Literal["linf", "l2"] = "linf"
    options: dict[str, Any] = Field(default={})
    precision: Precision | None = None


class AttackRow(Method):
    """Attack with its settings.

    Attributes:
        radius: Radius in 8-bit code values, if it differs from the suite's.
        steps: Number of steps, if it differs from the suite's.
        scenes: The attack runs on this many first scenes of each town; None: on all.
    """

    radius: Radius | None = None
    steps: Steps | None = None
    scenes: Scenes | None = None


class Guard(Schema):
    """A defence before the detector.

    Attributes:
        name: jpeg, bits, blur, resize, or module:object.
        options: Further settings, such as quality.
    """

    name: str = Field(min_length=1)
    options: dict[str, Any] = Field(default={})


class AttackEntry(AttackRow):
    """Row of a table.

    Attributes:
        defence: defence before the detector; the clean data are scored behind it as well.
        aware: whether the attack knows the defence; it then ascends the loss through it, of a random one the mean
            over `draws` draws (default: 4). An attack that does not know it is made against the bare detector.
        draws: see `aware`.
        classes: the classes whose objects are attacked; empty: all.
        becomes: class -> target class of its objects.
        object: the attacked object of each moment: "nearest" (of `classes`, or of the classes in `becomes`, if
            they are given), or the token of an instance; None: all.
        members: for the attack `ensemble`: the attacks of which the worst is kept at each moment.
    """

    defence: Guard | None = None
    aware: bool | None = None
    draws: Steps | None = None
    classes: list[str] = Field(default=[])
    becomes: dict[str, str] = Field(default={})
    object: Annotated[str, Field(min_length=1)] | None = None
    members: list[AttackRow] = Field(default=[])

    @field_validator("defence", "members", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """Turn a bare name into an entry with default settings."""
        return {"name": value} if isinstance(value, str) else named(value)


class Sweep(Method):
    """A curve: an attack over radii at the suite's steps, and over steps at the suite's radius.

    Attributes:
        radii: Radii in 8-bit code values.
        steps: Numbers of steps.
        scenes: The attack runs on this many first scenes of each town; None: on all.
    """

    radii: list[Radius] = Field(default=[])
    steps: list[Steps] = Field(default=[])
    scenes: Scenes | None = None


def named(value: Any) -> Any:
    """Turn names in a list of attacks into entries with default settings."""
    return (
        [{"name": entry} if isinstance(entry, str) else entry for entry in value] if isinstance(value, list) else value
    )


class AttackTable(Schema):
    """Digital attacks, beside the clean data and random noise of the same size.

    Attributes:
        name: of the suite.
        attacks: names, or mappings with the keys of an attack entry.
        sweeps: curves.
        transfer: attacks whose images, made against each detector, are shown to every other.
        radius: maximum change of an image in 8-bit code values, unless an attack sets it.
        steps: gradient steps, likewise.
        batch: camera images that are attacked at once on a GPU; fewer if memory does not suffice.
        precision: precision of the gradients; bfloat16 is faster on a GPU. Losses that decide, and scores, are exact.
    """

    name: str
    attacks: list[AttackEntry] = Field(
        default=[
            AttackEntry(name="fgsm"),
            AttackEntry(name="pgd"),
            AttackEntry(name="cw"),
            AttackEntry(name="pgd", loss="margin"),
        ],
        min_length=1,
    )
    sweeps: list[Sweep] = Field(default=[])
    transfer: list[AttackRow] = Field(default=[])
    radius: Radius = Field(default=5.0, gt=0.0)
    steps: Steps = 10
    batch: int = Field(default=12, ge=1)
    precision: Precision = "float32"

    @field_validator("attacks", "sweeps", "transfer", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """Turn a bare name into an entry with default settings."""
        return named(value)

    def loss_of(self, method: Method) -> str:
        """Return the loss that an attack of the table ascends."""
        return method.loss or default_loss(method.name)


@dataclass(frozen=True)
class Guarded:
    """Defence with its settings: name, and options in order of their names."""

    name: str
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def text(self) -> str:
        """Such as "jpeg quality=50"."""
        return " ".join([self.name, *(f"{key}={value}" for key, value in self.options)])

    @property
    def version(self) -> str:
        """Version of a defence of the user's own; "" for one of SSAD."""
        return plugin_version("defence", DEFENCES, self.name)

    def make(self) -> Defence:
        """Return the defence.

        Raises:
            UnknownNameError: There is no such defence.
            ConfigError: An option is unknown or has an invalid value.
        """
        return make_defence(self.name, **dict(self.options))


@dataclass(frozen=True)
class AttackPoint:
    """Condition of a system: the clean data, or attacks (several: the worst of them at each moment).

    Attributes:
        specs: the attacks; empty: clean data.
        defence: defence before the detector.
        aware: whether the attacks know it.
        source: attacked detector, if it is not the one that is shown the images.
        scenes: number of first scenes of each town; 0: all.
        row: whether it belongs to the main table.
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
    def version(self) -> str:
        """Versions of the attacks, losses and the defence that are the user's own; "" for those of SSAD."""
        versions = [spec.version for spec in self.specs] + [self.defence.version if self.defence else ""]
        return " ".join(filter(None, versions))

    @property
    def fields(self) -> dict[str, Any]:
        """Columns of a record that describe the condition."""
        common_fields = {
            "source": self.source,
            "defence": self.defence.text if self.defence else "",
            "aware": self.aware,
            "subset": self.scenes,
            "row": self.row,
        }
        if not self.specs:
            no_attack = dict.fromkeys(("attack", "loss", "norm"))
            return {**no_attack, "radius": 0.0, "steps": 0, "options": "", "target": "", **common_fields}
        spec = self.specs[0]
        columns = {
            "attack": spec.attack,
            "loss": spec.loss if spec.attack != "noise" else None,
            "norm": spec.norm,
            "radius": spec.radius,
            "steps": spec.steps,
            "options": _options(spec),
            "target": spec.target,
            **common_fields,
        }
        if len(self.specs) > 1:
            members = ", ".join(
                " ".join(filter(None, [member_spec.attack, member_spec.loss, _options(member_spec)]))
                for member_spec in self.specs
            )
            columns |= {"attack": ENSEMBLE, "loss": None, "steps": 0, "options": f"of {members}"}
        return columns


def system_name(detector: str, guard: Guarded | None) -> str:
    """Return the name of a detector behind a defence."""
    return detector if guard is None else f"{detector}+{guard.text.replace(' ', '-')}"


def guard_of(suite: AttackTable, entry: AttackEntry) -> Guarded | None:
    """Return the defence of a row; it is built to check its options.

    Raises:
        ConfigError: Unknown defence, or an invalid option.
    """
    if entry.defence is None:
        if entry.aware:
            raise ConfigError(f"suite {suite.name}: attack {entry.name}: aware of which defence? it names none")
        return None
    defence = Guarded(entry.defence.name, tuple(sorted(entry.defence.options.items())))
    defence.make()
    if any(not isinstance(value, str | int | float) for _, value in defence.options):
        raise ConfigError(f"suite {suite.name}: defence {defence.name}: options are numbers and words")
    return defence


def rows_of(suite: AttackTable) -> list[AttackPoint]:
    """Return the rows of the tables.

    Raises:
        ConfigError: An attack does not exist, refuses a setting, or appears twice.
    """
    points = []
    for entry in suite.attacks:
        defence = guard_of(suite, entry)
        if bool(entry.members) != (entry.name == ENSEMBLE):
            raise ConfigError(f"suite {suite.name}: attack {entry.name}: an ensemble has members, no other attack has")
        specs = [_spec(suite, member, member.radius or entry.radius, member.steps) for member in entry.members]
        if len({(spec.norm, spec.radius) for spec in specs}) > 1:
            raise ConfigError(f"suite {suite.name}: attack {ENSEMBLE}: its members have different budgets")
        if not specs:
            draws = (
                (entry.draws or DRAWS) if defence and entry.aware and isinstance(defence.make(), RandomDefence) else 0
            )
            classes, becomes = tuple(entry.classes), tuple(sorted(entry.becomes.items()))
            for name in [*classes, *entry.becomes, *entry.becomes.values()]:
                if name not in MMDET3D_CLASSES:
                    raise unknown_name("class", name, MMDET3D_CLASSES)
            if becomes and suite.loss_of(entry) != "mislabel":
                raise ConfigError(f"suite {suite.name}: attack {entry.name}: becomes needs loss: mislabel")
            spec = replace(
                _spec(suite, entry, entry.radius, entry.steps),
                classes=classes,
                becomes=becomes,
                draws=draws,
                object=entry.object or "",
            )
            if not spec.aim.attacks_all and spec.loss in UNDIVIDED:
                raise ConfigError(
                    f"suite {suite.name}: attack {entry.name}: loss {spec.loss} is of all objects; to attack some "
                    "choose loss: vanish, margin, hide or mislabel"
                )
            specs = [spec]
        points.append(
            AttackPoint(
                tuple(specs),
                defence,
                bool(entry.aware),
                "",
                entry.scenes or 0,
                row=defence is None and not entry.scenes,
            )
        )
    if len(set(points)) != len(points):
        raise ConfigError(f"suite {suite.name}: attacks: one of them appears twice")
    return points


def points_of(suite: AttackTable) -> list[AttackPoint]:
    """Return all conditions of every detector, each once, without the transfer of attacks to other detectors.

    The clean data come first, then noise, rows and curves. Clean data on fewer scenes, or behind a defence, are
    included if another condition is compared with them.

    Raises:
        ConfigError: An attack does not exist, refuses a setting, or appears twice.
    """
    rows, sweep_points, transfer_points = rows_of(suite), _swept(suite, suite.sweeps), transfers_of(suite)
    # An attack behind a defence is compared with the same attack on the bare detector.
    undefended_points = [
        replace(point, specs=(replace(point.specs[0], draws=0),), defence=None, aware=False, row=False)
        for point in rows
        if point.defence
    ]
    return _with_controls(suite, [*rows, *sweep_points, *undefended_points, *transfer_points])


def _with_controls(suite: AttackTable, points: Sequence[AttackPoint]) -> list[AttackPoint]:
    """Return the clean data and noise that points are compared with, and then the points, each once."""
    noise_points = [
        replace(
            point,
            specs=(
                AttackSpec("noise", suite.loss_of(Method(name="noise")), point.specs[0].norm, point.specs[0].radius),
            ),
        )
        for point in points
        if point.defence is None
    ]
    clean_points = [AttackPoint(scenes=point.scenes, defence=point.defence) for point in points]
    # A dict keeps the first of equal points in order; a set would not.
    return list(dict.fromkeys([AttackPoint(row=True), *clean_points, *noise_points, *points]))


def bystander_points(suite: AttackTable) -> list[AttackPoint]:
    """The conditions of a detector that takes part in the transfer alone: clean data, and the attacks made against it.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    transfer_points = transfers_of(suite)
    return list(dict.fromkeys([*(AttackPoint(scenes=point.scenes) for point in transfer_points), *transfer_points]))


def hardened_points(suite: AttackTable) -> list[AttackPoint]:
    """The conditions of adversarially trained weights: clean data, noise, the main table, and the curves over radii.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    over_radii = [selected.model_copy(update={"steps": []}) for selected in suite.sweeps if selected.radii]
    return _with_controls(
        suite, [*(selected for selected in rows_of(suite) if selected.row), *_swept(suite, over_radii)]
    )


def transfers_of(suite: AttackTable) -> list[AttackPoint]:
    """Return the attacks whose images are shown to other detectors.

    Raises:
        ConfigError: An attack does not exist or refuses a setting.
    """
    return [AttackPoint((_spec(suite, row, row.radius, row.steps),), scenes=row.scenes or 0) for row in suite.transfer]


def _spec(suite: AttackTable, method: Method, radius: float | None, steps: int | None) -> AttackSpec:
    """Return an attack with all its settings; it is built to check them.

    Raises:
        ConfigError: It refuses a setting.
    """
    options = dict(method.options)
    if steps is not None or has_option(method.name, "steps"):
        options.setdefault("steps", suite.steps if steps is None else steps)
    loss = suite.loss_of(method)
    make_objective(loss)
    norm: Norm = method.norm
    radius_value = suite.radius if radius is None else radius
    if not radius_value > 0:
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: the radius must be above 0; clean data always run"
        )
    try:
        safeio.dump_json(options)
        # Specs are dictionary keys and go to JSON; lists and objects would fail much later.
        hash(spec := AttackSpec(method.name, loss, norm, float(radius_value), tuple(sorted(options.items()))))
    except (TypeError, ValueError):
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: options are numbers and words, not {options}"
        ) from None
    attack = spec.make()
    uses_gradient = attack.access == "white-box" or isinstance(attack, UniversalFit)
    return replace(spec, precision=method.precision or suite.precision) if uses_gradient else spec


def _swept(suite: AttackTable, sweeps: Sequence[Sweep]) -> list[AttackPoint]:
    """Return the points of the curves; a radius of 0 is the clean data.

    Raises:
        ConfigError: A curve has neither radii nor steps.
    """
    points = []
    for sweep in sweeps:
        if not sweep.radii and not sweep.steps:
            raise ConfigError(f"suite {suite.name}: sweeps: {sweep.name} has neither radii nor steps")
        specs = [_spec(suite, sweep, radius, None) for radius in sweep.radii if radius > 0]
        specs += [_spec(suite, sweep, None, steps) for steps in sweep.steps]
        points += [AttackPoint((spec,), scenes=sweep.scenes or 0) for spec in specs]
    return points


def _options(spec: AttackSpec) -> str:
    other_options = [(key, value) for key, value in spec.options if key != "steps"]
    other_options += [("draws", spec.draws)] if spec.draws else []
    other_options += [("precision", spec.precision)] if spec.precision != "float32" else []
    return " ".join(f"{key}={value}" for key, value in other_options)
