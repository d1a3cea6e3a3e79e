"""Is a fit the same, bit for bit, with one thread and two, twice, and in processes that are
spawned or forked, also from a process whose threads have already worked?

    python benchmarks/same_bits.py [--out same_bits.json]

Fits of markers, a scan, two depth views, and markers and views together, of people made here. Each
way runs all fits in a process of its own and reports a SHA-256 of every array of each result. A
forked process that hangs is stopped after `--seconds`; it sets PyTorch to one thread first, as
docs/rendering.md asks for: PyTorch's own threads do not survive a fork.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass

import numpy as np
import torch
from common import ROOT, parser, run, show_table, synthetic

WAYS = {
    "one thread": {"OMP_NUM_THREADS": "1"},
    "two threads": {"OMP_NUM_THREADS": "2"},
    "two threads again": {"OMP_NUM_THREADS": "2"},
    "spawned": {"OMP_NUM_THREADS": "2"},
    "forked": {"OMP_NUM_THREADS": "2"},
    "forked after a fit": {"OMP_NUM_THREADS": "2"},
}
TIMES = {"stage_seconds", "frames_per_second", "seconds", "startup_seconds"}


def fits() -> dict[str, Callable[[], object]]:
    """Each recipe's fit of a made person."""
    sys.path.insert(0, str(ROOT / "examples"))
    from two_sensors import SHOTS, person

    import habitus as hb
    from habitus.fit.points.scan import Scan
    from habitus_lab.population import scans

    body = hb.load_body("default")
    rng = np.random.default_rng(3)
    _, markers, views = person(body, 3)
    stands = scans.person(body, scans.stance("A", body.joint_names, rng), rng)
    scan = scans.scanned(stands, body.faces, scans.Scanner(points=30_000), rng)
    return {
        "markers": lambda: hb.Mosh().fit(synthetic(body, "cmu-41", 120)),
        "scan": lambda: hb.register_scans([Scan("person", scan.points)], body, up="+y"),
        "views": lambda: hb.Fit(body, hb.Depth(views)).solve(),
        "markers, views": lambda: hb.Fit(body, [markers, hb.Depth(views, frames=SHOTS)]).solve(),
    }


def digest(result: object) -> dict[str, str]:
    """SHA-256 of each array and number of a result, by its path; times are left out."""
    values: dict[str, str] = {}

    def visit(path: str, value: object) -> None:
        if path.rpartition(".")[2] in TIMES:
            return
        if isinstance(value, np.ndarray):
            values[path] = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
        elif isinstance(value, float | int | str):
            values[path] = repr(value)
        elif isinstance(value, list | tuple):
            for k, each in enumerate(value):
                visit(f"{path}[{k}]", each)
        elif isinstance(value, dict):
            for key, each in value.items():
                visit(f"{path}.{key}", each)
        elif is_dataclass(value):
            for field in fields(value):
                visit(f"{path}.{field.name}", getattr(value, field.name))

    visit("", result)
    return values


def digests() -> dict[str, dict[str, str]]:
    """Digests of all recipes' fits in this process."""
    return {name: digest(fit()) for name, fit in fits().items()}


def child(way: str, seconds: float) -> dict:
    """What this process, or one that it starts, reports for a way."""
    if way not in ("spawned", "forked", "forked after a fit"):
        return digests()
    if way == "forked after a fit":
        digests()
    context = multiprocessing.get_context("spawn" if way == "spawned" else "fork")
    with context.Pool(1, torch.set_num_threads, (1,)) as pool:
        return pool.apply_async(digests).get(seconds)


def measure(options: argparse.Namespace) -> dict | None:
    """The digests of each way, and how many equal those of one thread."""
    if options.way:
        print(json.dumps(child(options.way, options.seconds)))
        return None
    ways = {}
    for way, environment in WAYS.items():
        command = [sys.executable, __file__, "--way", way, "--seconds", str(options.seconds)]
        done = subprocess.run(
            command, env=os.environ | environment, capture_output=True, text=True, check=False
        )
        lines = done.stderr.strip().splitlines() or ["no message"]
        ways[way] = json.loads(done.stdout) if done.returncode == 0 else lines[-1]
    reference = ways["one thread"]
    rows = []
    for way, values in ways.items():
        row = {"way": way}
        for name in reference:
            if isinstance(values, str):
                row[name] = values
                continue
            same = [key for key, value in values[name].items() if reference[name].get(key) == value]
            different = [key for key in values[name] if key not in same]
            row[name] = f"{len(same)} of {len(values[name])} " + " ".join(different[:3])
        rows.append(row)
    return {"rows": rows, "ways": ways}


def main() -> None:
    """Run every way, compare, show, write."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--seconds", type=float, default=600.0)
    arguments.add_argument("--way", choices=tuple(WAYS), help="only this one; digests to stdout")
    run(arguments, measure, lambda found: show_table("equal values", found["rows"]))


if __name__ == "__main__":
    main()
