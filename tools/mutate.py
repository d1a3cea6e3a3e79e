"""Do the tests notice? Breaks the code at random, one small change at a time, and runs the tests
that should fail.

    python tools/mutate.py --count 300 --seed 1 --jobs 2 [--folders fit solve] [--without-kernels]
    [--again]

A mutant is one changed expression or statement: a comparison or a sign turned, a number changed, a
condition negated, arguments exchanged, a statement or a returned value left out; docstrings,
annotations, decorators and error messages stay. First all tests run once and it is noted which of
them execute which line (`who_executes.py`). A mutant then gets the tests that execute its
statement, up to --seconds of them, the likely and the quick ones first; one outside functions those
that execute anything of its file or of a file that imports it. It is killed when a test fails or
takes far too long, and survives at once where no test executes it. Tests run in copies of the tree,
with compiled kernels of their own. Results are written after each mutant, and a run that was
stopped goes on where it was; --again tries those that survived once more.
"""

import argparse
import ast
import copy
import json
import multiprocessing
import os
import queue
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path("src/habitus")
FOLDERS = ("fit", "residuals", "solve", "markers")  # under src/habitus: their code is broken
BELOW = (
    "assets",
    "body",
    "fuzz",
    "helpers",
    "kernels",
    "mesh",
    "observe",
    "parallel",
    "render",
)  # tests that use none
LONGEST_S = 40.0  # a longer test is not asked
SHARED_S = 0.5  # tests that share a fixture which takes longer stay together

PROCESSES = multiprocessing.get_context(
    "forkserver"
)  # pytest and what takes long to import are imported once
PROCESSES.set_forkserver_preload(
    ["pytest", "torch", "numba", "scipy.spatial", "hypothesis", "beartype", "rich.console"]
)

PAIRS = (
    (ast.Add, ast.Sub),
    (ast.Mult, ast.Div),
    (ast.BitAnd, ast.BitOr),
    (ast.Lt, ast.GtE),
    (ast.Gt, ast.LtE),
    (ast.Eq, ast.NotEq),
    (ast.Is, ast.IsNot),
    (ast.In, ast.NotIn),
    (ast.And, ast.Or),
)
SAME_EITHER_WAY = ("min", "max", "minimum", "maximum", "hypot")
TURNED = (
    dict(PAIRS)
    | {b: a for a, b in PAIRS}
    | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv}
)


@dataclass
class Mutant:
    """One change of one file, and what became of it: killed, timeout, survived, or empty while it
    waits.
    """

    file: str
    line: int
    column: int
    operator: str
    source: str
    mutated: str
    result: str = ""
    test: str = ""
    seconds: float = 0.0


class Trial(NamedTuple):
    """A mutant, the whole text of its file, and the lines of its statement; none outside
    functions.
    """

    mutant: Mutant
    text: str
    lines: range | None


def mutants(path: Path) -> Iterator[Trial]:
    """Every mutant of a file."""
    text = path.read_text()
    tree = ast.parse(text)
    statements = _statements(tree)
    for node in _nodes(tree):
        for operator, changed in _changes(node):
            line = text.splitlines()[node.lineno - 1].strip()
            name = str(path.relative_to(ROOT))
            mutant = Mutant(
                name, node.lineno, node.col_offset, operator, line, " ".join(changed.split())
            )
            yield Trial(mutant, _splice(text, node, changed), statements.get(node))


