"""Do measurements change continuously with the shape, and how long do they take?

    python benchmarks/measurement_jumps.py [--bodies 1000] [--body default female male]

From so many random bodies (standard normal betas, up to 3 standard deviations) one beta, drawn at
random, is moved by .05 and by .10. A jump is what a straight line through the first two does not
foretell of the third, so that a steep measurement (the height moves 5 mm in .05 of the first beta)
is not taken for a jump. Prints the largest of each.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time

import numpy as np
from common import in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel

STEP = 0.05
BATCH = 20
REPEATS = 50
GOAL_MM = 5.0
GOAL_MS = 20.0


def jumps(body: BodyModel, count: int, seed: int = 0) -> dict[str, float]:
    """The largest jump (mm, kg) of each measurement over so many bodies."""
    rng = np.random.default_rng(seed)
    found = {}
    for _ in range(0, count, BATCH):
        betas = rng.normal(size=(BATCH, body.num_betas)).clip(-3, 3)
        way = STEP * np.eye(body.num_betas)[rng.integers(0, body.num_betas, BATCH)]
        measured = [body.measure_people(betas + k * way) for k in range(3)]
        for name, first in measured[0].items():
            jump = np.abs(first - 2 * measured[1][name] + measured[2][name]).max()
            found[name] = max(
                found.get(name, 0.0), float(jump) * (1.0 if name.endswith("_kg") else 1e3)
            )
    return found


def milliseconds(body: BodyModel) -> float:
    """The median time of one `measure()`."""
    body.measure()
    taken = []
    for k in range(REPEATS):
        began = time.perf_counter()
        body.measure([0.01 * k])
        taken.append(time.perf_counter() - began)
    return 1e3 * float(np.median(taken))


def main() -> None:
    """Measure, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--bodies", type=int, default=1000)
    arguments.add_argument("--body", nargs="+", default=["default", "female", "male"])
    options = arguments.parse_args()
    about = machine()
    found = {}
    times = {}
    for name in options.body:
        body = habitus.load_body(name)
        found[name], times[name] = jumps(body, options.bodies), milliseconds(body)
    table = Table(
        title=f"largest jump per {STEP} of a beta, {options.bodies} bodies (mm, kg; goal "
        f"{GOAL_MM:g} mm)"
    )
    for head in ("", *options.body):
        table.add_column(head, justify="right" if head else "left")
    for which in found[options.body[0]]:
        table.add_row(which, *(f"{found[name].get(which, np.nan):.3f}" for name in options.body))
    table.add_row(
        f"one measure(), ms (goal {GOAL_MS:g})", *(f"{times[name]:.1f}" for name in options.body)
    )
    Console(width=120).print(table)
    print(in_words(about))
    write_json(
        options.out,
        {"machine": about, "bodies": options.bodies, "jumps": found, "milliseconds": times},
    )


if __name__ == "__main__":
    main()
