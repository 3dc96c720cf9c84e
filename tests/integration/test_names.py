"""Names and docstrings of the source: no pronouns for things, one meaning a class name, the glossary's words."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCE = {path: ast.parse(path.read_text()) for path in sorted((ROOT / "src" / "ssad").rglob("*.py"))}
# Pronouns, question words and bare participles: they say that something is there, not what it is.
PRONOUN = re.compile(
    "found|one|own|told|seen|known|least|most|others?|another|them|they|these|those|this|that|its?|such|same|each|every|"
    "both|either|neither|(some|no|every|any)(thing|body|one)|some|things?|who|whom|whose|which|what|where|when|how|"
    "here|there|given|taken|made|kept|had|being|done|gone|held|met|asked|shown|drawn|said|rest|mine|ours|us|we|he|she|"
    "his|her|him"
)
SHARE_OF_PRONOUNS = 0.005
MIN_MEAN_LENGTH = 6.5
QUESTION_WORDS = ("What", "Who", "Whom", "Whose", "How", "Whether", "Where", "When", "Which", "Why")
SHARE_OF_QUESTIONS = 0.01
# Words that the glossary of docs/explanation/concepts.md replaces.
REPLACED_CLASSES = frozenset({"Thing", "Looks", "Print", "Order", "Clips", "Watched", "Watcher", "Seen", "Told"})


def bound_names(tree: ast.Module) -> Iterator[tuple[str, int, bool]]:
    """Names that a module binds, with their lines, and whether each is a variable or a parameter."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(ctx=ast.Store()):
                yield node.id, node.lineno, True
            case ast.arg() if node.arg not in ("self", "cls"):
                yield node.arg, node.lineno, True
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr, node.lineno, False
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name, node.lineno, False


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Docstrings of a module with the lines of what they describe."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield text, getattr(node, "lineno", 1)


def is_pronoun(name: str) -> bool:
    return PRONOUN.fullmatch(name.strip("_").lower()) is not None


def is_kernel(path: Path) -> bool:
    return "kernels" in path.parts


def test_few_names_are_pronouns() -> None:
    names = [(path, *name) for path, tree in SOURCE.items() for name in bound_names(tree)]
    pronouns = [f"{path.relative_to(ROOT)}:{line} {name}" for path, name, line, _ in names if is_pronoun(name)]
    assert len(pronouns) <= SHARE_OF_PRONOUNS * len(names), "\n".join(pronouns)


def test_local_names_are_words() -> None:
    lengths = [len(name) for tree in SOURCE.values() for name, _, is_local in bound_names(tree) if is_local]
    assert sum(lengths) / len(lengths) >= MIN_MEAN_LENGTH


def test_a_public_class_name_has_one_meaning() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for path, tree in SOURCE.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and not is_kernel(path):
                places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: where for name, where in places.items() if len(where) > 1} == {}
    assert sorted(REPLACED_CLASSES & set(places)) == []


def test_docstrings_begin_with_the_thing_or_the_action() -> None:
    texts = [(path, *docstring) for path, tree in SOURCE.items() for docstring in docstrings(tree)]
    questions = [
        f"{path.relative_to(ROOT)}:{line} {text.splitlines()[0]}"
        for path, text, line in texts
        if text.split()[0] in QUESTION_WORDS
    ]
    assert len(questions) < SHARE_OF_QUESTIONS * len(texts), "\n".join(questions)


def test_the_measure_finds_what_it_bans() -> None:
    tree = ast.parse('"""What it is."""\ndef f(told, x):\n    found = 1\n    self.seen, y = x\nclass Who: pass')
    names = [name for name, _, _ in bound_names(tree) if is_pronoun(name)]
    assert sorted(names) == ["Who", "found", "seen", "told"]
    assert [text.split()[0] for text, _ in docstrings(tree)] == ["What"]
