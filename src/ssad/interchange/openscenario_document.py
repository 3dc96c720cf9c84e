"""OpenSCENARIO documents with their parameters, expressions and catalogues put in; errors name file and line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

from ssad.core.errors import ConfigError, FormatError
from ssad.core.expressions import evaluate, number_or_text, text_of
from ssad.core.safeio import MIB, read_xml

MAX_BYTES: Final = 64 * MIB
MAX_CATALOGUES: Final = 200  # files of a folder
MAX_NESTED: Final = 8  # catalogue entries in catalogue entries
MAX_REFERENCES: Final = 50  # parameters whose values need each other, in a chain
MAX_ELEMENTS: Final = 1_000_000  # of a document with its catalogue entries
BODIES: Final = ("Vehicle", "Pedestrian", "MiscObject")
_NAME = re.compile(r"\$\{?\s*([^\W\d][\w.]*)\s*\}?")
_EXPRESSION = re.compile(r"\$\{(.*)\}", re.DOTALL)
# Some tools write the constants of expressions as parameters.
_CONSTANTS: Final = {"pi": repr(math.pi)}
# Names of declarations, which some files write with the $ of a reference.
_DECLARED: Final = ("parameterRef", "variableRef", "parameterName")
_RULES: Final = {
    "equalTo": lambda value, limit_value: value == limit_value,
    "notEqualTo": lambda value, limit_value: value != limit_value,
    "greaterThan": lambda value, limit_value: value > limit_value,
    "greaterOrEqual": lambda value, limit_value: value >= limit_value,
    "lessThan": lambda value, limit_value: value < limit_value,
    "lessOrEqual": lambda value, limit_value: value <= limit_value,
}


class LineElement(Element):
    """Element of a document with the file and the line that it comes from."""

    def __init__(self, tag: str, attrib: dict[str, str], line: int = 0, source: str = "") -> None:
        super().__init__(tag.rpartition("}")[2], attrib)
        self.line, self.source = line, source


class ConstraintError(FormatError):
    """A parameter has a value that its declaration excludes."""


def read_document(file_path: Path) -> Element:
    """Read the root of a file, unresolved. FormatError if it is no OpenSCENARIO XML."""
    root = read_xml(
        file_path,
        limit=MAX_BYTES,
        element_factory=lambda tag, attributes, line: LineElement(tag, attributes, line, str(file_path)),
    )
    if root.tag != "OpenSCENARIO":
        raise FormatError(f"{file_path}: not OpenSCENARIO XML: its root is <{root.tag[:40]}>")
    return root


def error_at(element: Element, message: str, kind: type[FormatError] = FormatError) -> FormatError:
    """Return an error that names the file, the line and the tag of an element."""
    source, line = getattr(element, "source", ""), getattr(element, "line", 0)
    place = f"{source}:{line}: " if source else ""
    return kind(f"{place}{element.tag}: {message}")


class AttributeReader:
    """Attributes of a resolved document; errors name file, line and element."""

    def __init__(self, location: str) -> None:
        self.location = location

    def error(self, element: Element | str, message: str) -> FormatError:
        """Return a FormatError that names the file and the element."""
        if isinstance(element, LineElement):
            return error_at(element, message)
        tag = element if isinstance(element, str) else element.tag
        return FormatError(f"{self.location}: {tag}: {message}")

    def text(self, element: Element, name: str, default: str | None = None) -> str:
        """Return an attribute as text. FormatError if it is missing and there is no default."""
        value = element.get(name, default)
        if value is None:
            raise self.error(element, f"attribute '{name}' is missing")
        return value

    def number(self, element: Element, name: str, default: float | None = None) -> float:
        """Return an attribute as a finite number. FormatError if it is none."""
        number_text = self.text(element, name, None if default is None else repr(default))
        try:
            value = float(number_text)
        except ValueError:
            raise self.error(element, f"{name} is '{number_text[:40]}', not a number") from None
        if not math.isfinite(value):
            raise self.error(element, f"{name} is '{number_text[:40]}', not a finite number")
        return value

    def truth(self, element: Element, name: str, *, default: bool) -> bool:
        """Return an attribute as a truth value. FormatError if it is none."""
        text = self.text(element, name, "true" if default else "false").strip()
        if text not in ("true", "false", "1", "0"):
            raise self.error(element, f"{name} is '{text[:40]}', not true or false")
        return text in ("true", "1")

    def lanes(self, element: Element, name: str) -> int:
        """Return a number of lanes to the left, negative to the right. FormatError where no road has as many."""
        value = self.number(element, name, 0.0)
        if abs(value) > MAX_LANES:
            raise self.error(element, f"{name} is {value:g}: no road has so many lanes")
        return int(value)


MAX_LANES: Final = 20


@dataclass
class Scope:
    """Parameters that a part of a document knows.

    Attributes:
        declarations: Declaration of each name.
        assigned: Values that take the place of declared ones.
        parent: Scope around it.
    """

    declarations: Mapping[str, Element] = field(default_factory=dict)
    assigned: Mapping[str, str] = field(default_factory=dict)
    parent: Scope | None = None
    _values: dict[str, str] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)

    def value(self, name: str) -> str:
        """Return the value of a parameter. KeyError if it is not declared, FormatError if it depends on itself."""
        if name in self._values:
            return self._values[name]
        if name not in self.declarations:
            if self.parent is not None:
                return self.parent.value(name)
            if name in _CONSTANTS:
                return _CONSTANTS[name]
            raise KeyError(name)
        declaration = self.declarations[name]
        if name in self._open:
            ring = " -> ".join([*self._open[self._open.index(name) :], name])
            raise error_at(declaration, f"the parameter depends on itself: {ring[:200]}")
        if len(self._open) >= MAX_REFERENCES:
            raise error_at(
                declaration, f"parameter '{name[:60]}' ends a chain of more than {MAX_REFERENCES} parameters"
            )
        self._open.append(name)
        try:
            text = self.assigned.get(name)
            self._values[name] = self.text(declaration, "value", declaration.get("value", "")) if text is None else text
        finally:
            self._open.pop()
        return self._values[name]

    def text(self, element: Element, name: str, raw: str) -> str:
        """Return an attribute with its parameter or expression put in. FormatError if it has no value."""
        if "$" not in raw:
            return raw
        if name in _DECLARED:
            return raw.removeprefix("$")
        stripped = raw.strip()
        if stripped.startswith("\\$"):
            return stripped[1:]
        if reference := _NAME.fullmatch(stripped):
            try:
                return self.value(reference[1])
            except KeyError:
                raise error_at(element, f"{name}: {self._unknown(reference[1])}") from None
        expression = _EXPRESSION.fullmatch(stripped)
        if expression is None:
            if stripped.startswith("$"):
                raise error_at(element, f"{name}: '{raw[:60]}' is neither $parameter nor ${{expression}}")
            return raw

        def lookup(parameter: str) -> str:
            try:
                return self.value(parameter)
            except KeyError:
                raise ConfigError(f"expression '{expression[1].strip()[:80]}': {self._unknown(parameter)}") from None

        try:
            return text_of(evaluate(expression[1], lookup))
        except ConfigError as error:
            joined = self._joined_text(expression[1]) if name == "name" or name.endswith("Ref") else None
            if joined is None:
                raise error_at(element, f"{name}: {error}") from None
            return joined

    def names(self) -> list[str]:
        """Return the names of all parameters that can be used here."""
        return [*self.declarations, *(self.parent.names() if self.parent is not None else ())]

    def _unknown(self, name: str) -> str:
        """Return the message for a parameter that is not declared, with the names closest to it."""
        suggestions = ", ".join(f"${match}" for match in get_close_matches(name, self.names(), n=3, cutoff=0.0))
        hint = f"; closest: {suggestions}" if suggestions else ", and no other is"
        return f"parameter ${name[:60]} is not declared{hint}"

    def _joined_text(self, expression: str) -> str | None:
        """Return the texts and parameters that + joins, as some tools name elements; None if it is no such text."""
        text_parts = [text_part.strip() for text_part in expression.split("+")]
        texts = []
        for text_part in text_parts:
            reference = _NAME.fullmatch(text_part)
            if reference is None and not re.fullmatch(r"[\w ]+", text_part):
                return None
            try:
                texts.append(self.value(reference[1]) if reference else text_part)
            except KeyError:
                return None
        return "".join(texts)

    def check(self) -> None:
        """Evaluate all parameters. ConstraintError where none of a parameter's groups of constraints holds."""
        for name, declaration in self.declarations.items():
            value = number_or_text(self.value(name))
            groups = declaration.findall("ConstraintGroup")
            limits = [
                [
                    (constraint.get("rule", ""), self.text(constraint, "value", constraint.get("value", "")))
                    for constraint in constraint_group
                ]
                for constraint_group in groups
            ]
            if groups and not any(
                all(_holds(value, *limit_value) for limit_value in constraint_group) for constraint_group in limits
            ):
                stated = " or ".join(
                    " and ".join(f"{rule_name} {limit_value}" for rule_name, limit_value in constraint_group)
                    for constraint_group in limits
                )
                raise error_at(
                    declaration, f"parameter '{name}' is {text_of(value)}, but must be {stated[:200]}", ConstraintError
                )


