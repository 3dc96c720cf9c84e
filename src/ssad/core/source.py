"""Source files that a result depends on: a module, its imports, and the modules named for later import."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from ssad.core.seeding import digest

Import = tuple[int, str, tuple[str, ...]]
"""The dots, the module and the names of an import."""
# Where an import may begin; `ast` reads it. To parse whole files takes seconds, and each command needs hundreds.
_START = re.compile(r"(?:^|[:;])[ \t]*((?:from|import)\b)", re.MULTILINE)
_BRACKET = re.compile(r"from\b[\s.\w\\]+\bimport[\s\\]*\((?:[^)#]|#[^\n]*+)*+$")  # opened and not closed
_STRING = re.compile(r"""["'](\w+(?:\.\w+)+)(?::\w+)?["']""")  # "package.module:object", as tables of names have it


def source_version(module: str, *, excluded_modules: Sequence[str] = ()) -> str:
    """Return 12 hex digits over the source files that a module depends on; see `source_files`."""
    files = source_files(module, excluded_modules=excluded_modules)
    return digest("source", *[part for name, path in sorted(files.items()) for part in (name, _scan(path)[0])])[:12]


def source_files(module: str, *, excluded_modules: Sequence[str] = ()) -> dict[str, Path]:
    """Return the files of a module and of its dependencies, by module name.

    Imports are followed wherever they stand, and so are strings that name a module (for a package, all its
    modules). Code installed elsewhere than beside the module's own top-level package is left out: its version is
    in run.json.

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
    files_by_module: dict[str, Path] = {}
    queue = [module]
    while queue:
        name = queue.pop()
        path = _file(base, name)
        skipped = any(name == excluded or name.startswith(f"{excluded}.") for excluded in excluded_modules)
        if skipped or name in files_by_module or path is None:
            continue
        files_by_module[name] = path
        parent = name.rpartition(".")[0]
        if "." in parent:  # the top-level package's own names are loaded on demand
            # A package's __init__ runs before its modules.
            queue.append(parent)
        package = name if path.name == "__init__.py" else parent
        _, imports, module_strings = _scan(path)
        for level, origin, names in imports:
            target = (
                origin if not level else ".".join([*package.split(".")[: len(package.split(".")) - level + 1], origin])
            )
            target = target.strip(".")
            queue += (
                [target, *(f"{target}.{imported}" for imported in names)]
                if target != top
                else [f"{top}.{imported_name}" for imported_name in names]
            )
        for text in module_strings:
            queue.append(text)
            package_folder = base / Path(*text.split("."))
            queue += (
                [f"{text}.{imported.stem}" for imported in package_folder.glob("[!_]*.py")]
                if text.startswith(f"{top}.")
                else []
            )
    return files_by_module


def _file(base: Path, name: str) -> Path | None:
    """Return the file of a module below a folder."""
    path = base / Path(*name.split("."))
    for candidate in (path.with_name(path.name + ".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
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
