"""Perturbations by name: what is registered, and the YAML forms in which every suite writes them.

    perturbations:
      - fog                                    # a name, at the severities of the suite
      - {fog: [1, 3]}                          # at severities of its own
      - {pgd: {steps: 5, radius: 4}}           # with settings
      - "pgd?steps=5@strong"                   # the same on one line, with a label for tables
      - {texture: mine.json}                   # the card of a texture, beside mine.png
      - {light: my-lamp/}                      # a light that `ssad export light` wrote
      - {fault: "my_faults:Smear", width: 3}   # a class of your own
      - {"my_package:Haze": {density: 0.2}}    # the same, with the family taken from its methods

Packages register names through the entry-point groups `ssad.shifts`, `ssad.attacks`, `ssad.lights`, `ssad.faults` and
`ssad.perturbations` (objects that derive from `Perturbation`, of any family).
"""

from __future__ import annotations

import inspect
import re
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BeforeValidator, Field, model_serializer, model_validator

from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.registry import Reference, make, offered_names, resolve
from ssad.core.schema import Schema
from ssad.scenarios.static.perturbation import Perturbation

NONE: Final = "none"
FAMILIES: Final = ("shift", "digital", "texture", "light", "fault")
"""Families of SSAD; a perturbation of your own may be of any other."""
SPELLINGS: Final = {"attack": "digital", "perturbation": "own"}  # keys of an entry beside the families themselves
GROUPS: Final = {"shift": "shift", "digital": "attack", "light": "light", "fault": "fault", "own": "perturbation"}
STREET: Final = "ssad.scenarios.static.physical.street"
STREET_PERTURBATIONS: Final[dict[str, str]] = {
    "dirty-road": f"{STREET}.dirty_road:DirtyRoad",
    "phantom": f"{STREET}.phantom:Phantom",
    "lens-light": f"{STREET}.lens_light:LensLight",
    "sign-change": f"{STREET}.signs:SignChange",
    "head-light": f"{STREET}.signs:HeadLight",
}
"""Perturbations that state their own family, as those of packages do."""
RADII: Final = (1.0, 2.0, 4.0, 8.0, 16.0)  # code values that a digital attack may move a pixel by, by severity
# Attacks that take five gradient steps unless a suite sets them: two steps of 16 code values change nothing on YOLOv5n.
STEPPED: Final = ("pgd", "cw", "momentum", "apgd")
STEPS: Final = 5
LOSS: Final = "margin"  # of attacks: it hides objects, and needs no truth beside the detections

Severity = Annotated[int, Field(ge=1, le=5)]


