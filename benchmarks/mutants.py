"""How many small errors do the tests find? Random mutants of a package, each against the tests of its module.

    uv run python benchmarks/mutants.py core --count 200 --seed 0 --workers 2
    uv run python benchmarks/mutants.py scenarios/static/physical --count 60
    uv run python benchmarks/mutants.py metrics/rank.py

A mutant is the package with one change: `<=` for `<`, `-` for `+`, another constant, a condition the other way round,
no return value, a call or a `raise` left out. It is killed if a test fails, hangs or crashes. What survives is printed
with file, line and change: a test is missing, or the change makes no difference.

A mutant of `src/ssad/a/b/module.py` meets `tests/a/b/test_module*.py` first, then the rest of `tests/a/b`, the tests of
the package itself (`tests/a/test_b*.py`), and those of `tests/integration` that are named after the module or import
something of `ssad.a.b`.

The source is never changed in place: each worker has a copy of its own. Verdicts go to a file of JSON lines as they
come, and the same command goes on where it was stopped; `--retry` tries again what survived, after tests were added.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import difflib
import hashlib
import json
import os
import queue
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
MEMORY = 8 << 30  # bytes that a test run may allocate: a mutant may fill a list for ever

INTEGRATION = Path("tests") / "integration"

_COMPARISON: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}

# one change of one node: what kind it is, which node goes, and the text in its place ({} stands for what it was)
Change = tuple[str, ast.expr | ast.stmt, str]


@dataclass(frozen=True)
class Mutant:
    """One change of one file: the bytes from `start` to `end` of the `source` (its hash) become `text`."""

    file: str
    source: str
    line: int
    operator: str
    start: int
    end: int
    text: str

    @property
    def key(self) -> str:
        """What the file of verdicts knows it by."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:16]

    def applied(self, source: bytes) -> bytes:
        """The file with the change."""
        return source[: self.start] + self.text.encode() + source[self.end :]


