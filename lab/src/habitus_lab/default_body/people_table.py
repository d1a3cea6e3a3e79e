"""The docs' table of the people's numbers, from what build.py --numbers wrote.

python -m habitus_lab.default_body.people_table lab/src/habitus_lab/default_body/people_numbers.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

SPACES = ("female", "male", "neutral")
# what is shown, and the root mean square error in mm it may have with 20 betas
LIMITS = {
    "stature": 3,
    "crotchheight": 6,
    "chestcircumference": 8,
    "waistcircumference": 8,
    "buttockcircumference": 8,
    "thighcircumference": 8,
    "neckcircumference": 5,
    "calfcircumference": 5,
    "bicepscircumferenceflexed": 5,
    "forearmcircumferenceflexed": 5,
    "anklecircumference": 5,
    "wristcircumference": 5,
    "headcircumference": 5,
    "footlength": 4,
    "handlength": 4,
    "chestdepth": 12,
    "waistdepth": 12,
    "buttockdepth": 12,
    "waistbreadth": 12,
    "hipbreadth": 12,
    "bideltoidbreadth": 12,
    "footbreadthhorizontal": 12,
    "bimalleolarbreadth": 12,
}


def table(numbers: dict) -> str:
    """Markdown."""
    lines = ["| | female | male | neutral |", "|---|---|---|---|"]
    for key, name in (
        ("vertex_error_mm", "vertex error, 5 / 10 / 16 / 20 / 24 betas, mm"),
        ("vertex_error_mm_by_vertices_alone", "the same, betas from vertices alone"),
    ):
        lines.append(
            _row(name, [" / ".join(f"{v:.1f}" for v in numbers[s][key].values()) for s in SPACES])
        )
    for count in numbers["female"]["surface_error_mm"]:
        cells = ["{:.2f} / {:.1f}".format(*numbers[s]["surface_error_mm"][count]) for s in SPACES]
        name = f"{count} betas, nearest surface: mean / 95th percentile over the skin's area, mm"
        lines.append(_row(name, cells))
    for kind, name in (("normal", "normal"), ("uniform", "uniform ±3 sd")):
        either = [f"{100 * numbers[s]['random_bodies'][kind]['either']:.1f} %" for s in SPACES]
        lines.append(_row(f"{name} draws that cut themselves or turn a triangle over", either))
    joints = [" / ".join(f"{v:.1f}" for v in numbers[s]["joint_error_worst_mm"]) for s in SPACES]
    lines.append(_row("worst joint, mean / 95th percentile, mm", joints))
    for column, limit in LIMITS.items():
        found = [numbers[s]["measured_at_20"][column] for s in SPACES]
        cells = [f"{f['rmse']:.1f} ({f['bias']:+.1f})" for f in found]
        lines.append(_row(f"{column}: RMSE (bias) with 20 betas, mm; wanted {limit}", cells))
    return "\n".join(lines)


def _row(name: str, cells: list[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text())))
