"""Marker selection (M 7): does the linear problem rank sets of markers as fits do, and what is lost
with fewer markers.

python benchmarks/marker_selection.py [--people 12] [--out FILE.json]

Random sets of 8 to 80 of MoSh's markers are judged both ways: by `set_error`, to first order, and
by fits with a draw of noise for each person. Then the curve of M's Figure 5 and the time it takes.
"""

import json
import time
from pathlib import Path

import numpy as np
from common import machine, parser
from scipy.stats import spearmanr

from habitus.body.prior import shipped_prior
from habitus.fit.selection.full import best_states, full_error
from habitus.fit.selection.greedy import removals, set_error
from habitus.fit.selection.held_out import held_out_people
from habitus.fit.selection.problem import (
    NOISE,
    Candidates,
    linearised,
    region_joints,
    region_vertices,
)
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body

SIZES = (8, 12, 16, 20, 25, 35, 47, 60, 80)
SETS = 3
ALIKE = (25, 20)


def main() -> None:
    """Judge sets both ways, say how well the two agree, and draw the curve."""
    arguments = parser(__doc__)
    arguments.add_argument("--people", type=int, default=12)
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    body = load_body("default")
    prior = shipped_prior()
    rng = np.random.default_rng(0)
    drawn = held_out_people([load_body("female"), load_body("male")], prior, options.people, 0)
    people = best_states(body, prior, drawn, np.arange(0, body.num_vertices, 15))
    layout = load_layout("mosh-67")
    vertices, first = np.unique(layout.vertices(body), return_index=True)
    labels = tuple(layout.labels[k] for k in first)
    candidates = Candidates(labels, vertices, tuple((k,) for k in range(len(vertices))))
    problem = linearised(body, prior, people, candidates)
    judged = region_vertices(body, region_joints(body, "all"))
    offsets = rng.normal(scale=NOISE, size=(len(people), body.num_vertices, 3))
    sets = [rng.permutation(len(vertices))[:size] for size in SIZES for _ in range(SETS)]
    sets += [rng.permutation(len(vertices))[: ALIKE[0]] for _ in range(ALIKE[1])]
    began = time.perf_counter()
    full = [1e3 * full_error(body, prior, people, vertices[some], judged, offsets) for some in sets]
    full_seconds = (time.perf_counter() - began) / len(sets)
    began = time.perf_counter()
    first_order = [1e3 * set_error(problem, tuple(some)) for some in sets]
    first_seconds = (time.perf_counter() - began) / len(sets)
    began = time.perf_counter()
    curve = {
        len(step.groups): 1e3 * step.error for step in removals(problem, range(len(vertices)), 5)
    }
    curve_seconds = time.perf_counter() - began
    spread = slice(0, len(SIZES) * SETS)
    alike = slice(len(SIZES) * SETS, None)
    found = {
        "machine": machine(),
        "people": options.people,
        "rank_correlation_all_sizes": float(spearmanr(full[spread], first_order[spread])[0]),
        "rank_correlation_same_size": float(spearmanr(full[alike], first_order[alike])[0]),
        "median_ratio": float(np.median(np.array(full) / first_order)),
        "seconds_a_set": {"fits": full_seconds, "first_order": first_seconds},
        "curve_mm": curve,
        "curve_seconds": curve_seconds,
        "sets": [[len(some), a, b] for some, a, b in zip(sets, full, first_order, strict=True)],
    }
    for size, a, b in found["sets"]:
        print(f"{size:3d} markers: fits {a:6.1f} mm, first order {b:6.1f} mm")
    for name in (
        "rank_correlation_all_sizes",
        "rank_correlation_same_size",
        "median_ratio",
        "curve_seconds",
    ):
        print(f"{name}: {found[name]:.3f}")
    print(
        "curve:",
        "  ".join(
            f"{size}: {curve[size]:.1f}"
            for size in (86, 67, 47, 35, 25, 20, 15, 10, 5)
            if size in curve
        ),
    )
    if options.out:
        options.out.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
