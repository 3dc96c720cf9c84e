"""Source files that a result depends on: a module, its imports, and the modules named for later import."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from ssad.core.registry import Reference, names, resolve
from ssad.core.seeding import digest

Import = tuple[int, str, tuple[str, ...]]
"""The dots, the module and the names of an import."""
# Where an import may begin; `ast` reads it. To parse whole files takes seconds, and each command needs hundreds.
_START = re.compile(r"(?:^|[:;])[ \t]*((?:from|import)\b)", re.MULTILINE)
_BRACKET = re.compile(r"from\b[\s.\w\\]+\bimport[\s\\]*\((?:[^)#]|#[^\n]*+)*+$")  # opened and not closed
_STRING = re.compile(r"""["'](\w+(?:\.\w+)+)(?::\w+)?["']""")  # "package.module:object", as tables of names have it

INSTALLED = ("site-packages", "dist-packages")
"""Names of folders of installed packages: all that a module imports lies beside it there, numpy and torch included."""


def source_version(module: str, *, excluded_modules: Sequence[str] = ()) -> str:
    """Return 12 hex digits over the source files that a module depends on; see `source_files`."""
    files = source_files(module, excluded_modules=excluded_modules)
    return digest("source", *[part for name, path in sorted(files.items()) for part in (name, _scan(path)[0])])[:12]


def source_files(module: str, *, excluded_modules: Sequence[str] = ()) -> dict[str, Path]:
    """Return the files of a module and of its dependencies, by module name.

    Imports are followed wherever they stand, and so are strings that name a module (for a package, all its
    modules). Code installed elsewhere than beside the module's own top-level package is left out, and so are the
    other packages in a folder of installed ones: their versions are in run.json.

    Args:
        module: Full name. Nothing is imported.
        excluded_modules: Modules and packages that are not followed, by their full names.

    Returns:
        Module name -> its file; empty where the module has no source.
    """
    top = module.partition(".")[0]
    spec = importlib.util.find_spec(top)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return {}
    base = Path(spec.origin).parent.parent if spec.submodule_search_locations else Path(spec.origin).parent
    is_installed = base.name in INSTALLED
    files_by_module: dict[str, Path] = {}
    queue = [module]
    visited, listed = set[str](), set[str]()  # names that are done, and packages whose modules are in the queue
    while queue:
        name = queue.pop()
        if name in visited:  # most names come up dozens of times, and each costs a look at the disk
            continue
        visited.add(name)
        path = None if is_installed and name.partition(".")[0] != top else _file(base, name)
        skipped = any(name == excluded or name.startswith(f"{excluded}.") for excluded in excluded_modules)
        if skipped or path is None:
            continue
        files_by_module[name] = path
        parent = name.rpartition(".")[0]
        if "." in parent:  # the top-level package's own names are loaded on demand
            # A package's __init__ runs before its modules.
            queue.append(parent)
        package = name if path.name == "__init__.py" else parent
        _, imports, module_strings = _scan(path)
        for level, origin, imported_names in imports:
            target = (
                origin if not level else ".".join([*package.split(".")[: len(package.split(".")) - level + 1], origin])
            )
            target = target.strip(".")
            queue += (
                [target, *(f"{target}.{imported}" for imported in imported_names)]
                if target != top
                else [f"{top}.{imported_name}" for imported_name in imported_names]
            )
        for text in module_strings:
            if text.startswith(f"{top}.") and text not in listed:
                listed.add(text)
                queue += [f"{text}.{imported.stem}" for imported in (base / Path(*text.split("."))).glob("[!_]*.py")]
            queue.append(text)
    return files_by_module


def plugin_version(kind: str, table: Mapping[str, str], name: str) -> str:
    """Return 12 hex digits over the source of an object that a package or the user brings, for the keys of results.

    Args:
        kind: As for `resolve`.
        table: As for `resolve`.
        name: A name that `resolve` understands; arguments and a label may follow.

    Returns:
        Hash over the module that the name stands for, the module of its class, and all that they import; "" for a
        built-in name, whose source is that of SSAD.

    Raises:
        UnknownNameError, ConfigError: As for `resolve`.
    """
    name = Reference.parse(name).name
    if name in table:
        return ""
    target, origin = resolve(kind, table, name), names(kind, table).get(name, name)
    # An object is not always of a class of its own module: a scenario class is an instance of SSAD's ScenarioType.
    modules = {origin.partition(":")[0], getattr(target, "__module__", None) or type(target).__module__}
    return " ".join(filter(None, (source_version(module) for module in sorted(modules) if not _is_built_in(module))))


def _is_built_in(module: str) -> bool:
    """Return True for a module of SSAD or of Python, which decides no version of a plug-in."""
    return module.partition(".")[0] in ("ssad", "builtins", "functools")


def _file(base: Path, name: str) -> Path | None:
    """Return the file of a module below a folder."""
    path = os.path.join(base, *name.split("."))
    for candidate in (f"{path}.py", os.path.join(path, "__init__.py")):
        if os.path.isfile(candidate):
            return Path(candidate)
    return None


def _scan(path: Path) -> tuple[str, tuple[Import, ...], tuple[str, ...]]:
    """Return the hash of a file, its imports, and the modules that its strings name."""
    status = path.stat()
    # Time and size are part of the cache's key: an edited file is scanned again.
    return _scan_cached(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4096)
def _scan_cached(path: Path, _changed: int, _size: int) -> tuple[str, tuple[Import, ...], tuple[str, ...]]:
    content = path.read_bytes()
    text = content.decode("utf-8", "replace")
    imports: list[Import] = []
    for start in _START.finditer(text):
        for statement in _statements(text, start.start(1)):
            if isinstance(statement, ast.ImportFrom):
                names = tuple(alias.name for alias in statement.names)
                imports.append((statement.level, statement.module or "", names))
            elif isinstance(statement, ast.Import):
                imports += [(0, alias.name, ()) for alias in statement.names]
    return hashlib.sha256(content).hexdigest(), tuple(imports), tuple(set(_STRING.findall(text)))


def _statements(text: str, start: int) -> list[ast.stmt]:
    """Return the statements on the logical line that begins at a position; none where the text is not Python."""
    end = start
    while end < len(text):
        end = text.find("\n", end) + 1 or len(text)
        lines = text[start:end]
        try:
            return ast.parse(lines).body
        except (SyntaxError, ValueError):
            # An open bracket or a backslash: the statement goes on in the next line.
            if not (_BRACKET.match(lines) or lines.rstrip("\r\n").endswith("\\")):
                return []
    return []