def _holds(value: float | bool | str, rule_name: str, limit_text: str) -> bool:
    limit_value = number_or_text(limit_text)
    if isinstance(value, str) != isinstance(limit_value, str):
        return rule_name == "notEqualTo"
    return rule_name in _RULES and bool(_RULES[rule_name](value, limit_value))


def resolve(
    root: Element, file_path: Path, assigned: Mapping[str, str] | None = None
) -> tuple[Element, dict[str, str]]:
    """Return a document with parameters, expressions and catalogue entries put in.

    Args:
        root: The document, of `read_document`.
        file_path: Its file; catalogues lie relative to it.
        assigned: Values that take the place of those that the document declares.

    Returns:
        The document without declarations and references, and the values of its parameters.

    Raises:
        FormatError: A parameter is not declared or depends on itself, an expression has no value, or a catalogue entry
            does not exist.
        ConstraintError: A parameter has a value that its declaration excludes.
    """
    declared = declarations(root)
    for name in assigned or {}:
        if name not in declared:
            raise FormatError(f"{file_path}: {undeclared(name, declared, 'it')}")
    scope = Scope(declared, assigned or {})
    scope.check()
    resolver = _Resolver(_Catalogues(root, file_path, scope))
    resolved = resolver.copy(root, scope, declare=False)
    return resolved, {name: scope.value(name) for name in declared}