def _statements(tree: ast.Module) -> dict[ast.AST, range]:
    """Lines of the innermost statement around each node inside a function; of a compound one those
    before its body.
    """
    inside: dict[ast.AST, range] = {}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for outer in (
        statement for function in functions for statement in function.body
    ):  # outer functions come first
        for statement in (node for node in ast.walk(outer) if isinstance(node, ast.stmt)):
            body = getattr(statement, "body", None)
            lines = range(statement.lineno, body[0].lineno if body else statement.end_lineno + 1)
            inside |= dict.fromkeys(ast.walk(statement), lines)
    return inside


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that are code: no imports, annotations, decorators, strings, assertions or error
    messages.
    """
    if isinstance(node, ast.Import | ast.ImportFrom | ast.Raise | ast.Assert | ast.JoinedStr):
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if (
            name in ("annotation", "returns", "decorator_list", "bases")
            or getattr(node, "arg", "") == "axis"
        ):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _nodes(child)


def _changes(node: ast.AST) -> Iterator[tuple[str, str]]:
    """(operator, new text) of each way to break this node."""

    def expression(operator: str, **fields) -> tuple[str, str]:
        other = copy.copy(node)
        vars(other).update(fields)
        return operator, f"({ast.unparse(other)})"

    match node:
        case ast.BinOp() | ast.BoolOp() if type(node.op) in TURNED:
            yield expression("operator turned", op=TURNED[type(node.op)]())
        case ast.Compare():
            yield expression("comparison turned", ops=[TURNED[type(node.ops[0])](), *node.ops[1:]])
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield "unary left out", f"({ast.unparse(node.operand)})"
        case ast.IfExp():
            yield expression("branches exchanged", body=node.orelse, orelse=node.body)
        case ast.Constant(value=bool()):
            yield "constant changed", str(not node.value)
        case ast.Constant(value=int() | float()):
            yield (
                "constant changed",
                repr(node.value + 1 if isinstance(node.value, int) else 2 * node.value or 1.0),
            )
        case ast.Call(args=[first, second, *others]) if not isinstance(
            first, ast.Starred | ast.GeneratorExp
        ):
            told_apart = not isinstance(second, ast.Starred) and ast.dump(first) != ast.dump(second)
            if told_apart and ast.unparse(node.func).rpartition(".")[2] not in SAME_EITHER_WAY:
                yield expression("arguments exchanged", args=[second, first, *others])
        case (
            ast.AugAssign()
            | ast.Expr(value=ast.Call())
            | ast.Assign(targets=[ast.Subscript() | ast.Attribute()])
        ):
            yield "statement left out", "pass"
        case ast.Return(value=ast.AST() as value) if not (
            isinstance(value, ast.Constant) and value.value is None
        ):
            yield "returns nothing", "return None"
        case ast.Continue() | ast.Break():
            yield "statement left out", "pass"
        case ast.If(test=test) if not isinstance(
            test, ast.UnaryOp | ast.Compare
        ):  # these are turned by themselves
            yield "condition negated", f"(not ({ast.unparse(test)}))"


def _splice(text: str, node: ast.AST, changed: str) -> str:
    """The text with a node's own piece replaced; of an ``if`` that is its condition."""
    piece = node.test if isinstance(node, ast.If) else node
    lines = text.encode().splitlines(keepends=True)
    first = piece.lineno - 1
    last = piece.end_lineno - 1
    joined = (
        lines[first][: piece.col_offset] + changed.encode() + lines[last][piece.end_col_offset :]
    )
    return b"".join([*lines[:first], joined, *lines[last + 1 :]]).decode()


def find(folders: list[str], with_kernels: bool) -> list[Trial]:
    """All mutants of these folders."""
    found = []
    for folder in folders:
        for path in sorted((ROOT / PACKAGE / folder).rglob("*.py")):
            if with_kernels or "from habitus.kernels.jit import" not in path.read_text():
                found += mutants(path)
    return found


@dataclass(frozen=True)
class Record:
    """What `who_executes.py` wrote: seconds by name, fixtures by test, by file and line the names
    that execute it.
    """

    names: list[str]
    seconds: list[float]
    fixtures: dict[str, list[str]]
    lines: dict[str, dict[str, list[int]]]

    def tests_of(self, trial: Trial, budget: float) -> list[str]:
        """Tests that may see a mutant, in the order in which they are to run, as many as there is
        time for.
        """
        file = Path(trial.mutant.file)
        chosen = []
        left = budget
        for fixture, tests in sorted(
            self._groups(self._executing(trial)), key=lambda each: self._rank(file, *each)
        ):
            left -= self._cost(fixture)
            for test in sorted(tests, key=lambda test: self._cost([test])):
                left -= self._cost([test])
                chosen += [test] if left > 0 else []
        return chosen

    def _executing(self, trial: Trial) -> set[str]:
        files = (
            [trial.mutant.file]
            if trial.lines
            else [trial.mutant.file, *_importing(trial.mutant.file)]
        )
        lines = [str(line) for line in trial.lines] if trial.lines else None
        seen = [self.lines.get(file, {}) for file in files]
        names = {self.names[k] for by in seen for line in lines or by for k in by.get(line, ())}
        return {
            test
            for test, fixtures in self.fixtures.items()
            if test in names or not names.isdisjoint(fixtures)
        }

    def _groups(self, tests: set[str]) -> list[tuple[list[str], list[str]]]:
        """(long fixtures, tests that share them) of tests that are not too long; other tests are by
        themselves.
        """
        together = defaultdict(list)
        for test in sorted(tests):
            if self._cost([test, *self.fixtures[test]]) <= LONGEST_S:
                long = [name for name in self.fixtures[test] if self._cost([name]) > SHARED_S]
                together[tuple(long) or test].append(test)
        return [
            ([] if isinstance(key, str) else list(key), tests) for key, tests in together.items()
        ]

    def _rank(self, file: Path, fixtures: list[str], tests: list[str]) -> tuple[bool, bool, float]:
        """Tests named after the file come first, then those of its room, the quick ones before the
        slow ones.
        """
        path = Path(tests[0].partition("::")[0])
        room = file.relative_to(PACKAGE).parts[0]
        quickest = min(self._cost([test]) for test in tests)
        return file.stem not in path.stem, room not in path.parts, self._cost(fixtures) + quickest

    def _cost(self, names: list[str]) -> float:
        return sum(self._seconds.get(name, 0.0) for name in names)

    @cached_property
    def _seconds(self) -> dict[str, float]:
        return dict(zip(self.names, self.seconds, strict=True))


