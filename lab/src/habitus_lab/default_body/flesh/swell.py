"""Learn the bodies' dynamics from people that `shake.py` moved, measure them, put them into the
bodies' files.

    python -m habitus_lab.default_body.flesh.swell --shakes FOLDER --out FOLDER [--bodies female male
    neutral] [--ship FOLDER]

Kept out of the learning, and measured on: every piece of the motion `--test-motion` (a new motion
of known people), and everything of the build `--test-build` (a new person). The neutral body learns
from both sexes, whose people it tells by the betas nearest to their rest surfaces. FOLDER/<body>/
receives what `habitus train-dynamics` writes and swell.json. With `--ship` the dynamics of
FOLDER/<body>/model.npz are put into SHIP/<body>.npz, and nothing is learned.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import habitus
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.dynamics import MODES, QUANTITIES, DynamicsErrors
from habitus.io.registrations.motions import open_moving_surfaces
from habitus.jobs.train_dynamics import train_dynamics
from habitus.learn.dynamics.sequences import MovingSurface
from habitus_lab.default_body.asset import write_asset

BODIES = {"female": ("female",), "male": ("male",), "neutral": ("female", "male")}
STEP = 2e-5  # m: blend shapes are kept in multiples of it, so that the file packs them well
FARTHEST = 0.15
FOLDED = 0.05  # m, share of frames: beyond, a piece is left out


def learn(name: str, options: argparse.Namespace) -> dict:
    """Learn the dynamics of a body, write them, and give the numbers."""
    shown, kept = _sequences(name, options)
    found = train_dynamics(shown, options.out / name, body=name, test=kept, workers=options.threads)
    groups = {
        "new motion, known people": [
            one for one in found.errors if _build(one.subject) != options.test_build
        ],
        "new person": [one for one in found.errors if _build(one.subject) == options.test_build],
    }
    numbers = {
        "body": name,
        "people": len({one.subject for one in shown}),
        "frames": sum(map(len, shown)),
        "test_frames": sum(map(len, kept)),
        "chosen_error": found.learned.choices[0].error,
        "shares": found.learned.shares.tolist(),
        "modes": found.learned.modes.tolist(),
        "errors": {key: _mean(some) for key, some in groups.items() if some},
        "prediction": prediction(found.body, kept or shown),
        "seconds": found.seconds,
    }
    (options.out / name / "swell.json").write_text(
        json.dumps(numbers, indent=1) + "\n", encoding="utf-8"
    )
    return numbers


def _sequences(
    name: str, options: argparse.Namespace
) -> tuple[list[MovingSurface], list[MovingSurface]]:
    """Those to learn from, and those kept out; with betas of the body."""
    shown = []
    kept = []
    for sex in BODIES[name]:
        source, target = (
            habitus.load_body(each, detail="full", joints="smplx") for each in (sex, name)
        )
        for path in sorted(options.shakes.glob(f"{sex}_*/*.npz")):
            with np.load(path) as arrays:
                farthest = arrays["farthest"].max()
                folded = (arrays["least"] < 0).mean()
            if farthest > FARTHEST or folded > FOLDED:
                print(
                    f"{path}: goes {1e3 * farthest:.0f} mm, inside out in {100 * folded:.0f} % of "
                    "frames; left out"
                )
                continue
            for one in open_moving_surfaces(path):
                moved = (
                    one if sex == name else replace(one, betas=_betas_of(target, source, one.betas))
                )
                new = _build(one.subject) == options.test_build or path.stem.startswith(
                    options.test_motion
                )
                (kept if new else shown).append(moved)
    if not shown:
        raise HabitusError(f"{options.shakes}: nobody to learn {name} from; simulate first")
    return shown, kept


def _betas_of(target: BodyModel, source: BodyModel, betas: np.ndarray | None) -> np.ndarray:
    """The betas of a body whose rest surface is nearest to that of another with its betas, held
    towards the mean.
    """
    away = source.rest_vertices(betas) - target.v_template
    directions = target.shapedirs.reshape(away.size, -1)
    held = directions.T @ directions + 1e-4 * away.size / 3 * 1e-4 * np.eye(directions.shape[1])
    return np.linalg.solve(held, directions.T @ away.ravel())


def _build(subject: str) -> str:
    return subject.split("_", 1)[1]


def _mean(errors: list[DynamicsErrors]) -> dict[str, dict[str, float]]:
    """Root mean squares over sequences by their lengths."""
    weights = np.array([len(one.fitted) for one in errors], float)
    squares = np.average([one.errors**2 for one in errors], axis=0, weights=weights)
    return {
        way: dict(zip(QUANTITIES, row, strict=True))
        for way, row in zip(MODES, np.sqrt(squares).tolist(), strict=True)
    }


def prediction(body: BodyModel, sequences: list[MovingSurface]) -> dict[str, float]:
    """Ten minutes of motions one after the other, then two seconds of rest: size by the minute,
    what is left, speed.
    """
    dynamics = body.dynamics
    assert dynamics is not None
    rate = dynamics.regressor.rate_hz
    sequences = [one.for_body(body) for one in sequences]
    betas = sequences[0].betas
    frames = int(600 * rate)
    stop = int(2 * rate)
    pose, trans = _on_and_on(sequences, frames)
    pose = np.concatenate([pose, np.repeat(pose[-1:], stop + 2, 0)])
    trans = np.concatenate([trans, np.repeat(trans[-1:], stop + 2, 0)])
    began = time.perf_counter()
    mine = time.thread_time()
    found = np.asarray(habitus.simulate_soft_tissue(body, betas, pose, trans, rate))
    seconds = time.perf_counter() - began
    own = time.thread_time() - mine
    size = np.abs(found).max(1)
    minutes = size[:frames].reshape(10, -1).max(1)
    return {
        "frames_per_second": len(pose) / seconds,
        "frames_per_second_of_processor_time": len(pose) / own,
        "largest_coefficient_by_minute": minutes.tolist(),
        "left_after_2_s": float(size[-1] / minutes.max()),
    }


def _on_and_on(sequences: list[MovingSurface], frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Motions to and fro, so that they are one without jumps: the first sequence that is long, as
    often as needed.
    """
    one = max(sequences, key=len)
    assert one.pose is not None and one.trans is not None
    there = np.concatenate([np.arange(len(one)), np.arange(len(one) - 2, 0, -1)])
    order = np.resize(there, frames)
    return one.pose[order], one.trans[order]