def undeclared(name: str, declared: Iterable[str], owner: str) -> str:
    """Return the message that a document, which `owner` names, does not declare a parameter that is to be set."""
    return f"{owner} declares no parameter '{name[:60]}' that could be set; declared: {', '.join(declared) or 'none'}"


def declarations(element: Element) -> dict[str, Element]:
    """Return the declarations of parameters of an element, by name."""
    return {item.get("name", "").removeprefix("$"): item for item in element.iterfind("ParameterDeclarations/*")}


class _Resolver:
    """Copies of elements with everything put in."""

    def __init__(self, catalogues: _Catalogues) -> None:
        self.catalogues = catalogues
        self.count = 0

    def copy(self, element: Element, scope: Scope, *, declare: bool = True, depth: int = 0) -> LineElement:
        """Return the resolved copy of an element."""
        self.count += 1
        if self.count > MAX_ELEMENTS:
            raise error_at(element, f"the document has more than {MAX_ELEMENTS} elements with its catalogues")
        if declare and element.find("ParameterDeclarations") is not None:
            scope = Scope(declarations(element), {}, scope)
            scope.check()
        attributes = {name: scope.text(element, name, value) for name, value in element.items()}
        result = LineElement(element.tag, attributes, getattr(element, "line", 0), getattr(element, "source", ""))
        result.text = element.text
        for child in element:
            if child.tag == "ParameterDeclarations":
                continue
            if child.tag == "CatalogReference" and depth < MAX_NESTED:
                result.append(self.entry(child, scope, depth))
            else:
                result.append(self.copy(child, scope, depth=depth))
        return result

    def entry(self, reference: Element, scope: Scope, depth: int) -> LineElement:
        """Return the resolved catalogue entry of a reference, or the reference if there is no such catalogue."""
        copied = self.copy(reference, scope, depth=MAX_NESTED)
        entry = self.catalogues.entry(copied)
        if entry is None:
            return copied
        assigned = {
            item.get("parameterRef", ""): item.get("value", "")
            for item in copied.iterfind("ParameterAssignments/ParameterAssignment")
        }
        declared = declarations(entry)
        for name in assigned:
            if name not in declared:
                raise error_at(reference, f"catalogue entry '{copied.get('entryName')}' has no parameter '{name[:60]}'")
        inner = Scope(declared, assigned, scope)
        inner.check()
        return self.copy(entry, inner, declare=False, depth=depth + 1)


