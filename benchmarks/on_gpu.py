"""What runs on a GPU, and what many cores give: five minutes on a machine that has them.

    python benchmarks/on_gpu.py [--seconds 4] [--json on_gpu.json]

- forward: the default body in float32 on the CUDA device, against `smplx` (the same number of
  joints, 6,890 vertices, random arrays of SMPL's shapes) where it is installed.
- gradient: the same with the gradient of a weighted sum of vertices to betas, pose and place.
- agreement: vertices and gradients of float64 on the device against the CPU.
- renderer: colour and depth of the body at 640x480 by the reference path, which is what serves
  tensors on a GPU, and the gradient to vertices and colours; beside it the CPU's kernels.
- cores: the pose stage, a batch of bodies, and an image by the CPU's kernels with 1, 2, 4, ...
  threads: efficiency is the speed-up divided by the number of threads.

Medians of calls after two that are not counted, synchronised before and after. Without a CUDA device its parts are
left out with the reason, and the last part runs alone. A part that fails says why; the others go on.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import torch
from common import machine, parser, show_table, write_json

import habitus as hb
from habitus.body.model import BodyModel

BATCHES = (1, 32, 256, 1024)
SIZE = (640, 480)
GOAL_FORWARD = 200_000.0
"""Bodies a second at a batch of 256."""


def states(body: BodyModel, batch: int, device: str, dtype: torch.dtype) -> list[torch.Tensor]:
    """Betas, pose and place of random people, the same on every device."""
    generator = torch.Generator().manual_seed(batch)
    shapes = (body.num_betas,), (body.num_joints, 3), (3,)
    draws = (torch.randn(batch, *shape, generator=generator, dtype=dtype) for shape in shapes)
    return [draw.to(device) * scale for draw, scale in zip(draws, (1.0, 0.3, 1.0), strict=True)]


def timed(work: Callable[[], object], seconds: float, device: str) -> float:
    """Median milliseconds of a call."""
    finish = torch.cuda.synchronize if device == "cuda" else lambda: None
    for _ in range(2):
        work()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 5:
        finish()
        began = time.perf_counter()
        work()
        finish()
        times.append(1e3 * (time.perf_counter() - began))
    return median(times)


def gradients(
    body: Callable, state: list[torch.Tensor], weights: torch.Tensor
) -> list[torch.Tensor]:
    """Gradients of a weighted sum of the vertices."""
    leaves = [part.detach().requires_grad_() for part in state]
    return list(torch.autograd.grad(body(*leaves), leaves, weights))


def vertex_weights(body: Callable, state: list[torch.Tensor]) -> torch.Tensor:
    """The gradient to the vertices that `gradients` begins with."""
    with torch.no_grad():
        vertices = body(*state)
    weights = torch.linspace(-1.0, 1.0, vertices.numel(), device=vertices.device)
    return weights.view_as(vertices).to(vertices)


def peer_body(device: str) -> Callable | None:
    """`smplx` with arrays of SMPL's shapes as a function of betas, pose and place."""
    try:
        import smplx
    except ImportError:
        return None
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
    from synthetic import official_arrays, write_official

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = write_official(Path(folder) / "SMPL_NEUTRAL.pkl", official_arrays("smpl"))
        model = smplx.SMPL(str(path)).to(device)

    def vertices(betas: torch.Tensor, pose: torch.Tensor, trans: torch.Tensor) -> torch.Tensor:
        flat = pose.flatten(1)
        found = model(
            betas=betas[:, :10], global_orient=flat[:, :3], body_pose=flat[:, 3:], transl=trans
        )
        return found.vertices

    return vertices


def bodies_on_device(seconds: float, device: str) -> dict:
    """Rows for each batch: forward alone, then with the gradient; ours and the peer's."""
    body = hb.load_body("default", joints="smpl")
    peer = peer_body(device)
    contestants = {"habitus": lambda *state: body(*state).vertices}
    contestants |= {} if peer is None else {"smplx": peer}
    rows = []
    for batch in BATCHES:
        state = states(body, batch, device, torch.float32)
        for name, vertices in contestants.items():
            with torch.no_grad():
                forward = timed(lambda v=vertices, s=state: v(*s), seconds, device)
            slope = vertex_weights(vertices, state)
            work = lambda v=vertices, s=state, w=slope: gradients(v, s, w)  # noqa: E731
            both = timed(work, seconds, device)
            rows.append(
                {
                    "body": name,
                    "batch": batch,
                    "forward_ms": forward,
                    "bodies_a_second": 1e3 * batch / forward,
                    "with_gradient_ms": both,
                }
            )
    return {"rows": rows, "goal_bodies_a_second_at_256": GOAL_FORWARD}


def compiled(seconds: float, device: str) -> dict:
    """The forward pass of 256 bodies under `torch.compile`, with the device's graphs"""
    body = hb.load_body("default", joints="smpl")
    state = states(body, 256, device, torch.float32)
    began = time.perf_counter()
    fast = torch.compile(lambda *s: body(*s).vertices, mode="reduce-overhead")
    with torch.no_grad():
        gap = float((fast(*state) - body(*state).vertices).abs().max())
        compiling = time.perf_counter() - began
        forward = timed(lambda: fast(*state), seconds, device)
    return {
        "forward_ms": forward,
        "bodies_a_second": 256e3 / forward,
        "compiling_s": compiling,
        "difference_m": gap,
    }