class PerturbationEntry(Schema):
    """Perturbation of a suite, as data.

    Attributes:
        family: Family, or "own": the object says it.
        name: Registered name, path, or "module:object".
        severities: Severities 1 to 5; None: those of the suite.
        label: Name in tables; "": the name with its settings.
        options: Arguments of the object.
    """

    family: str
    name: str = Field(min_length=1)
    severities: Annotated[list[Severity] | None, Field(min_length=1)] = None
    label: str = ""
    options: dict[str, Any] = Field(default={})

    @property
    def title(self) -> str:
        """Name in tables and slices: the label, or the name with its settings, as `parse_perturbation` reads it."""
        if self.label:
            return self.label
        name = Path(self.name).stem if self.is_path else self.name
        settings = "&".join(f"{key}={_setting_text(value)}" for key, value in sorted(self.settings.items()))
        return f"{name}?{settings}" if settings else name

    @property
    def is_path(self) -> bool:
        """True if the name is a file or a folder."""
        return self.family in ("texture", "light") and is_path(self.name)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings but severities and label, that differ from the defaults."""
        return dict(self.options)

    @property
    def has_severities(self) -> bool:
        """True if its severities 1 to 5 differ."""
        return True

    def at(self, severities: Iterable[int]) -> list[Perturbation]:
        """Return the perturbation at its own severities, or at those of a suite; once if it has none.

        Args:
            severities: Severities of the suite.

        Raises:
            ConfigError: A setting is wrong, or it has severities and has none.
        """
        if not self.has_severities:
            if self.severities is not None:
                raise ConfigError(f"perturbation '{self.title}' has no severities; remove {self.severities}")
            return [self.make(1)]
        return [self.make(severity) for severity in dict.fromkeys(self.severities or severities)]

    def make(self, severity: int) -> Perturbation:
        """Return the perturbation at a severity.

        Raises:
            UnknownNameError: There is no such perturbation.
            ConfigError: A setting is unknown or has an invalid value.
            FormatError: A file is missing or broken.
        """
        raise NotImplementedError

    def beside(self, folder: Path) -> Self:
        """Return the entry with its file in the working folder, else in another folder."""
        path = Path(self.name).expanduser()
        if not self.is_path or path.is_absolute() or path.exists():
            return self
        return self.model_copy(update={"name": str(folder / path)})

    @model_serializer
    def _shortest_form(self) -> str | dict[str, Any]:
        """Return the shortest form that `parse_perturbation` reads."""
        fields = {**self.settings, **({"label": self.label} if self.label else {})}
        if self.severities is not None:
            fields["severity"] = self.severities
        is_registered = registered_names().get(self.name) == self.family
        if is_registered and not fields:
            return self.name
        if is_registered:
            return {self.name: fields}
        family = next((key for key, family in SPELLINGS.items() if family == self.family), self.family)
        return {family: self.name, **fields}


class ShiftEntry(PerturbationEntry):
    """Distribution shift: one of `ssad list shifts`, or a class with a method `shift`."""

    family: Literal["shift"]

    @property
    def has_severities(self) -> bool:
        """True, but for a class without an argument `severity`."""
        return not is_user_defined(self.name) or _takes_severity("shift", self.name)

    def make(self, severity: int) -> Perturbation:
        """Return the shift at a severity."""
        from ssad.scenarios.static.shifts.perturbation import Shift, UserShift

        if not is_user_defined(self.name):
            _refuse_options(self.name, self.options)
            return Shift(self.name, severity, label=self.label)
        return UserShift(self.title, _make_object("shift", self.name, self.options, severity, ("shift",)), severity)


class DigitalEntry(PerturbationEntry):
    """Digital attack: one of `ssad list attacks`, or a class with a method `perturb`.

    Attributes:
        radius: Radius of the budget in 8-bit code values; None: by severity.
        norm: Norm of the budget.
        loss: Loss that the attack raises.
        classes: Names of the attacked classes; empty: all.
    """

    family: Literal["digital"]
    radius: Annotated[float | None, Field(gt=0, le=255, strict=False)] = None
    norm: Literal["linf", "l2"] = "linf"
    loss: str = LOSS
    classes: list[str] = Field(default=[])

    @property
    def settings(self) -> dict[str, Any]:
        """Options, and the fields that differ from their defaults."""
        fields = {"radius": self.radius, "norm": self.norm, "loss": self.loss, "classes": self.classes}
        defaults: dict[str, Any] = {"radius": None, "norm": "linf", "loss": LOSS, "classes": []}
        return {**self.options, **{key: value for key, value in fields.items() if value != defaults[key]}}

    @property
    def has_severities(self) -> bool:
        """True unless a radius is given."""
        return self.radius is None

    def make(self, severity: int) -> Perturbation:
        """Return the attack with its budget."""
        from ssad.scenarios.static.digital import make_objective
        from ssad.scenarios.static.digital.perturbation import DigitalAttack
        from ssad.scenarios.static.digital.spec import AttackSpec

        options = {**({"steps": STEPS} if self.name in STEPPED else {}), **self.options}
        radius = RADII[severity - 1] if self.radius is None else self.radius
        make_objective(self.loss)
        spec = AttackSpec(
            self.name, self.loss, self.norm, radius, tuple(sorted(options.items())), classes=tuple(self.classes)
        )
        spec.make()
        return DigitalAttack(spec, self.title, severity)


class TextureEntry(PerturbationEntry):
    """Finished texture: a shipped one, "grey" or "grey-sign", the path of a card, or an exported folder."""

    family: Literal["texture"]

    @property
    def has_severities(self) -> bool:
        """False: a texture is as it is."""
        return False

    def make(self, severity: int) -> Perturbation:
        """Return the texture."""
        from ssad.scenarios.static.physical.textures.perturbation import Texture

        _refuse_options(self.name, self.options)
        return Texture(self.name, self.label)


class LightEntry(PerturbationEntry):
    """Light: "night", one of `LIGHTS` with its options, an exported folder, or a class of the user's own."""

    family: Literal["light"]

    @property
    def has_severities(self) -> bool:
        """True for a lamp, whose power they set."""
        from ssad.scenarios.static.physical.lights.perturbation import LAMPS

        return self.name in LAMPS and LAMPS[self.name] not in self.options

    def make(self, severity: int) -> Perturbation:
        """Return the light at a severity."""
        from ssad.scenarios.static.physical.lights.perturbation import NIGHT, LightPerturbation

        if self.name == NIGHT or self.is_path:
            _refuse_options(self.name, self.options)
        return LightPerturbation(self.name, severity, self.options, self.label or ("" if self.is_path else self.title))


