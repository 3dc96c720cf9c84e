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
