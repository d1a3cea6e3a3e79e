"""How fast is a body? `habitus` against `smplx` in one run, on the same made-up SMPL of 6,890
vertices.

    python benchmarks/body_forward.py [--seconds 60] [--device cuda] [--body trained/model.npz]
    [--out FILE]

All evaluate the same random shapes, poses and places in float32 (pose blend shapes included). They
take turns call by call, so that a slow moment of the machine hits all; a ratio is the median over
the rounds. On a GPU a call ends when its kernels have ended, and NumPy arrays are left out.
`--body` adds a body of habitus, its coarse level with SMPL's 24 joints and its own pose blend
shapes, against `smplx` with its own: how many vertices and features each has is told.
"""

import os

from common import parser

os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # libgomp's spinning makes two threads slower at random

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

from habitus.body.model import BodyModel
from habitus.io.models.bodies import load_body

BATCHES = {"cpu": (1, 8, 32, 256), "cuda": (1, 32, 256, 4096)}


OWN = "own body"
OURS = ("tensors", "arrays", "with gradient")
"""Ways to call this project's body: tensors without gradient, NumPy arrays, tensors with a gradient
to come.
"""


def contestants(
    arrays: dict, device: str = "cpu", body: BodyModel | None = None, gradients: bool = False
) -> dict[str, Callable]:
    """The same model in both libraries, and perhaps another ``body``: functions of betas (b, 10),
    pose (b, 24, 3) and trans (b, 3) to vertices, or with ``gradients`` to the gradient of a
    weighted sum of vertices to all three.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = write_official(Path(folder) / "SMPL_NEUTRAL.pkl", arrays)
        ours = load_body(path)
        theirs = smplx.SMPL(str(path)).to(device)

    def peer(betas: torch.Tensor, pose: torch.Tensor, trans: torch.Tensor) -> torch.Tensor:
        flat = pose.flatten(1)
        return theirs(
            betas=betas, global_orient=flat[:, :3], body_pose=flat[:, 3:], transl=trans
        ).vertices

    if gradients:
        bodies = {OURS[0]: ours} | ({} if body is None else {OWN: body})
        slopes = {name: Slopes(lambda *s, b=one: b(*s).vertices) for name, one in bodies.items()}
        return slopes | {"smplx": Slopes(peer)}
    peer = torch.no_grad()(peer)

    def tensors(*state: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return ours(*state).vertices

    def with_gradient(betas: torch.Tensor, pose: torch.Tensor, trans: torch.Tensor) -> torch.Tensor:
        return ours(betas, pose.clone().requires_grad_(), trans).vertices

    def numpy_arrays(*state: torch.Tensor) -> np.ndarray:
        return ours(*(part.numpy() for part in state)).vertices

    def own(*state: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return body(*state).vertices

    found = dict(zip(OURS, (tensors, numpy_arrays, with_gradient), strict=True))
    found |= ({OWN: own} if body is not None else {}) | {"smplx": peer}
    return {
        name: function for name, function in found.items() if device == "cpu" or name != "arrays"
    }


class Slopes:
    """Vertices forwards, and back the gradient to betas, pose and trans, side by side (b, 85)."""

    def __init__(self, vertices: Callable) -> None:
        self.vertices = vertices
        self.weights: dict[int, torch.Tensor] = {}

    def __call__(self, *state: torch.Tensor) -> torch.Tensor:
        """One call, forwards and back."""
        leaves = [part.detach().requires_grad_() for part in state]
        vertices = self.vertices(*leaves)
        if len(vertices) not in self.weights:
            ramp = torch.linspace(-1, 1, vertices.numel(), device=vertices.device)
            self.weights[len(vertices)] = ramp.view_as(vertices)
        slopes = torch.autograd.grad(vertices, leaves, self.weights[len(vertices)])
        return torch.cat([slope.flatten(1) for slope in slopes], 1)


def duel(functions: dict[str, Callable], batch: int, seconds: float, device: str = "cpu") -> dict:
    """Take turns until the time is up: medians (ms a call) and the median ratios of neighbours."""
    torch.manual_seed(batch)
    state = torch.randn(batch, 10), torch.randn(batch, 24, 3) * 0.3, torch.randn(batch, 3)
    state = tuple(part.to(device) for part in state)
    finish = torch.cuda.synchronize if device == "cuda" else lambda: None
    surfaces = [
        torch.as_tensor(function(*state)).detach()
        for name, function in functions.items()
        if name != OWN
    ]
    functions.get(OWN, lambda *_: None)(*state)
    gap = max(float((surface - surfaces[-1]).abs().max()) for surface in surfaces)
    gap /= max(1.0, float(surfaces[-1].abs().max()))
    times: dict[str, list[float]] = {name: [] for name in functions}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times["smplx"]) < 5:
        for name, function in functions.items():
            finish()
            start = time.perf_counter()
            function(*state)
            finish()
            times[name].append(1e3 * (time.perf_counter() - start))
    peer = np.array(times["smplx"])
    ratios = {
        name: float(np.median(peer / np.array(times[name])))
        for name in functions
        if name != "smplx"
    }
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "batch": batch,
        "ms": medians,
        "speed_up": ratios,
        "rounds": len(peer),
        "largest_difference_m": gap,
    }


def size_of(body: BodyModel) -> dict[str, float]:
    """Vertices, and pose features that move a vertex in the mean."""
    driven = np.zeros(1) if body.posedirs is None else body.posedirs.any(1)
    return {
        "vertices": body.num_vertices,
        "features a vertex": round(float(driven.sum() / body.num_vertices), 1),
    }


def main() -> None:
    """Run all batch sizes, print a table, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument(
        "--seconds", type=float, default=60.0, help="in all, shared by the batch sizes"
    )
    arguments.add_argument("--device", choices=BATCHES, default="cpu")
    arguments.add_argument(
        "--body", help="a body of habitus to race as well: default, female, male, or a file"
    )
    arguments.add_argument(
        "--gradients", action="store_true", help="forwards and back, to betas, pose and trans"
    )
    options = arguments.parse_args()
    body = None if options.body is None else load_body(options.body, joints="smpl")
    functions = contestants(official_arrays("smpl"), options.device, body, options.gradients)
    batches = BATCHES[options.device]
    rows = [
        duel(functions, batch, options.seconds / len(batches), options.device) for batch in batches
    ]
    machine = (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, "
        f"{torch.get_num_threads()} threads"
    )
    if options.device == "cuda":
        machine = torch.cuda.get_device_name()
    sizes = (
        {}
        if body is None
        else {"own body": size_of(body), "smplx": {"vertices": 6890, "features a vertex": 207}}
    )
    found = {"machine": machine, "torch": torch.__version__, "sizes": sizes, "rows": rows}
    options.out.write_text(json.dumps(found, indent=1))
    kind = "forward and back" if options.gradients else "forward"
    table = Table(title=f"body {kind}, float32, ms and times as fast as smplx: {machine}")
    for heading in ("batch", *reversed(functions), "rounds", "apart (m)"):
        table.add_column(heading, justify="right")
    for row in rows:
        ours = (
            f"{row['ms'][name]:.2f} ({row['speed_up'][name]:.2f})"
            for name in reversed(row["speed_up"])
        )
        table.add_row(
            str(row["batch"]),
            f"{row['ms']['smplx']:.2f}",
            *ours,
            str(row["rounds"]),
            f"{row['largest_difference_m']:.0e}",
        )
    Console(width=120).print(table)
    if sizes:
        print("; ".join(f"{name}: {size}" for name, size in sizes.items()))


if __name__ == "__main__":
    main()