def agreement(device: str) -> dict:
    """Largest differences between the device and the CPU, float64 (m)."""
    body = hb.load_body("default", joints="smpl")
    there = states(body, 8, device, torch.float64)
    here = states(body, 8, "cpu", torch.float64)
    own = lambda *state: body(*state).vertices  # noqa: E731
    found = (gradients(own, s, vertex_weights(own, s)) for s in (there, here))
    pairs = zip(*found, strict=True)
    return {
        "vertices_m": float((own(*there).detach().cpu() - own(*here).detach()).abs().max()),
        "gradient_relative": max(
            float((a.cpu() - b).abs().max() / b.abs().max()) for a, b in pairs
        ),
    }


def images(seconds: float, device: str) -> dict:
    """Colour and depth of the body, and their gradient, on the device and by the CPU's kernels."""
    found: dict[str, dict] = {}
    pictures = {}
    for place in dict.fromkeys((device, "cpu")):
        body = hb.load_body("default", joints="smpl")
        surface = body(torch.zeros(body.num_betas, device=place))
        vertices = surface.vertices + torch.tensor([0.0, 0.0, 3.0], device=place)
        camera = hb.Camera.of(*SIZE).to(vertices.dtype).to(vertices.device)
        colours = torch.rand(
            len(vertices), 3, generator=torch.Generator().manual_seed(0), dtype=vertices.dtype
        ).to(place)

        def look(v: torch.Tensor, c: torch.Tensor, camera=camera, faces=surface.faces) -> tuple:
            frame = hb.draw(camera, v, faces)
            return frame.image(c), frame.depth()

        def slope(v=vertices, c=colours, look=look) -> tuple:
            leaves = v.detach().requires_grad_(), c.detach().requires_grad_()
            image, _ = look(*leaves)
            return torch.autograd.grad((image**2).mean(), leaves)

        with torch.no_grad():
            pictures[place] = look(vertices, colours)[0].cpu()
            forward = timed(lambda: look(vertices, colours), seconds, place)  # noqa: B023
        found[place] = {"image_ms": forward, "gradient_ms": timed(slope, seconds, place)}
    apart = (pictures[device] - pictures["cpu"]).abs()
    return {**found, "difference": {"mean": float(apart.mean()), "max": float(apart.max())}}


def on_cores(seconds: float, counts: list[int]) -> list[dict]:
    """Three jobs of the CPU's kernels with a growing number of threads."""
    from marker_solve import scene

    from habitus.fit.markers.sequence import fit_sequence
    from habitus.fit.markers.settings import SequenceSettings

    s = scene("cmu-41", 41, 4800)
    settings = SequenceSettings()
    body = hb.load_body("default", joints="smpl")
    many = [part.numpy() for part in states(body, 1024, "cpu", torch.float32)]
    surface = body(torch.zeros(body.num_betas))
    vertices = surface.vertices + torch.tensor([0.0, 0.0, 3.0])
    camera = hb.Camera.of(*SIZE).to(vertices.dtype).to(vertices.device)
    jobs = {
        "pose stage": lambda: fit_sequence(
            s.rig, s.observed, None, None, s.prior, s.pose, s.trans, settings
        ),
        "bodies": lambda: body(*many),
        "image": lambda: hb.draw(camera, vertices, surface.faces).depth(),
    }
    rows: list[dict] = []
    for name, job in jobs.items():
        one = None
        for count in counts:
            with threads(count):
                ms = timed(job, seconds / 2, "cpu")
            one = ms if one is None else one
            rows.append({"job": name, "threads": count, "ms": ms, "efficiency": one / ms / count})
    return rows


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """So many threads for the CPU's kernels within."""
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(count)
    try:
        yield
    finally:
        os.environ.pop("NUMBA_NUM_THREADS")
        if before is not None:
            os.environ["NUMBA_NUM_THREADS"] = before


def part(work: Callable, *arguments: object) -> object:
    """What a part measures, or why it could not."""
    try:
        return work(*arguments)
    except Exception as problem:  # a benchmark of a rare machine: all that can be had
        return {"failed": f"{type(problem).__name__}: {problem}"}


def measure(options: argparse.Namespace) -> dict:
    """All parts that this machine can run."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    counts = [n for n in (1, 2, 4, 8, 16, 32) if n <= (cores or 1)]
    found: dict[str, object] = {"machine": machine(), "device": "no CUDA device: left out"}
    if torch.cuda.is_available():
        found["device"] = torch.cuda.get_device_name()
        found["bodies"] = part(bodies_on_device, options.seconds, "cuda")
        found["agreement"] = part(agreement, "cuda")
        found["images"] = part(images, options.seconds, "cuda")
    found["cores"] = part(on_cores, options.seconds, counts)
    if torch.cuda.is_available():
        if options.json is not None:
            write_json(options.json, found)
        found["compiled"] = part(compiled, options.seconds, "cuda")
    return found


def main() -> None:
    """Measure, print, write."""
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=4.0, help="for each number")
    arguments.add_argument("--json", type=Path, default=None)
    options = arguments.parse_args()
    found = measure(options)
    print(found["device"])
    for name in ("bodies", "cores"):
        rows = found.get(name)
        rows = rows.get("rows", [rows]) if isinstance(rows, dict) else rows
        if rows:
            show_table(name, rows)
    for name in ("agreement", "images", "compiled"):
        if name in found:
            print(name, found[name])
    if options.json is not None:
        write_json(options.json, found)


if __name__ == "__main__":
    main()
