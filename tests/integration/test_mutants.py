"""The command that tries random mutants: what it changes, what it counts, and that it goes on where it stopped."""

from __future__ import annotations

import ast
import json
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

TOOL = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "mutants.py")))

SOURCE = '''"""Text."""
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    LIMIT = 9


@cached(size=3)
def f(a: Literal[4], b=True) -> Literal[5]:
    """Text 6."""
    if a <= 7 and not b:
        print(f"{a + 8}")
        raise ValueError("9")
    a -= 1
    return [-k for k in a if k]
'''


def test_every_kind_of_change_is_made_and_nothing_else() -> None:
    found = TOOL.mutants_of(SOURCE.encode(), "f.py")
    changed = {m.applied(SOURCE.encode()).decode() for m in found}
    assert len(changed) == len(found)
    for text in changed:
        assert ast.dump(ast.parse(text)) != ast.dump(ast.parse(SOURCE))
    shown = [TOOL.shown(SOURCE.encode(), m.applied(SOURCE.encode())).splitlines()[1].strip("+ ") for m in found]
    assert sorted(shown) == sorted(
        [
            "def f(a: Literal[4], b=False) -> Literal[5]:",
            "if (a <= 7 or not b):",
            "if (not (a <= 7 and not b)):",
            "if (a < 7) and not b:",
            "if a <= 8 and not b:",
            "if a <= 7 and (b):",
            "pass",
            "pass",
            "a += 1",
            "a -= 2",
            "return None",
            "return [(k) for k in a if k]",
            "return [-k for k in a if (not (k))]",
        ]
    )


def folders(root: Path) -> tuple[Path, Path]:
    """Of a package `small` and of its tests."""
    package, tests = root / "src" / "ssad" / "small", root / "tests" / "small"
    package.mkdir(parents=True)
    tests.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("")
    (root / "pyproject.toml").write_text("")
    return package, tests


@pytest.mark.slow
def test_what_the_tests_miss_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (package, tests), out = folders(tmp_path), tmp_path / "out.jsonl"
    (package / "rate.py").write_text("def rate(part, whole):\n    return part / whole if whole > 0 else 0.0\n")
    test = "def test_rate():\n    assert rate(1, 4) == 0.25\n    assert rate(3, -1) == 0\n"
    (tests / "test_rate.py").write_text(f"from ssad.small.rate import rate\n\n\n{test}")
    words = ["small", "--out", str(out)]
    TOOL.main(words, root=tmp_path)
    told = capsys.readouterr().out
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert {(row["change"].splitlines()[1].partition("return ")[2], row["verdict"]) for row in rows} == {
        ("None", "failed"),
        ("(part * whole) if whole > 0 else 0.0", "failed"),
        ("part / whole if (not (whole > 0)) else 0.0", "failed"),
        ("part / whole if (whole >= 0) else 0.0", "survived"),
        ("part / whole if whole > 1 else 0.0", "survived"),
        ("part / whole if whole > 0 else 1.0", "failed"),
    }
    assert "src/ssad/small/rate.py:2 comparison\n-    return part" in told
    assert told.endswith("4 of 6 killed (66.7 %): 4 failed, 2 survived\n")
    assert (package / "rate.py").read_text().endswith("if whole > 0 else 0.0\n"), "the source is left alone"

    # again: what was lost is tried, what is known is not; after a better test, what survived is
    out.write_text("".join(json.dumps(row) + "\n" for row in rows[:-1]))
    TOOL.main(words, root=tmp_path)
    assert "to try: 1, known: 5" in capsys.readouterr().out
    with (tests / "test_rate.py").open("a") as file:
        file.write("    assert rate(1, 0) == 0\n")
    TOOL.main([*words, "--retry"], root=tmp_path)
    told = capsys.readouterr().out
    assert "to try: 2, known: 4" in told
    assert told.endswith("5 of 6 killed (83.3 %): 5 failed, 1 survived\n")


def test_tests_that_fail_by_themselves_are_no_measure(tmp_path: Path) -> None:
    package, tests = folders(tmp_path)
    (package / "one.py").write_text("ONE = 1\n")
    (tests / "test_one.py").write_text("def test_one():\n    assert False\n")
    with pytest.raises(SystemExit, match="the tests fail without any mutant"):
        TOOL.main(["small", "--out", str(tmp_path / "out")], root=tmp_path)


def test_a_module_meets_its_tests_those_of_its_package_and_those_across_packages(tmp_path: Path) -> None:
    texts = {
        "src/ssad/envs.py": "",
        "src/ssad/a/__init__.py": "",
        "src/ssad/a/b/kind.py": "",
        "src/ssad/a/b/_page.py": "",
        "src/ssad/a/c/other.py": "",
        "tests/test_envs.py": "",
        "tests/test_results.py": "",
        "tests/a/test_b.py": "",
        "tests/a/test_more.py": "",
        "tests/a/b/test_kind.py": "",
        "tests/a/b/test_kind_rows.py": "",
        "tests/a/b/test_page.py": "",
        "tests/a/b/d/test_deep.py": "",
        "tests/integration/test_1.py": "from ssad.a.b.kind import x",
        "tests/integration/test_2.py": "def test():\n    import ssad.a.c.other",
        "tests/integration/test_3.py": "from ssad.a import b",
        "tests/integration/test_4.py": "from ssad.ab import b",
        "tests/integration/test_5.py": "from ssad import envs",
        "tests/integration/test_pages.py": "",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    def tests_of(name: str) -> list[str]:
        found = TOOL.tests_of(tmp_path / "src" / "ssad" / name, tmp_path)
        return [test.removeprefix("tests/").replace("integration/test_", "") for test in found]

    rest = ["1.py", "3.py"]
    kind = ["a/b/test_kind.py", "a/b/test_kind_rows.py"]
    assert tests_of("a/b/kind.py") == [*kind, "a/test_b.py", "a/b/test_page.py", "a/b/d/test_deep.py", *rest]
    assert tests_of("a/b/_page.py")[0] == "a/b/test_page.py"
    assert sorted(tests_of("a/b/_page.py")) == sorted([*tests_of("a/b/kind.py"), "pages.py"])
    whole = tests_of("a/__init__.py")
    assert len(whole) == 6 + 3
    assert tests_of("a/c/other.py") == [*whole[:6], "1.py", "2.py", "3.py"], "no folder of its own: that of the package"
    assert tests_of("envs.py") == ["test_envs.py", "5.py"]


def test_every_module_has_tests() -> None:
    root = Path(__file__).parents[2]
    modules = sorted((root / "src" / "ssad").rglob("*.py"))
    assert [file.name for file in modules if not TOOL.tests_of(file, root)] == ["__main__.py"]


@pytest.mark.slow
@pytest.mark.parametrize("given", ["scenarios/static/physical", "metrics/rank.py"])
def test_a_package_within_a_package_and_a_single_module_can_be_measured(
    given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(__file__).parents[2]
    TOOL.main([given, "--count", "1", "--out", str(tmp_path / "out.jsonl")], root=root)
    row = json.loads((tmp_path / "out.jsonl").read_text())
    assert row["file"].startswith(f"src/ssad/{given}")
    assert " of 1 killed" in capsys.readouterr().out