def mutants_of(source: bytes, file: str) -> list[Mutant]:
    """All mutants of a Python file, in the order of its text.

    Left alone are annotations, decorators, what only a type checker runs, texts (a message may be put in other words)
    and what stands in an f-string.
    """
    begins = [0]
    for line in source.splitlines(keepends=True):
        begins.append(begins[-1] + len(line))
    name = hashlib.sha256(source).hexdigest()[:16]
    found: dict[tuple[int, int, str], Mutant] = {}
    for node in _nodes(ast.parse(source)):
        for operator, part, text in _changes(node):
            start = begins[part.lineno - 1] + part.col_offset
            end = begins[(part.end_lineno or 0) - 1] + (part.end_col_offset or 0)
            after = text.replace("{}", source[start:end].decode()) if operator == "condition" else text
            found.setdefault((start, end, after), Mutant(file, name, part.lineno, operator, start, end, after))
    return [found[place] for place in sorted(found)]


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """A tree without what is never mutated."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            if not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
                yield from _nodes(child)


def _changes(node: ast.AST) -> Iterator[Change]:
    """The changes that a node allows."""

    def replaced(**fields: object) -> str:
        other = copy.copy(node)
        for name, value in fields.items():
            setattr(other, name, value)
        return ast.unparse(other) if isinstance(node, ast.stmt) else f"({ast.unparse(other)})"

    match node:
        case ast.Compare(ops=ops):
            for k, op in enumerate(ops):
                yield "comparison", node, replaced(ops=[*ops[:k], _COMPARISON[type(op)](), *ops[k + 1 :]])
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in _ARITHMETIC:
            yield "arithmetic", node, replaced(op=_ARITHMETIC[type(op)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield "sign", node, f"({ast.unparse(operand)})"
        case ast.BoolOp(op=op):
            yield "boolean", node, replaced(op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.Constant(value=bool() as value):
            yield "constant", node, str(not value)
        case ast.Constant(value=int() | float() as value):
            yield "constant", node, repr(value + 1)
        case ast.Return(value=ast.expr() as value) if ast.unparse(value) != "None":
            yield "return value", node, "return None"
        case ast.Expr(value=ast.Call()) | ast.Raise():
            yield "left out", node, "pass"
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            yield from _negated(test)
        case ast.comprehension(ifs=tests):
            for test in tests:
                yield from _negated(test)


def _negated(test: ast.expr) -> Iterator[Change]:
    """A condition the other way round, unless another mutant does that."""
    match test:
        case ast.UnaryOp(op=ast.Not()) | ast.Compare(ops=[ast.Eq() | ast.NotEq() | ast.Is() | ast.IsNot()]):
            return
        case ast.Compare(ops=[ast.In() | ast.NotIn()]):
            return
    yield "condition", test, "(not ({}))"


def drawn(package: Path, root: Path, count: int, seed: int) -> list[Mutant]:
    """`count` mutants of a package (or one file) at random, the same for the same source and seed."""
    files = [package] if package.is_file() else sorted(package.rglob("*.py"))
    every = [
        mutant
        for file in files
        if "kernels" not in file.parts  # Warp compiles those: minutes a mutant
        for mutant in mutants_of(file.read_bytes(), file.relative_to(root).as_posix())
    ]
    return random.Random(seed).sample(every, min(count, len(every)))


@cache
def imported_modules(test: Path) -> frozenset[str]:
    """Return the dotted names that a test file imports, those of `from package import name` with and without `name`."""
    names = set[str]()
    for node in ast.walk(ast.parse(test.read_bytes())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def tests_of(file: Path, root: Path) -> tuple[str, ...]:
    """Return the test files for a module under `src/ssad`, the nearest first, as paths relative to `root`.

    A package without tests at the mirrored place has those of the package that holds it.
    """
    module = file.relative_to(root / "src" / "ssad")
    package = module.parent
    stem = package.name if module.stem == "__init__" else module.stem.strip("_")
    mirrored: list[Path] = []
    while not mirrored:
        folder = root / "tests" / package
        if package == Path():  # a module beside the packages, such as envs.py: tests/ itself holds more than its tests
            mirrored = sorted(folder.glob(f"test_{stem}*.py"))
            break
        mirrored = [*sorted(folder.rglob("test_*.py")), *sorted(folder.parent.glob(f"test_{package.name}*.py"))]
        if not mirrored:
            package = package.parent
    mirrored.sort(key=lambda path: (not path.name.startswith(f"test_{stem}"), len(path.parts)))
    name = ".".join(("ssad", *(module.with_suffix("").parts if package == Path() else package.parts)))
    crossing = [
        path
        for path in sorted((root / INTEGRATION).glob("test_*.py"))
        if path.name.startswith(f"test_{stem}")
        or any(other == name or other.startswith(f"{name}.") for other in imported_modules(path))
    ]
    return tuple(path.relative_to(root).as_posix() for path in (*mirrored, *crossing))


def seconds_by_file(report: Path, folder: Path) -> Counter[str]:
    """Return the seconds of each test file from a JUnit report of pytest in `folder`."""
    seconds = Counter[str]()
    for case in ElementTree.parse(report).iter("testcase"):
        parts = case.get("classname", "").split(".")
        while parts and not folder.joinpath(*parts).with_suffix(".py").is_file():
            parts.pop()
        seconds["/".join(parts) + ".py"] += float(case.get("time", 0))
    return seconds


def _top_level_names(root: Path) -> list[str]:
    """Files and folders of the checkout that git knows or would add; without git, all but environments and caches."""
    command = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    with contextlib.suppress(OSError):
        listing = subprocess.run(command, capture_output=True, text=True, check=False)
        if listing.returncode == 0 and listing.stdout:
            return sorted({path.split("/")[0] for path in listing.stdout.split("\0") if path})
    return sorted(path.name for path in root.iterdir() if path.name != ".venv" and not path.name.endswith("_cache"))


@dataclass(frozen=True)
class Copy:
    """A copy of the source in `folder`, in which one mutant at a time is tested."""

    folder: Path
    root: Path

    def make(self) -> None:
        """Copy what the tests read."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name in _top_level_names(self.root):
            if (self.root / name).is_dir():
                shutil.copytree(self.root / name, self.folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif (self.root / name).is_file():
                shutil.copy2(self.root / name, self.folder / name)

    def run(self, tests: Sequence[str], *, timeout: float, **environment: str) -> tuple[str, float, str]:
        """Return ("passed", "failed" or "timed out", seconds, output) of `tests`, files or words for pytest."""
        data = self.root / os.environ.get("SSAD_DATA", "../shared/data")
        environment |= {
            "PYTHONPATH": str(self.folder / "src"),
            "SSAD_DATA": str(data.resolve()),
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self.folder / ".hypothesis"),
        }
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-x", "-q", *tests],
            cwd=self.folder,
            env=os.environ | environment,
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        if hasattr(resource, "prlimit"):
            resource.prlimit(process.pid, resource.RLIMIT_DATA, (MEMORY, MEMORY))
        output, verdict = "", "timed out"
        with contextlib.suppress(subprocess.TimeoutExpired):
            output, _ = process.communicate(timeout=timeout)
            verdict = "failed" if process.returncode else "passed"
        with contextlib.suppress(ProcessLookupError):  # and what the tests have started
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return verdict, time.monotonic() - began, output

    def run_mutant(self, mutant: Mutant, tests: Sequence[str], *, timeout: float) -> tuple[str, float, str]:
        """Verdict and seconds of the tests with this one change, and the lines that it changes."""
        target = self.folder / mutant.file
        before, times = target.read_bytes(), target.stat()
        after = mutant.applied(before)
        # Python knows a compiled file by second and size of its source, which a mutant may have in common with it
        for compiled in (target.parent / "__pycache__").glob(f"{target.stem}.*.pyc"):
            compiled.unlink()
        target.write_bytes(after)
        try:
            verdict, seconds, _ = self.run(tests, timeout=timeout, PYTHONDONTWRITEBYTECODE="1")
        finally:
            target.write_bytes(before)
            os.utime(target, ns=(times.st_atime_ns, times.st_mtime_ns))
        return verdict, seconds, shown(before, after)


