"""Soft tissue in motion: are planted dynamics found on the default body, how fast is prediction,
does it come to rest?

Smooth blend shapes of the default body's coarse level swing as damped oscillators that its joints
drive. People of other shapes move (`habitus.observe.simulated_markers.smooth_motion`), and the training
sees their surfaces, with noise.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time
from dataclasses import replace

import numpy as np
from common import in_words, machine, parser, write_json

from habitus.body.dynamics import Dynamics, DynamicsRegressor
from habitus.body.joint_layouts import SMPL
from habitus.body.model import BodyModel
from habitus.body.prior import shipped_prior
from habitus.body.soft_tissue import simulate_soft_tissue
from habitus.evaluate.dynamics import MODES, QUANTITIES, evaluate_dynamics
from habitus.io.models.bodies import load_body
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.learn.dynamics.train import DynamicsOptions, learn_dynamics, swinging
from habitus.mesh.registrations import Registrations
from habitus.observe.simulated_markers import smooth_motion
from habitus.parallel.workers import Threads

RATE = 60.0
COUNT = 8
JOINTS = SMPL.joint_names[:22]


def planted(body: BodyModel, seed: int = 0) -> BodyModel:
    """The body with eight smooth blend shapes of 3 to 10 mm, which swing at 3 to 8 Hz, the more so
    the larger it is.
    """
    rng = np.random.default_rng(seed)
    waves = [
        np.sin(9.0 * body.v_template @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
        for _ in range(COUNT)
    ]
    axes = np.linalg.qr(np.reshape(waves, (COUNT, -1)).T)[0] * np.sqrt(body.num_vertices)
    directions = (axes * np.linspace(0.010, 0.003, COUNT)).reshape(-1, 3, COUNT)
    angle = 2 * np.pi * np.linspace(3.0, 8.0, COUNT) / RATE
    radius = np.linspace(0.93, 0.85, COUNT)
    history = np.array([np.diag(2 * radius * np.cos(angle)), np.diag(-(radius**2))])
    inputs = np.tile(np.repeat([0.02, 0.05, 0.005], 3), len(JOINTS))
    drive = 0.15 * rng.normal(size=(COUNT, len(inputs))) * inputs
    more = 0.15 * rng.normal(size=drive.shape) * np.abs(drive).mean()
    reach = np.array([[-3.0], [3.0]])
    limits = np.tile(np.repeat([60.0, 20.0, 300.0], 3), len(JOINTS))
    arrays = np.array([history, 0.002 * history]), np.array([drive, more])
    return replace(
        body, dynamics=Dynamics(directions, DynamicsRegressor(*arrays, JOINTS, RATE, limits, reach))
    )


def moving(body: BodyModel, frames: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A person of random shape in smooth motion: betas, pose, trans."""
    rng = np.random.default_rng(seed)
    prior = shipped_prior().for_joints(body.joint_names)
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    spread = np.sqrt(np.diag(prior.covariance))
    return betas, *smooth_motion(np.asarray(prior.mean), spread, frames, RATE, rng)