def _importing(file: str) -> list[str]:
    """Files under src that import this one."""
    module = ".".join(Path(file).with_suffix("").parts[1:])
    found = []
    for path in (ROOT / PACKAGE).rglob("*.py"):
        imports = [
            node
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom)
        ]
        if any(
            module in (node.module, f"{node.module}.{name.name}")
            for node in imports
            for name in node.names
        ):
            found.append(str(path.relative_to(ROOT)))
    return found


class Worker:
    """A copy of the tree in which mutants are tried, one at a time."""

    def __init__(self, folder: Path):
        self.tree = folder / "tree"
        for name in ("src", "tests", "examples", "docs", "benchmarks", "tools"):
            shutil.copytree(
                ROOT / name, self.tree / name
            )  # keeps times: kernels that are compiled stay so
        shutil.copy2(ROOT / "pyproject.toml", self.tree)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")

    def record(self, out: Path) -> None:
        """Run the tests of all rooms that may use the code which is broken, and note what they
        execute.
        """
        rooms = [
            path
            for path in sorted((ROOT / "tests").iterdir())
            if path.is_dir() and path.name not in BELOW
        ]
        tests = [
            str(path.relative_to(ROOT))
            for path in (*rooms, *sorted((ROOT / "tests").glob("test_*.py")))
        ]
        folders = [str(PACKAGE / folder) for folder in FOLDERS]
        result, test = self.run(
            ["--record", str(out), "--record-of", *folders, "--", *tests], 3600.0
        )
        if result != "survived":
            out.unlink(missing_ok=True)  # it holds the tests before the failure only
            sys.exit(f"the tests fail as they are, {test}: mend that first")

    def run(self, arguments: list[str], timeout: float) -> tuple[str, str]:
        """("survived" | "killed" | "timeout", the test that failed)."""
        process = PROCESSES.Process(target=_pytest, args=(self.tree, arguments))
        process.start()
        process.join(timeout)
        if process.is_alive():
            os.killpg(process.pid, signal.SIGKILL)
            process.join()
            return "timeout", ""
        said = _said(self.tree).read_text().strip()
        if process.exitcode in (0, 5):
            return "survived", ""
        failed = [
            line.split(" - ")[0]
            for line in said.splitlines()
            if line.startswith(("FAILED ", "ERROR "))
        ]
        if process.exitcode not in (1, 2) or not failed:  # pytest itself failed: no verdict
            raise RuntimeError(f"pytest ended with {process.exitcode}: {said[-300:]}")
        return "killed", failed[0]

    def attempt(self, trial: Trial, tests: list[str], timeout: float) -> None:
        """Write the mutant, run its tests, put the file and the compiled kernels back."""
        mutant, text, _ = trial
        if not tests:
            mutant.result = "survived"
            mutant.test = "no test executes it"
            return
        path = self.tree / mutant.file
        chosen = self.tree.parent / "chosen.json"
        began = time.perf_counter()
        path.write_text(text)
        chosen.write_text(json.dumps(tests))
        files = dict.fromkeys(test.partition("::")[0] for test in tests)
        mutant.result, mutant.test = self.run(["--chosen", str(chosen), "--", *files], timeout)
        mutant.seconds = round(time.perf_counter() - began, 1)
        shutil.copy2(ROOT / mutant.file, path)
        if "from habitus.kernels.jit import" in text:
            for kept in (ROOT / "src").rglob("*.nb[ic]"):
                shutil.copy2(kept, self.tree / kept.relative_to(ROOT))


