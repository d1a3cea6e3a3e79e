"""Two people in one volume, their labels taken away: how many come back, and is anybody's marker
given to the other?

    python benchmarks/labelling_people.py [--json labelling_people.json]

Two captures are put into one volume, the second so many metres beside the first, and spoilt as
`labelling.py` spoils them, the harder way. Nothing is told but the layout, and that there are two
people.
"""

import time
from pathlib import Path

import numpy as np
from common import machine, parser, write_json
from labelling import corrected, read, spoilt

from habitus.body.prior import prior_of
from habitus.fit.labels.recipe import label_people
from habitus.io.layouts.files import match_layout
from habitus.io.models.bodies import load_body
from habitus.jobs.options import MIN_CONFIDENCE

PAIRS = (
    ("85_02", "85_12", 0.4),
    ("85_02", "85_12", 0.8),
    ("HC042A13", "HC042A40", 0.6),
    ("testsample", "testsample2", 0.5),
)
"""Captures in one layout, and how far (m) the second's first frame is moved from the first's."""
FRAMES = 800


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__)
    arguments.add_argument(
        "--json", type=Path, default=Path("benchmarks/results/labelling_people.json")
    )
    options = arguments.parse_args()
    found = [measure(*pair) for pair in PAIRS]
    options.json.parent.mkdir(parents=True, exist_ok=True)
    write_json(options.json, {"machine": machine(), "pairs": found})


def measure(first: str, second: str, metres: float) -> dict:
    """F1, the share of named points that are the other person's, and how near the two come to each
    other.
    """
    captures = [read(name, True) for name in (first, second)]
    layout = match_layout(captures[0].labels).layout
    markers = [_as_layout(capture, layout.labels)[:FRAMES] for capture in captures]
    frames = min(map(len, markers))
    up = "xyz".index(captures[0].up_axis[1])
    begin = [np.nanmedian(each[0], axis=0) for each in markers]
    move = np.delete(np.eye(3), up, axis=0)[0] * metres + np.where(
        np.arange(3) == up, 0.0, begin[0] - begin[1]
    )
    both = np.concatenate([markers[0][:frames], markers[1][:frames] + move], axis=1)
    apart = [
        np.linalg.norm(np.nanmedian(a, 0) - np.nanmedian(b, 0))
        for a, b in zip(*np.split(both, 2, 1), strict=True)
    ]
    clouds, true = spoilt(both, captures[0].rate_hz, captures[0].up_axis, breaks=100, lasting=4)
    body = load_body("default")
    began = time.process_time()
    result = label_people(body, prior_of(body), layout, clouds, 2)
    label = np.where(result.confidence >= MIN_CONFIDENCE, result.label, -1)
    if np.mean(label[true >= 0] // len(layout) == true[true >= 0] // len(layout)) < 0.5:
        label = np.where(label >= 0, (label + len(layout)) % (2 * len(layout)), -1)
    said = label >= 0
    there = true >= 0
    f1 = 2.0 * (said & (label == true)).sum() / (said.sum() + there.sum())
    other = float(np.mean(label[said & there] // len(layout) != true[said & there] // len(layout)))
    seconds = time.process_time() - began
    print(
        f"{first} and {second}, {min(apart):.2f} to {max(apart):.2f} m apart, {frames} frames: F1 "
        f"{f1:.4f}, "
        f"the other's {other:.4f}, {seconds:.1f} s",
        flush=True,
    )
    return {
        "captures": [first, second],
        "f1": float(f1),
        "other": other,
        "nearest_m": float(min(apart)),
        "cpu_s": seconds,
    }


def _as_layout(capture, labels: tuple[str, ...]) -> np.ndarray:
    """Markers in the order of a layout's labels, NaN where the capture lacks one."""
    names, markers = corrected(capture)
    found = np.full((len(markers), len(labels), 3), np.nan)
    for k, label in enumerate(labels):
        if label in names:
            found[:, k] = markers[:, names.index(label)]
    return found


if __name__ == "__main__":
    main()
