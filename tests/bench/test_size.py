"""The engine stays small, and holds suites and kinds: what a kind computes stands in the room that it is about."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path

import ssad

PACKAGE = Path(ssad.__file__).resolve().parent
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(text: str) -> int:
    """Lines of Python that are neither blank nor a comment nor part of a docstring."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def test_what_counts_as_code() -> None:
    text = (
        '"""Doc."""\n\n# why\nx = 1  # how\n\n\ndef f():\n    """Doc\n\n    more."""\n    return [\n        x,\n    ]\n'
    )
    assert code_lines(text) == 5


def test_engine_and_jobs_have_under_2500_lines_of_code() -> None:
    files = [path for room in ("bench", "jobs") for path in (PACKAGE / room).rglob("*.py")]
    assert len(files) > 15
    assert sum(code_lines(path.read_text()) for path in files) < 2500


def test_a_kind_is_a_file_of_300_lines_at_the_most() -> None:
    long = {
        p.name: n for p in (PACKAGE / "bench" / "kinds").glob("*.py") if (n := len(p.read_text().splitlines())) > 300
    }
    assert not long


def test_bench_holds_the_engine_and_its_kinds_alone() -> None:
    engine = {"__init__", "kind", "suite", "run", "replay"}
    assert {path.stem for path in (PACKAGE / "bench").glob("*.py")} == engine
