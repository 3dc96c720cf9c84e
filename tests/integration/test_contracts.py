"""The rules that hold the tree together: imports run one way, every file says what it is, the public face is small."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[2]
SOURCE = sorted((ROOT / "src" / "ssad").rglob("*.py"))


def test_imports_run_one_way() -> None:
    tool = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([str(tool), "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def rank_of_packages() -> dict[str, int]:
    """Layer of each top-level package, from the contract of imports: the core is 0."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = contracts[0]["layers"]
    return {name.strip(): rank for rank, layer in enumerate(reversed(layers)) for name in layer.split("|")}


def packages_named(source: str) -> list[tuple[int, str]]:
    """Lines and top-level packages of the strings of a module, docstrings aside, that name a module of SSAD."""
    tree = ast.parse(source)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    # The string under an assignment is the documentation of that name.
    docstrings |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return [
        (node.lineno, package)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
        for package in re.findall(r"\bssad\.([a-z_]+)\.", node.value)
    ]


def test_no_string_names_a_layer_above_or_beside() -> None:
    """A name that is resolved at run time, "ssad.x.y:Z", is an import that the contracts do not see."""
    ranks, offences = rank_of_packages(), []
    for path in SOURCE:
        package = path.relative_to(ROOT / "src" / "ssad").parts[0].removesuffix(".py")
        for line, named_package in packages_named(path.read_text()):
            if named_package != package and ranks.get(named_package, -1) >= ranks.get(package, len(ranks)):
                offences.append(f"{path.relative_to(ROOT)}:{line} names {named_package}")
    assert offences == []
    assert packages_named('"""ssad.cli.run"""\nX = {"a": "ssad.interchange.scenic:S"}') == [(2, "interchange")]


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports inside of functions count, those for type checkers alone do not."""
    graph = grimp.build_graph("ssad", exclude_type_checking_imports=True, cache_dir=None)
    order = TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules})
    assert len(list(order.static_order())) >= len(SOURCE)  # a circle raises CycleError, which names it


def test_every_file_says_what_it_is() -> None:
    texts = {path.relative_to(ROOT).as_posix(): path.read_text() for path in SOURCE}
    assert [name for name, text in texts.items() if text and not text.startswith('"""')] == []


def test_import_ssad_loads_no_heavy_package() -> None:
    code = "import sys, ssad; print([m for m in ('torch', 'warp', 'cv2', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_no_pickle_and_no_bare_yaml_or_xml() -> None:
    doors = {
        "safeio.py",
        "pickled.py",
        "pickle_walk.py",
    }  # the latter reads checkpoints with a list of what they may call
    words = ("import pickle", "allow_pickle=True", "yaml.load(", "import xml.etree", "import yaml")
    found = [
        f"{path.name}: {word}"
        for path in SOURCE
        if path.name not in doors
        for word in words
        if word in path.read_text()
    ]
    assert found == []


def test_the_rules_for_docstrings_hold_for_all_source() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["lint"]
    assert "D" in settings["select"]
    assert {rule for rule in settings["ignore"] if rule.startswith("D")} == {"D105", "D107"}
    for pattern, rules in settings["per-file-ignores"].items():
        assert not (pattern.startswith("src/") and any(rule.startswith("D") for rule in rules)), pattern
    assert not [path.name for path in SOURCE if "noqa: D" in path.read_text()]


def test_only_kernels_switch_the_formatter_off() -> None:
    """Line limits once made people join lines by hand; there are no such limits any more."""
    off = [path for path in SOURCE if "fmt: " in path.read_text() and "kernels" not in path.parts]
    assert off == []
