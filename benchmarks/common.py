"""What the marker-fit benchmarks share: the machine's name, captures to run on, kernels compiled
beforehand, JSON.
"""

import json
import os
import platform
import time
from pathlib import Path

import numpy as np
import torch

import habitus
from habitus.body.model import BodyModel
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.priors import load_pose_prior
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

ROOT = Path(__file__).resolve().parents[1]
CAPTURES = ROOT.parent / "shared" / "mocap"
"""Real captures that lie beside a checkout and are never part of it."""


def machine() -> dict[str, object]:
    """Processor, cores and versions, to stand beside every number."""
    import numba

    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        processor = names[0] if names else processor
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "kernel_threads": numba.config.NUMBA_NUM_THREADS,
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "habitus": habitus.__version__,
    }


def in_words(machine: dict[str, object]) -> str:
    """The machine in one line."""
    return (
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load_before']:.1f} "
        "before"
    )


def synthetic(body: BodyModel, layout_name: str, frames: int, seed: int = 1) -> Capture:
    """A synthetic capture at 120 Hz with the markers that a layout asks for: placement errors,
    noise, gaps.
    """
    rng = np.random.default_rng(seed)
    layout = load_layout(layout_name)
    prior = load_pose_prior().for_joints(body.joint_names)
    layout = layout.restricted_to(
        tuple(marker.label for marker in layout.markers if not marker.optional)
    )
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), frames, 120.0, rng)
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    truth = simulate_capture(
        body, betas, pose, trans, layout.vertices(body), layout.distances(), Faults(), rng
    )
    return Capture(f"synthetic-{layout_name}", layout.labels, truth.observed, 120.0, "+y")


def write_synthetic(body: BodyModel, layout_name: str, frames: int, folder: Path) -> Path:
    """The same as a C3D file."""
    capture = synthetic(body, layout_name, frames)
    path = folder / f"{capture.name}.c3d"
    write_c3d(capture, path)
    return path


def compile_kernels(body: BodyModel) -> float:
    """Run a tiny fit, so that imports and compilation are over before anything is timed; gives the
    seconds it took.
    """
    began = time.perf_counter()
    from habitus.fit.markers.recipe import fit_markers
    from habitus.fit.markers.settings import MoshSettings
    from habitus.jobs.subjects import person

    someone = person([synthetic(body, "cmu-41", 48)], "auto")
    for causal in (False, True):
        settings = MoshSettings(annealing=(10.0,), frames=3, causal=causal, soft_tissue=not causal)
        fit_markers(body, load_pose_prior(), someone.layout, someone.recordings, settings)
    return time.perf_counter() - began


def write_json(path: Path, content: dict) -> None:
    """The numbers behind a table."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print(f"wrote {path}")


def written_rows(path: Path, key: str, **settings: object) -> list[dict]:
    """The rows under a key that a run with these settings has left in a file; none where there is
    no such file.
    """
    if not path.exists():
        return []
    before = json.loads(path.read_text(encoding="utf-8"))
    return before[key] if all(before.get(name) == value for name, value in settings.items()) else []
