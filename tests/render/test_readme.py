"""The table of the renderer's formula names files and functions that exist."""

import ast
import re
from pathlib import Path

import habitus.render.operators

ROOM = Path(habitus.render.operators.__file__).parent


def test_the_formula_is_where_the_readme_says():
    files = {path.relative_to(ROOM).as_posix(): path for path in ROOM.rglob("*.py")}
    trees = [ast.parse(path.read_text()) for path in files.values()]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    defined = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    fields = {
        node.target.id
        for node in nodes
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    arguments = {node.arg for node in nodes if isinstance(node, ast.arg)}
    named = re.findall(r"`([^`]+)`", (ROOM / "README.md").read_text())
    assert len(named) > 40
    for name in named:
        if name.endswith(".py"):
            assert any(file.endswith(name) for file in files), name
        elif name.endswith("/"):
            assert (ROOM / name).is_dir(), name
        else:
            assert name.split(".")[-1] in defined | fields | arguments | {"jvp", "vjp"}, name
