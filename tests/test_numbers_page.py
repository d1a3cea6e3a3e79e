"""The page of measured numbers is what its JSON files say."""

import json
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

tool = import_module("numbers_page")

MACHINE = {"processor": "made up", "cores": 2, "habitus": "0"}


def test_page_and_files_agree():
    assert tool.PAGE.read_text("utf-8") == tool.page(), "run tools/numbers_page.py"


def test_every_line_is_of_a_benchmark_and_every_file_has_lines():
    names = {line.benchmark for line in tool.LINES}
    assert all((ROOT / "benchmarks" / f"{name}.py").is_file() for name in names)
    assert {path.stem for path in tool.RESULTS.glob("*.json")} <= names


@pytest.mark.parametrize(
    ("path", "wanted"),
    [
        ("a/*/x", [("0", 1), ("1", 3)]),
        ("a/kind=old/x", [("", 3)]),
        ("b/*/x", [("left", 5)]),
        ("a/*/lacking", []),
    ],
)
def test_paths_reach_lists_objects_and_chosen_entries(path, wanted):
    data = {"a": [{"kind": "new", "x": 1}, {"kind": "old", "x": 3}], "b": {"left": {"x": 5}}}
    assert tool.values(data, path) == wanted


def test_a_section_has_command_machine_and_numbers(tmp_path):
    rows = [{"pose_mm": 4.0, "soft_tissue_mm": 3.0}, {"pose_mm": 5.0, "soft_tissue_mm": 4.0}]
    file = tmp_path / "mosh_accuracy.json"
    command = "benchmarks/mosh_accuracy.py --captures one two"
    file.write_text(json.dumps({"command": command, "machine": MACHINE, "rows": rows}))
    text = tool.section(file)
    assert f"`{command}` (made up, 2 cores" in text
    assert "| captures | 2 |" in text and "posed (mean of captures) | 4.50 mm |" in text
    assert "held-out" not in text  # nothing measured, no line