def _said(tree: Path) -> Path:
    return tree.parent / "said.txt"


def _pytest(tree: Path, arguments: list[str]) -> None:
    """Run pytest in a copy of the tree, in a process that has imported what is no part of it."""
    os.setsid()
    os.chdir(tree)
    with _said(tree).open("w") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    paths = [str(tree / name) for name in ("src", "tools")]
    os.environ |= {
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_WAIT_POLICY": "passive",
    }
    sys.path[:0], sys.dont_write_bytecode = paths, True
    sys.exit(
        pytest.main(
            ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-p", "who_executes", *arguments]
        )
    )


def main() -> None:
    """Draw mutants, try them, tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        help="of tests, as they ran at first, that a mutant gets",
    )
    parser.add_argument("--folders", nargs="+", choices=FOLDERS, default=list(FOLDERS))
    parser.add_argument("--again", action="store_true", help="try those that survived once more")
    parser.add_argument(
        "--without-kernels",
        action="store_true",
        help="no files with compiled code, which takes long",
    )
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutants.json")
    options = parser.parse_args()
    every = find(options.folders, not options.without_kernels)
    random.Random(options.seed).shuffle(every)  # a larger count goes on where a smaller one ended
    drawn = every[: options.count]
    print(f"{len(drawn)} of {len(every)} mutants")
    written = json.loads(options.out.read_text()) if options.out.exists() else []
    known = {tuple(entry.values())[:6]: entry for entry in written}
    for mutant, *_ in drawn:
        vars(mutant).update(known.get(tuple(vars(mutant).values())[:6], {}))
        mutant.result = "" if options.again and mutant.result == "survived" else mutant.result
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        _try_all(drawn, options, Path(folder))
    survivors = [trial.mutant for trial in drawn if trial.mutant.result == "survived"]
    print("\nsurvived:", *map(_row, survivors), sep="\n  ")
    print(
        f"{len(drawn) - len(survivors)} of {len(drawn)} killed "
        f"({1 - len(survivors) / max(len(drawn), 1):.0%})"
    )


def _try_all(drawn: list[Trial], options: argparse.Namespace, folder: Path) -> None:
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    workers = [Worker(folder / str(k)) for k in range(options.jobs)]
    record = _record(workers[0], options.out.with_name("who_executes.json"))
    for worker in workers:
        idle.put(worker)

    def attempt(trial: Trial) -> Mutant:
        worker = idle.get()
        try:
            worker.attempt(
                trial, record.tests_of(trial, options.seconds), 120.0 + 4.0 * options.seconds
            )
        finally:
            idle.put(worker)
        return trial.mutant

    with ThreadPoolExecutor(options.jobs) as pool:
        for future in as_completed(
            [pool.submit(attempt, each) for each in drawn if not each.mutant.result]
        ):
            print(
                f"{future.result().result:9}{future.result().seconds:6.0f} s  "
                f"{_row(future.result())}",
                flush=True,
            )
            _keep(options.out, [trial.mutant for trial in drawn])


def _record(worker: Worker, path: Path) -> Record:
    """What tests execute, noted anew where code or tests are younger than the record."""
    youngest = max(
        file.stat().st_mtime for name in ("src", "tests") for file in (ROOT / name).rglob("*.py")
    )
    if not path.exists() or path.stat().st_mtime < youngest:
        path.parent.mkdir(parents=True, exist_ok=True)
        worker.record(path)
    return Record(**json.loads(path.read_text()))


def _keep(path: Path, drawn: list[Mutant]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".part")
    whole.write_text(json.dumps([asdict(mutant) for mutant in drawn], indent=1))
    whole.replace(path)


def _row(mutant: Mutant) -> str:
    return f"{mutant.file}:{mutant.line}  {mutant.operator}: {mutant.source}  ->  {mutant.mutated}"


if __name__ == "__main__":
    main()
