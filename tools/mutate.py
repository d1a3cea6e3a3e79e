"""Do the tests notice? Breaks the code at random, one small change at a time, and runs the tests that should fail.

    python tools/mutate.py --count 300 --seed 1 --jobs 2 [--folders fit solve] [--without-kernels] [--list]

A mutant is one changed expression or statement: a comparison or a sign turned, a number changed, a condition negated,
arguments exchanged, a statement or a returned value left out; docstrings, annotations, decorators and error messages
stay. Tests run in copies of the tree, each with compiled kernels of its own. A mutant is killed when a test fails or
--timeout passes. Results are written after each mutant, and a run that was stopped goes on where it was.
"""

import argparse
import ast
import copy
import json
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path("src/habitus")
MOSH = ("tests/fit", "tests/jobs/test_mosh.py")
TESTS: dict[str, tuple[str, ...]] = {  # folder under src/habitus: what is run, after the tests of the file's own name
    "fit": MOSH,
    "residuals": ("tests/residuals", *MOSH),
    "solve": ("tests/solve", *MOSH),
    "markers": ("tests/markers", "tests/io/layouts", "tests/jobs/test_subjects.py", "tests/jobs/test_mosh.py"),
}

PAIRS = (
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr), (ast.Lt, ast.GtE), (ast.Gt, ast.LtE),
    (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn), (ast.And, ast.Or),
)  # fmt: skip
SAME_EITHER_WAY = ("min", "max", "minimum", "maximum", "hypot")
TURNED = dict(PAIRS) | {b: a for a, b in PAIRS} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv}


@dataclass
class Mutant:
    """One change of one file, and what became of it: killed, timeout, survived, or empty while it waits."""

    file: str
    line: int
    column: int
    operator: str
    source: str
    mutated: str
    result: str = ""
    test: str = ""
    seconds: float = 0.0


def mutants(path: Path) -> Iterator[tuple[Mutant, str]]:
    """Every mutant of a file, with the whole text it gives."""
    text = path.read_text()
    for node in _nodes(ast.parse(text)):
        for operator, changed in _changes(node):
            whole = _splice(text, node, changed)
            line = text.splitlines()[node.lineno - 1].strip()
            name = str(path.relative_to(ROOT))
            yield Mutant(name, node.lineno, node.col_offset, operator, line, " ".join(changed.split())), whole


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that are code: no imports, annotations, decorators, strings, assertions or error messages."""
    if isinstance(node, ast.Import | ast.ImportFrom | ast.Raise | ast.Assert | ast.JoinedStr):
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases") or getattr(node, "arg", "") == "axis":
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
            yield "constant changed", repr(node.value + 1 if isinstance(node.value, int) else 2 * node.value or 1.0)
        case ast.Call(args=[first, second, *others]) if not isinstance(first, ast.Starred | ast.GeneratorExp):
            told_apart = not isinstance(second, ast.Starred) and ast.dump(first) != ast.dump(second)
            if told_apart and ast.unparse(node.func).rpartition(".")[2] not in SAME_EITHER_WAY:
                yield expression("arguments exchanged", args=[second, first, *others])
        case ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield "statement left out", "pass"
        case ast.Return(value=ast.AST() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield "returns nothing", "return None"
        case ast.Continue() | ast.Break():
            yield "statement left out", "pass"
        case ast.If(test=test) if not isinstance(test, ast.UnaryOp | ast.Compare):  # these are turned by themselves
            yield "condition negated", f"(not ({ast.unparse(test)}))"


def _splice(text: str, node: ast.AST, changed: str) -> str:
    """The text with a node's own piece replaced; of an ``if`` that is its condition."""
    piece = node.test if isinstance(node, ast.If) else node
    lines = text.encode().splitlines(keepends=True)
    first, last = piece.lineno - 1, piece.end_lineno - 1
    joined = lines[first][: piece.col_offset] + changed.encode() + lines[last][piece.end_col_offset :]
    return b"".join([*lines[:first], joined, *lines[last + 1 :]]).decode()


def find(folders: list[str], with_kernels: bool) -> list[tuple[Mutant, str]]:
    """All mutants of these folders."""
    found = []
    for folder in folders:
        for path in sorted((ROOT / PACKAGE / folder).rglob("*.py")):
            if with_kernels or "from habitus.kernels.jit import" not in path.read_text():
                found += mutants(path)
    return found


def tests_of(file: str) -> list[str]:
    """Tests that a file answers to: those of its own name first, then those of its folder."""
    inside = Path(file).relative_to(PACKAGE)
    own = sorted((ROOT / "tests" / inside.parent).glob(f"test_{inside.stem}*.py"))
    return list(dict.fromkeys([*(str(p.relative_to(ROOT)) for p in own), *TESTS[inside.parts[0]]]))