class FaultEntry(PerturbationEntry):
    """Fault: one of `FAULTS`, or a class with the methods `apply`, `observe` or `command`."""

    family: Literal["fault"]

    @property
    def has_severities(self) -> bool:
        """True, but for a class without an argument `severity`."""
        return not is_user_defined(self.name) or _takes_severity("fault", self.name)

    def make(self, severity: int) -> Perturbation:
        """Return the fault at a severity."""
        from ssad.scenarios.static.faults.perturbation import Fault

        if not is_user_defined(self.name):
            _refuse_options(self.name, self.options)
            return Fault.of_camera(self.name, severity, label=self.label)
        return Fault(self.title, lambda: _make_object("fault", self.name, self.options, severity, ()), severity)


class UserEntry(PerturbationEntry):
    """Object of the user's own that derives from `Perturbation`, of any family."""

    family: Literal["own"]

    @property
    def has_severities(self) -> bool:
        """True for a class with an argument `severity`."""
        return _takes_severity("perturbation", self.name, STREET_PERTURBATIONS)

    def make(self, severity: int) -> Perturbation:
        """Return the perturbation at a severity."""
        attributes = ("name", "family")
        perturbation = _make_object("perturbation", self.name, self.options, severity, attributes, STREET_PERTURBATIONS)
        if not isinstance(perturbation, Perturbation):
            raise ConfigError(
                f"perturbation '{self.name}': of type {type(perturbation).__name__}, which does not derive from "
                "ssad.scenarios.static.perturbation.Perturbation"
            )
        return perturbation


def _parse(value: Any) -> Any:
    """Return the fields of an entry from any of its forms; a ValueError's message is complete."""
    try:
        return value if isinstance(value, PerturbationEntry) else _fields_of(value)
    except ConfigError as error:
        raise ValueError(str(error)) from None


Entry = Annotated[
    Annotated[
        ShiftEntry | DigitalEntry | TextureEntry | LightEntry | FaultEntry | UserEntry, Field(discriminator="family")
    ],
    BeforeValidator(_parse),
]
"""Perturbation in a suite, in any of the forms of this module."""


class _Holder(Schema):
    """Schema around one entry, for `parse_perturbation`."""

    entry: Entry


def parse_perturbation(value: Any) -> PerturbationEntry:
    """Return the entry of a perturbation from any of its YAML forms.

    Args:
        value: A text or a mapping.

    Raises:
        ConfigError: The form is wrong, or there is no such perturbation.
    """
    from pydantic import ValidationError

    try:
        return _Holder(entry=value).entry
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        field_path = ".".join(str(part) for part in problem["loc"][2:])
        message = problem["msg"].removeprefix("Value error, ")
        if message.startswith("perturbation "):  # it names itself
            raise ConfigError(message) from None
        raise ConfigError(f"perturbation {value!r}: {field_path + ': ' if field_path else ''}{message}") from None


def _fields_of(value: Any) -> dict[str, Any]:
    """Return the fields of an entry from a text or a mapping."""
    if isinstance(value, str):
        current = _current_spelling(value)
        if current is not value:
            warnings.warn(
                f"'{value}' is an old spelling of a perturbation and will be refused: write {current!r}",
                FutureWarning,
                stacklevel=2,
            )
            return _fields_of(current)
        reference = Reference("", {}, "") if is_path(value) else Reference.parse(value)
        name = reference.name or value
        return _fields(family_of_name(name), name, dict(reference.options), reference.label)
    if not isinstance(value, Mapping) or not value:
        raise ConfigError(f"{value!r} is no perturbation: write a name, such as fog, or a mapping, such as {{fog: 3}}")
    families = [key for key in value if key in FAMILIES or key in SPELLINGS]
    if families:
        if len(families) > 1:
            raise ConfigError(f"{dict(value)}: {' and '.join(families)} in one perturbation; write two")
        key = families[0]
        other_settings = {name: setting for name, setting in value.items() if name != key}
        object_name = value[key]
        if isinstance(object_name, Mapping):  # {texture: {name: mine.json}}
            other_settings, object_name = {**object_name, **other_settings}, object_name.get("name")
            other_settings.pop("name", None)
        if not isinstance(object_name, str) or not object_name:
            raise ConfigError(f"{dict(value)}: {key} is a name, a path or module:object, not {object_name!r}")
        reference = Reference("", {}, "") if is_path(object_name) else Reference.parse(object_name)
        name, family = reference.name or object_name, SPELLINGS.get(key, key)
        if family != "own":
            _check_name(family, name)
        return _fields(family, name, {**reference.options, **other_settings}, reference.label)
    if len(value) > 1:
        raise ConfigError(
            f"{dict(value)}: settings stand below the name, as in {{{next(iter(value))}: {{...}}}}, or beside a family "
            f"({', '.join(FAMILIES)}), as in {{texture: mine.json}}"
        )
    ((name, settings),) = value.items()
    if not isinstance(name, str):
        raise ConfigError(f"{dict(value)}: the name of a perturbation is a text")
    if settings is None:
        settings = {}
    if isinstance(settings, int | Sequence) and not isinstance(settings, str | bool):
        settings = {"severity": settings}
    if not isinstance(settings, Mapping):
        raise ConfigError(f"{dict(value)}: below a name stand severities or settings, not {settings!r}")
    reference = Reference.parse(name)
    return _fields(family_of_name(reference.name), reference.name, {**reference.options, **settings}, reference.label)