def people(
    body: BodyModel, count: int, frames: int, noise: float, first: int = 0
) -> list[MovingSurface]:
    """People whose surfaces are known, two sequences each."""
    found = []
    for k in range(2 * count):
        betas, pose, trans = moving(body, frames, first + k)
        betas = moving(body, 3, 1000 + first + k // 2)[0]
        delta = simulate_soft_tissue(body, betas, pose, trans, RATE)
        surfaces = body(betas, pose, trans, dynamics=delta).vertices
        surfaces = (surfaces + noise * np.random.default_rng(k).normal(size=surfaces.shape)).astype(
            np.float32
        )
        subject = f"p{first + k // 2}"
        names = tuple(f"p{first + k // 2}_{k}:{t}" for t in range(frames))
        words = {
            "subject": (subject,) * frames,
            "sex": ("",) * frames,
            "set": ("pose",) * frames,
            "name": names,
        }
        meshes = Registrations(surfaces, body.faces, **words)
        found.append(MovingSurface(f"{subject}_{k}", subject, RATE, meshes, betas, pose, trans))
    return found


def prediction(body: BodyModel) -> dict[str, float]:
    """Frames a second, and what is left two seconds after ten minutes of motion."""
    minute = moving(body, 3600, 7)
    betas, (pose, trans) = (
        minute[0],
        (np.tile(part, (10, *[1] * (part.ndim - 1))) for part in minute[1:]),
    )
    stop = 240
    pose = np.concatenate([pose, np.tile(pose[-1:], (stop, 1, 1))])
    trans = np.concatenate([trans, np.tile(trans[-1:], (stop, 1))])
    seconds = []
    own = []
    for _ in range(3):
        began = time.perf_counter()
        mine = time.thread_time()
        found = simulate_soft_tissue(body, betas, pose, trans, RATE)
        seconds.append(time.perf_counter() - began)
        own.append(time.thread_time() - mine)
    sizes = np.abs(found).max(1)
    minutes = sizes[:36_000].reshape(10, -1).max(1)
    return {
        "frames": len(pose),
        "frames_per_second": len(pose) / float(np.median(seconds)),
        "frames_per_second_of_processor_time": len(pose) / float(np.median(own)),
        "largest_coefficient_by_minute": minutes.tolist(),
        "left_after_2_s": float(sizes[36_000 + 121 :].max() / minutes.max()),
    }


def main() -> None:
    """Print the tables and write the numbers."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--people", type=int, default=6)
    arguments.add_argument(
        "--frames", type=int, default=300, help="of each of two sequences a person"
    )
    arguments.add_argument(
        "--noise", type=float, default=1.0, help="mm of each coordinate of a surface"
    )
    arguments.add_argument("--threads", type=int, default=os.cpu_count())
    options = arguments.parse_args()
    told = machine()
    truth = planted(load_body("default"))
    numbers: dict = {"machine": told, "prediction": prediction(truth)}
    workers = Threads(options.threads)
    bare = replace(truth, dynamics=None)
    data = people(truth, options.people, options.frames, 1e-3 * options.noise)
    began = time.perf_counter()
    found = learn_dynamics(bare, data, DynamicsOptions(personal=False), workers)
    frames = sum(map(len, data))
    numbers["training"] = {"frames": frames, "seconds": time.perf_counter() - began}
    spans = [
        np.linalg.qr(body.dynamics.directions.reshape(-1, COUNT))[0] for body in (found.body, truth)
    ]
    numbers["cosines_of_spans"] = np.linalg.svd(spans[0].T @ spans[1])[1].tolist()
    numbers["modes"] = {"found": found.modes.tolist(), "planted": swinging(truth.dynamics).tolist()}
    numbers["held_out_error"] = found.choices[0].error
    errors = [
        one.errors
        for one in evaluate_dynamics(
            found.body, people(truth, 2, options.frames, 0.0, 500), workers
        )
    ]
    mean = np.sqrt(np.mean(np.square(errors), axis=0))
    numbers["test"] = {
        way: dict(zip(QUANTITIES, row, strict=True))
        for way, row in zip(MODES, mean.tolist(), strict=True)
    }
    print(in_words(told))
    print(
        f"prediction: {numbers['prediction']['frames_per_second']:,.0f} frames/s, one thread "
        f"({numbers['prediction']['frames_per_second_of_processor_time']:,.0f} a second of "
        "processor time)"
    )
    least, most = (
        edge(numbers["prediction"]["largest_coefficient_by_minute"]) for edge in (min, max)
    )
    print(f"  largest coefficient in each of ten minutes: {least:.2f} to {most:.2f}")
    print(f"  share left 2 s after it stopped: {numbers['prediction']['left_after_2_s']:.1g}")
    print(
        f"training: {frames} frames in {numbers['training']['seconds']:.0f} s; "
        f"span's worst cosine {min(numbers['cosines_of_spans']):.4f}"
    )
    for hz, ratio in found.modes:
        print(f"  swings at {hz:.2f} Hz, damping {ratio:.3f}")
    print(
        "people and motions not seen, root mean squares (place mm, velocity mm/s, acceleration "
        "m/s²):"
    )
    for way, row in zip(MODES, mean, strict=True):
        print(f"  {way:10} {row[0]:8.2f} {row[1]:8.1f} {row[2]:8.2f}")
    write_json(options.out, numbers)


if __name__ == "__main__":
    main()
