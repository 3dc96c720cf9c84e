"""Which source a result depends on: a module, all that it imports, and all that it names to be imported later."""

from __future__ import annotations

import hashlib
import importlib.util
import re
from functools import lru_cache
from pathlib import Path

from ssad.core.seeding import digest

_FROM = re.compile(r"^[ \t]*from[ \t]+(\.*)([\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)", re.MULTILINE)
_IMPORT = re.compile(r"^[ \t]*import[ \t]+([^\n]+)", re.MULTILINE)
_STRING = re.compile(r"""["'](\w+(?:\.\w+)+)(?::\w+)?["']""")  # "package.module:object", as tables of names have it


def source_version(module: str) -> str:
    """12 hex digits over the source files that a module depends on; see `source_files`."""
    files = source_files(module)
    return digest("source", *[part for name, path in sorted(files.items()) for part in (name, _scan(path)[0])])[:12]


def source_files(module: str) -> dict[str, Path]:
    """The files of a module and of all that it leads to, by module name.

    Followed are imports, wherever in the text they stand, and strings that name a module (of a package so named, all
    modules). What is installed elsewhere than beside the module's own top-level package is left out: its version is in
    run.json.

    Args:
        module: full name. Nothing is imported.

    Returns:
        Module name -> its file; empty where the module has no source.
    """
    top = module.partition(".")[0]
    spec = importlib.util.find_spec(top)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return {}
    base = Path(spec.origin).parent.parent if spec.submodule_search_locations else Path(spec.origin).parent
    found: dict[str, Path] = {}
    queue = [module]
    while queue:
        name = queue.pop()
        path = _file(base, name)
        if name in found or path is None:
            continue
        found[name] = path
        parent = name.rpartition(".")[0]
        if "." in parent:  # the top-level package's own names are loaded on demand
            queue.append(parent)
        package = name if path.name == "__init__.py" else parent
        _, imports, named = _scan(path)
        for dots, origin, names in imports:
            start = (
                origin if not dots else ".".join([*package.split(".")[: len(package.split(".")) - dots + 1], origin])
            )
            start = start.strip(".")
            queue += [start, *(f"{start}.{one}" for one in names)] if start != top else [f"{top}.{n}" for n in names]
        for text in named:
            queue.append(text)
            inside = base / Path(*text.split("."))
            queue += [f"{text}.{one.stem}" for one in inside.glob("[!_]*.py")] if text.startswith(f"{top}.") else []
    return found


def _file(base: Path, name: str) -> Path | None:
    """The file of a module below a folder."""
    path = base / Path(*name.split("."))
    for candidate in (path.with_name(path.name + ".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def _scan(path: Path) -> tuple[str, tuple[tuple[int, str, tuple[str, ...]], ...], tuple[str, ...]]:
    """Hash of a file, its imports (dots, module, names), and the modules that its strings name."""
    status = path.stat()
    return _scanned(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4096)
def _scanned(
    path: Path, _changed: int, _size: int
) -> tuple[str, tuple[tuple[int, str, tuple[str, ...]], ...], tuple[str, ...]]:
    data = path.read_bytes()
    text = data.decode("utf-8", "replace")
    imports = [
        (len(m[1]), m[2], tuple(re.findall(r"(\w+)(?:\s+as\s+\w+)?\s*(?:,|\)|$)", m[3]))) for m in _FROM.finditer(text)
    ]
    imports += [(0, part.split()[0], ()) for m in _IMPORT.finditer(text) for part in m[1].split(",") if part.split()]
    return hashlib.sha256(data).hexdigest(), tuple(imports), tuple(set(_STRING.findall(text)))