def shown(before: bytes, after: bytes) -> str:
    """The lines that differ."""
    lines = [text.decode().splitlines() for text in (before, after)]
    told = list(difflib.unified_diff(*lines, lineterm="", n=0))[2:]
    return "\n".join(line for line in told if not line.startswith("@@"))


def measure(
    mutants: Sequence[Mutant],
    out: Path,
    *,
    root: Path,
    tests: Sequence[str] = (),
    workers: int = 1,
    retry: bool = False,
) -> list[dict[str, Any]]:
    """The verdicts of all mutants, in the order given; those that `out` does not hold yet are tried and added to it.

    Each meets `tests` or, without any, the tests of its module.
    """
    known: dict[str, dict[str, Any]] = {}
    if out.is_file():
        known = {row["key"]: row for row in map(json.loads, out.read_text().splitlines())}
    todo = [m for m in mutants if m.key not in known or (retry and known[m.key]["verdict"] == "survived")]
    if not todo:
        return [known[mutant.key] for mutant in mutants]
    wanted = {m.file: tuple(tests) or tests_of(root / m.file, root) for m in todo}
    if lonely := sorted(file for file, files in wanted.items() if not files):
        raise SystemExit(f"error: no tests for {', '.join(lonely)}")
    lock, free, tried = threading.Lock(), queue.SimpleQueue[Copy](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        first = Copy(Path(folder) / "0", root)
        first.make()
        report = Path(folder) / "report.xml"
        every = list(dict.fromkeys(test for files in wanted.values() for test in files))
        verdict, seconds, output = first.run([f"--junitxml={report}", *every], timeout=3600)
        if verdict != "passed":
            raise SystemExit(f"{output[-3000:]}\nerror: the tests fail without any mutant")
        print(f"{seconds:.1f} s without a mutant; to try: {len(todo)}, known: {len(mutants) - len(todo)}", flush=True)
        took = seconds_by_file(report, first.folder)
        rest = seconds - took.total()  # start and imports
        free.put(first)
        for k in range(1, workers):  # with the compiled files of the first
            shutil.copytree(first.folder, Path(folder) / str(k))
            free.put(Copy(Path(folder) / str(k), root))

        def work(mutant: Mutant) -> None:
            place = free.get()
            files = wanted[mutant.file]
            usual = seconds if tests else rest + sum(took[test] for test in files)
            verdict, duration, lines = place.run_mutant(mutant, files, timeout=30 + 4 * usual)
            free.put(place)
            told = {"passed": "survived"}.get(verdict, verdict)
            row = {"key": mutant.key, "verdict": told, "seconds": round(duration, 1), "change": lines}
            with lock, out.open("a") as file:
                known[mutant.key] = asdict(mutant) | row
                file.write(json.dumps(known[mutant.key]) + "\n")
                tried[told] += 1
                print(f"{tried.total()}/{len(todo)} {told}: {mutant.file}:{mutant.line} {mutant.operator}", flush=True)

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(work, todo))
    return [known[mutant.key] for mutant in mutants]


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """What survived, then the counts."""
    survived = [row for row in rows if row["verdict"] == "survived"]
    survived.sort(key=lambda row: (row["file"], row["start"]))
    lines = [f"{row['file']}:{row['line']} {row['operator']}\n{row['change']}\n" for row in survived]
    counts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(r["verdict"] for r in rows).most_common())
    killed = len(rows) - len(survived)
    return "\n".join([*lines, f"{killed} of {len(rows)} killed ({100 * killed / max(len(rows), 1):.1f} %): {counts}"])


def main(words: Sequence[str] | None = None, *, root: Path = ROOT) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("package", help="folder or file under src/ssad, such as core or scenarios/static/physical")
    parser.add_argument("--count", type=int, default=200, help="how many mutants are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--workers", type=int, default=1, help="how many are tried at a time")
    parser.add_argument("--tests", nargs="+", help="test files or folders, instead of those of each module")
    parser.add_argument("--out", type=Path, help="file of verdicts (default: runs/mutants/PACKAGE.jsonl)")
    parser.add_argument("--retry", action="store_true", help="try again what survived")
    given = parser.parse_args(words)
    package = root / "src" / "ssad" / given.package
    for path in (package, *(root / test for test in given.tests or ())):
        if not path.exists():
            parser.error(f"{path}: not there")
    out = given.out or root / "runs" / "mutants" / f"{given.package.replace('/', '-')}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    mutants = drawn(package, root, given.count, given.seed)
    print(summary(measure(mutants, out, root=root, tests=given.tests or (), workers=given.workers, retry=given.retry)))


if __name__ == "__main__":
    main()