class _Catalogues:
    """Catalogues of the folders that a document names."""

    def __init__(self, root: Element, file_path: Path, scope: Scope) -> None:
        stated = [
            scope.text(directory, "path", directory.get("path", "")).replace("\\", "/")
            for directory in root.iterfind("CatalogLocations/*/Directory")
        ]
        self.folders = [file_path.parent / folder for folder in stated if not Path(folder).is_absolute()]
        self._catalogues: dict[str, dict[str, Element]] | None = None

    def entry(self, reference: Element) -> Element | None:
        """Return the entry that a resolved reference names; None if its catalogue is not there."""
        if self._catalogues is None:
            self._catalogues = _read_catalogues(self.folders)
        catalogue_name, entry_name = reference.get("catalogName", ""), reference.get("entryName", "")
        catalogue = self._catalogues.get(catalogue_name)
        if catalogue is None:
            return None
        if entry_name not in catalogue:
            entries = ", ".join(sorted(catalogue)[:12])
            raise error_at(
                reference,
                f"catalogue '{catalogue_name[:60]}' has no entry '{entry_name[:60]}'; it has: {entries[:300]}",
            )
        return catalogue[entry_name]


_FOLDERS: dict[tuple[tuple[str, int], ...], dict[str, dict[str, Element]]] = {}


def _read_catalogues(folders: Sequence[Path]) -> dict[str, dict[str, Element]]:
    """Return the entries of the catalogues in folders: name of the catalogue -> name of the entry -> element."""
    catalogue_paths: list[Path] = []
    for folder in dict.fromkeys(folders):
        catalogue_paths += sorted(folder.glob("*.xosc")) if folder.is_dir() else [folder] * (folder.suffix == ".xosc")
    catalogue_paths = [file_path for file_path in dict.fromkeys(catalogue_paths) if file_path.is_file()]
    if len(catalogue_paths) > MAX_CATALOGUES:
        raise FormatError(
            f"{folders[0]}: {len(catalogue_paths)} files of catalogues; at most {MAX_CATALOGUES} are read"
        )
    # A distribution resolves one document many times; its catalogues are read once.
    key = tuple((str(file_path), file_path.stat().st_mtime_ns) for file_path in catalogue_paths)
    if key not in _FOLDERS:
        _FOLDERS.clear()
        catalogues: dict[str, dict[str, Element]] = {}
        for file_path in catalogue_paths:
            for catalogue in read_document(file_path).iterfind("Catalog"):
                entries = {entry.get("name", ""): entry for entry in catalogue}
                for name in dict.fromkeys((catalogue.get("name", ""), file_path.stem)):
                    catalogues.setdefault(name, {}).update(entries)
        _FOLDERS[key] = catalogues
    return _FOLDERS[key]
