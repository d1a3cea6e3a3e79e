"""How fast is a body? `habitus` against `smplx` in one run, on the same made-up SMPL of 6,890 vertices.

    python benchmarks/body_forward.py [--seconds 60] [--out body_forward.json]

Both evaluate the same random shapes, poses and places in float32 (pose blend shapes included), without gradients, with
torch's own threads. They take turns call by call, so that a slow moment of the machine hits both; a ratio is the median
over the pairs.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # libgomp's spinning makes two threads slower at random

import argparse
import contextlib
import io
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import smplx
import torch
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from synthetic import official_arrays, write_official

from habitus.io.models.bodies import load_body

BATCHES = (1, 8, 32, 256)


def contestants(arrays: dict) -> dict[str, Callable]:
    """The same model in both libraries: functions of betas (b, 10), pose (b, 24, 3) and trans (b, 3) to vertices."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = write_official(Path(folder) / "SMPL_NEUTRAL.pkl", arrays)
        ours, theirs = load_body(path), smplx.SMPL(str(path))

    def peer(betas: torch.Tensor, pose: torch.Tensor, trans: torch.Tensor) -> torch.Tensor:
        flat = pose.flatten(1)
        return theirs(betas=betas, global_orient=flat[:, :3], body_pose=flat[:, 3:], transl=trans).vertices

    return {"habitus": lambda *state: ours(*state).vertices, "smplx": peer}


def duel(functions: dict[str, Callable], batch: int, seconds: float) -> dict:
    """Alternate the two until the time is up: medians (ms a call) and the median ratio of neighbours."""
    torch.manual_seed(batch)
    state = torch.randn(batch, 10), torch.randn(batch, 24, 3) * 0.3, torch.randn(batch, 3)
    surfaces = [function(*state) for function in functions.values()]
    gap = float((surfaces[0] - surfaces[1]).abs().max())
    times: dict[str, list[float]] = {name: [] for name in functions}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times["smplx"]) < 5:
        for name, function in functions.items():
            start = time.perf_counter()
            function(*state)
            times[name].append(1e3 * (time.perf_counter() - start))
    ratio = float(np.median(np.array(times["smplx"]) / np.array(times["habitus"])))
    medians = {f"{name}_ms": float(np.median(values)) for name, values in times.items()}
    return {"batch": batch, **medians, "speed_up": ratio, "pairs": len(times["smplx"]), "largest_difference_m": gap}


def main() -> None:
    """Run all batch sizes, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="in all, shared by the batch sizes")
    parser.add_argument("--out", type=Path, default=Path("body_forward.json"))
    options = parser.parse_args()
    functions = contestants(official_arrays("smpl"))
    with torch.no_grad():
        rows = [duel(functions, batch, options.seconds / len(BATCHES)) for batch in BATCHES]
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads"
    options.out.write_text(json.dumps({"machine": machine, "torch": torch.__version__, "rows": rows}, indent=1))
    table = Table(
        "batch",
        "habitus ms",
        "smplx ms",
        "times as fast",
        "pairs",
        "apart (m)",
        title=f"body forward, float32: {machine}",
    )
    for row in rows:
        numbers = row["habitus_ms"], row["smplx_ms"], row["speed_up"]
        table.add_row(
            str(row["batch"]), *(f"{n:.2f}" for n in numbers), str(row["pairs"]), f"{row['largest_difference_m']:.0e}"
        )
    Console().print(table)


if __name__ == "__main__":
    main()