def ship(name: str, options: argparse.Namespace) -> str:
    """Put the dynamics that were learned into a body's file; gives a line about it."""
    path = options.ship / f"{name}.npz"
    learned = options.out / name / "model.npz"
    with np.load(path) as old, np.load(learned) as new:
        arrays = {key: old[key] for key in old.files if not key.startswith("dynamics")}
        if len(new["dynamicsdirs"]) != len(arrays["v_template"]):
            raise HabitusError(
                f"{learned}: {len(new['dynamicsdirs'])} vertices; {path} has "
                f"{len(arrays['v_template'])}"
            )
        arrays |= {key: new[key] for key in new.files if key.startswith("dynamics")}
    before = path.stat().st_size
    arrays["dynamicsdirs"] = (np.round(arrays["dynamicsdirs"] / STEP) * STEP).astype(np.float16)
    for key in ("dynamics_history", "dynamics_drive", "dynamics_limits", "dynamics_reach"):
        arrays[key] = arrays[key].astype(np.float32)
    write_asset(arrays, path)
    return f"{path}: {before / 1e6:.2f} MB before, {path.stat().st_size / 1e6:.2f} MB with dynamics"


def table(numbers: dict) -> str:
    """What one body learned, as lines."""
    lines = [
        f"{numbers['body']}: {numbers['frames']} frames of {numbers['people']} people, "
        f"{numbers['seconds']:.0f} s"
    ]
    lines += [
        "  swings: " + ", ".join(f"{hz:.1f} Hz ({ratio:.2f})" for hz, ratio in numbers["modes"])
    ]
    for group, errors in numbers["errors"].items():
        lines += [f"  {group} (place mm, velocity mm/s, acceleration m/s²)"]
        lines += [
            f"    {way:10}" + "".join(f"{errors[way][key]:10.2f}" for key in QUANTITIES)
            for way in MODES
        ]
    prediction = numbers["prediction"]
    minutes = prediction["largest_coefficient_by_minute"]
    lines += [
        f"  ten minutes: largest coefficient {min(minutes):.2f} to {max(minutes):.2f} by the "
        "minute, "
        f"{100 * prediction['left_after_2_s']:.2g} % left after 2 s; {prediction['frames_per_second']:,.0f} "
        "frames/s"
    ]
    return "\n".join(lines)


def main() -> None:
    """Learn, or ship what was learned."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shakes", type=Path, help="what shake.py made")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bodies", nargs="+", choices=tuple(BODIES), default=tuple(BODIES))
    parser.add_argument("--test-motion", default="nick_freeform", help="how names of pieces begin")
    parser.add_argument("--test-build", default="average")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--ship", type=Path, help="folder of the bodies' files")
    options = parser.parse_args()
    for name in options.bodies:
        print(
            ship(name, options) if options.ship is not None else table(learn(name, options)),
            flush=True,
        )


if __name__ == "__main__":
    main()