def _fields(family: str, name: str, settings: dict[str, Any], label: str) -> dict[str, Any]:
    """Return the fields of an entry: settings of its schema, and the others as options of the object."""
    fields: dict[str, Any] = {"family": family, "name": name, "label": settings.pop("label", label)}
    severity = settings.pop("severity", settings.pop("severities", None))
    if severity is not None:
        fields["severities"] = [severity] if isinstance(severity, int) else list(severity)
    options = dict(settings.pop("options", {}))
    if family == "digital":
        for key in ("radius", "norm", "loss", "classes"):
            if key in settings:
                fields[key] = settings.pop(key)
        if isinstance(fields.get("classes"), str):
            fields["classes"] = [fields["classes"]]
    return {**fields, "options": {**options, **settings}}


def _current_spelling(text: str) -> str:
    """Return the present spelling of a perturbation that an earlier version wrote; the text itself if it is one."""
    if text.startswith("shine:"):
        return text.removeprefix("shine:")
    for prefix, family in (("attack-", "digital"), ("wear-", "texture"), ("shine-", "light")):
        if not text.startswith(prefix):
            continue
        name = text.removeprefix(prefix)
        stem, _, steps = name.rpartition("-")
        if family == "digital" and stem in STEPPED and re.fullmatch("[1-9][0-9]{0,2}", steps):
            return f"{stem}?steps={steps}"
        if registered_names().get(name) == family:
            return name
    return text


def registered_names() -> Mapping[str, str]:
    """Return all registered perturbations -> their family; "own": the object says it."""
    return _registered(tuple(sys.path))


@lru_cache(maxsize=4)
def _registered(search_path: tuple[str, ...]) -> Mapping[str, str]:
    """Return the registered perturbations that packages on a search path add to SSAD's own."""
    from ssad.scenarios.static.digital import ATTACKS, needs
    from ssad.scenarios.static.faults.camera import FAULTS
    from ssad.scenarios.static.physical.lights import LIGHTS
    from ssad.scenarios.static.physical.lights.perturbation import NIGHT
    from ssad.scenarios.static.physical.textures.card import shipped_textures
    from ssad.scenarios.static.physical.textures.perturbation import CONTROLS
    from ssad.scenarios.static.shifts.spec import KNOWN

    names: dict[str, str] = {}
    for family, group in GROUPS.items():
        names |= dict.fromkeys(offered_names(f"ssad.{group}s"), family)
    names |= dict.fromkeys((*CONTROLS, *shipped_textures()), "texture")
    names |= dict.fromkeys((name for name in ATTACKS if not needs(name)), "digital")
    names |= dict.fromkeys((NIGHT, *LIGHTS), "light") | dict.fromkeys(STREET_PERTURBATIONS, "own")
    return MappingProxyType(names | dict.fromkeys(FAULTS, "fault") | dict.fromkeys(KNOWN, "shift"))


def family_of_name(name: str) -> str:
    """Return the family of a name, path or "module:object"; "own" for an object that says it itself.

    Raises:
        UnknownNameError: There is no such perturbation.
        ConfigError: A module cannot be imported, or its object is no perturbation.
    """
    names = registered_names()
    if name in names:
        return names[name]
    folder = Path(name).expanduser()
    if name.endswith(".json") or (folder / "texture.json").is_file():
        return "texture"
    if (folder / "light.json").is_file():
        return "light"
    if is_path(name):
        raise ConfigError(
            f"{name}: neither the card of a texture (NAME.json) nor a folder of ssad export texture or light"
        )
    if ":" in name:
        return _family_of_object(name)
    raise unknown_name("perturbation", name, names)