class Worker:
    """A copy of the tree in which mutants are tried, one at a time."""

    def __init__(self, folder: Path):
        self.tree = folder / "tree"
        for name in ("src", "tests", "examples", "docs", "benchmarks", "tools"):
            shutil.copytree(ROOT / name, self.tree / name)  # keeps times: kernels that are compiled stay so
        shutil.copy2(ROOT / "pyproject.toml", self.tree)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")

    def run(self, tests: list[str], timeout: float) -> tuple[str, str]:
        """("survived" | "killed" | "timeout", the test that failed)."""
        own = {"PYTHONDONTWRITEBYTECODE": "1", "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(self.tree / "src")}
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", *tests]
        process = subprocess.Popen(
            command, cwd=self.tree, env=os.environ | own, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            said = process.communicate(timeout=timeout)[0]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return "timeout", ""
        if process.returncode > 2 or process.returncode < 0:  # pytest itself failed, or found no test: no verdict
            raise RuntimeError(f"pytest ended with {process.returncode}: {said.strip()[-300:]}")
        failed = [line.split(" - ")[0] for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return "survived" if process.returncode == 0 else "killed", (failed or [said.strip()[-200:]])[0]

    def attempt(self, mutant: Mutant, text: str, timeout: float) -> None:
        """Write the mutant, run its tests, put the file and the compiled kernels back."""
        path, began = self.tree / mutant.file, time.perf_counter()
        path.write_text(text)
        mutant.result, mutant.test = self.run(tests_of(mutant.file), timeout)
        mutant.seconds = round(time.perf_counter() - began, 1)
        shutil.copy2(ROOT / mutant.file, path)
        if "from habitus.kernels.jit import" in text:
            for kept in (ROOT / "src").rglob("*.nb[ic]"):
                shutil.copy2(kept, self.tree / kept.relative_to(ROOT))


def main() -> None:
    """Draw mutants, try them, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds a mutant's tests may take")
    parser.add_argument("--folders", nargs="+", choices=TESTS, default=list(TESTS))
    parser.add_argument("--without-kernels", action="store_true", help="no files with compiled code, which takes long")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutants.json")
    options = parser.parse_args()
    every = find(options.folders, not options.without_kernels)
    random.Random(options.seed).shuffle(every)  # a larger count goes on where a smaller one ended
    drawn = every[: options.count]
    print(f"{len(drawn)} of {len(every)} mutants")
    written = json.loads(options.out.read_text()) if options.out.exists() else []
    known = {tuple(entry.values())[:6]: entry for entry in written}
    for mutant, _ in drawn:
        vars(mutant).update(known.get(tuple(vars(mutant).values())[:6], {}))
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        _try_all(drawn, options, Path(folder))
    survivors = [mutant for mutant, _ in drawn if mutant.result == "survived"]
    print("\nsurvived:", *map(_row, survivors), sep="\n  ")
    print(f"{len(drawn) - len(survivors)} of {len(drawn)} killed ({1 - len(survivors) / max(len(drawn), 1):.0%})")


def _try_all(drawn: list[tuple[Mutant, str]], options: argparse.Namespace, folder: Path) -> None:
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    first, *others = (Worker(folder / str(k)) for k in range(options.jobs))
    result, test = first.run(list(dict.fromkeys(t for f in options.folders for t in TESTS[f])), 3600.0)
    if result != "survived":
        sys.exit(f"the tests fail as they are, {test}: mend that first")
    for worker in (first, *others):
        idle.put(worker)

    def attempt(mutant: Mutant, text: str) -> Mutant:
        worker = idle.get()
        try:
            worker.attempt(mutant, text, options.timeout)
        finally:
            idle.put(worker)
        return mutant

    with ThreadPoolExecutor(options.jobs) as pool:
        for future in as_completed([pool.submit(attempt, *each) for each in drawn if not each[0].result]):
            print(f"{future.result().result:9}{future.result().seconds:6.0f} s  {_row(future.result())}", flush=True)
            _keep(options.out, [mutant for mutant, _ in drawn])


def _keep(path: Path, drawn: list[Mutant]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".part")
    whole.write_text(json.dumps([asdict(mutant) for mutant in drawn], indent=1))
    whole.replace(path)


def _row(mutant: Mutant) -> str:
    return f"{mutant.file}:{mutant.line}  {mutant.operator}: {mutant.source}  ->  {mutant.mutated}"


if __name__ == "__main__":
    main()