def _check_name(family: str, name: str) -> None:
    """Raise UnknownNameError if a family has no such name."""
    names = {
        registered_name
        for registered_name, registered_family in registered_names().items()
        if registered_family == family
    }
    if name in names or ":" in name or (family in ("texture", "light") and is_path(name)):
        return
    raise unknown_name("perturbation", name, names)


def _family_of_object(name: str) -> str:
    """Return the family of "module:object" from the methods of its object."""
    candidate = resolve("perturbation", {}, name)
    if inspect.isfunction(candidate):
        candidate = make("perturbation", name, candidate, {}, ())
    if isinstance(candidate, Perturbation) or (isinstance(candidate, type) and issubclass(candidate, Perturbation)):
        return "own"
    methods = {"digital": ("perturb",), "shift": ("shift",), "light": ("ranges", "edit"), "fault": ("apply",)}
    for family, required_methods in methods.items():
        if all(callable(getattr(candidate, method, None)) for method in required_methods):
            return family
    if any(callable(getattr(candidate, method, None)) for method in ("observe", "command")):
        return "fault"
    raise ConfigError(
        f"perturbation '{name}' has none of the methods perturb (attack), shift (shift), ranges and edit (light), "
        "apply, observe or command (fault), and does not derive from Perturbation"
    )


def is_user_defined(name: str) -> bool:
    """Return True for an object of a package or of the user: not a name that SSAD registers."""
    from ssad.scenarios.static.faults.camera import FAULTS
    from ssad.scenarios.static.shifts.spec import KNOWN

    return name not in KNOWN and name not in FAULTS


def is_path(name: str) -> bool:
    """Return True for a name that is written as a path, or is the folder of an export."""
    folder = Path(name).expanduser()
    if name.endswith((".json", "/")) or name.startswith((".", "/", "~")):
        return True
    return any((folder / card_name).is_file() for card_name in ("light.json", "texture.json"))


def _make_object(  # noqa: PLR0917  # plain values
    kind: str,
    name: str,
    options: Mapping[str, Any],
    severity: int,
    required_attributes: tuple[str, ...],
    built_in: Mapping[str, str] = MappingProxyType({}),
) -> Any:
    """Return an object of its own family, made with its options, and with the severity if it takes one."""
    factory = resolve(kind, built_in, name)
    arguments = dict(options)
    if _takes_severity(kind, name, built_in):
        arguments["severity"] = severity
    return make(kind, name, factory, arguments, required_attributes)


def _takes_severity(kind: str, name: str, built_in: Mapping[str, str] = MappingProxyType({})) -> bool:
    """Return True if a class or function has an argument `severity`."""
    factory = resolve(kind, built_in, name)
    if not callable(factory):
        return False
    try:
        return "severity" in inspect.signature(factory).parameters
    except (TypeError, ValueError):  # a class written in C has no signature
        return False


def _refuse_options(name: str, options: Mapping[str, Any]) -> None:
    """Raise ConfigError for options of a perturbation that takes none."""
    if options:
        raise ConfigError(f"perturbation '{name}' has no settings; remove {', '.join(sorted(options))}")


def _setting_text(value: Any) -> str:
    """Return a setting as `Reference.parse` reads it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    return safeio.dump_json(value) if isinstance(value, list | dict) else f"{value}"


class PerturbationTable(Schema):
    """Keys of every suite that takes perturbations.

    Attributes:
        perturbations: Names, paths or module:object, with settings (docs/reference/perturbations.md).
        severities: Severities 1 to 5 of the perturbations that set none of their own.
    """

    perturbations: list[Entry] = Field(default=[])
    severities: list[Severity] = Field(default=[3], min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _without_none(cls, data: Any) -> Any:
        """Remove "none": the clean condition runs in any case."""
        entries = data.get("perturbations") if isinstance(data, Mapping) else None
        if not isinstance(entries, list):
            return data
        return {**data, "perturbations": [entry for entry in entries if entry != NONE]}

    def with_files_beside(self, folder: Path) -> Self:
        """Return the suite with the files of its perturbations in the working folder, else in another folder."""
        resolved = [entry.beside(folder) for entry in self.perturbations]
        return self.model_copy(update={"perturbations": resolved})

    def conditions(self) -> list[Perturbation]:
        """Return all perturbations at their severities, in the order of the suite.

        Raises:
            SSADError: A perturbation cannot be made, or two have the same name and severity.
        """
        perturbations = [perturbation for entry in self.perturbations for perturbation in entry.at(self.severities)]
        names = [(perturbation.name, perturbation.severity) for perturbation in perturbations]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise ConfigError(
                f"perturbations: {repeated[0]} appears twice at severity {repeated[1]}; tell two apart by a label"
            )
        return perturbations
