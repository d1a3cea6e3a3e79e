"""How much of a body's pose blend shapes do so many that bones can drive keep, in poses that no
file's motion has?

    python benchmarks/live_correctives.py [--body default] [--poses 200] [--out DIR]

Poses are drawn from the pose prior (people's), and from wider ones as animators may set them (twice
its variance and
0.1 rad in every axis of every joint). Left out is said of vertices at rest, before skinning turns
them. Prints a
table, writes live_correctives.json.
"""

import json
from pathlib import Path

import numpy as np
from common import in_words, machine, parser

import habitus
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.pose_features import pose_coefficients
from habitus.body.prior import shipped_prior
from habitus.export.animation import Animation, animate, one_sided
from habitus.export.correctives import sampled_rotations
from habitus.export.driven import drivers
from habitus.rotations import matrix_from_rotvec


def main() -> None:
    """Export, drive, compare."""
    arguments = parser(__doc__)
    arguments.add_argument("--body", default="default")
    arguments.add_argument("--poses", type=int, default=200)
    arguments.add_argument("--out", type=Path, default=Path("out/live_correctives"))
    options = arguments.parse_args()
    body = habitus.load_body(options.body)
    still = np.zeros((2, body.num_joints, 3))
    motion = BodyMotion(body, np.zeros(body.num_betas), still, still[:, 0], 30.0)
    poses = {
        "people's": _of_people(body, options.poses),
        "wider": sampled_rotations(body)[: options.poses],
    }
    rows = []
    for wanted in ("none", "live:48", "live:64", "live:96", "live:128", "all"):
        animation = one_sided(animate(motion, correctives=wanted))
        row = {"wanted": wanted, "channels": len(animation.morph_names)}
        for name, rotations in poses.items():
            away = np.concatenate(
                [_left_out(animation, some) for some in np.array_split(rotations, 10)]
            )
            told = np.sqrt((away**2).mean()), np.quantile(away, 0.99), away.max()
            row |= {
                f"{name}, {what}, mm": 1e3 * float(x)
                for what, x in zip(("rms", "99 %", "max"), told, strict=True)
            }
        rows.append(row)
        print(
            "  ".join(
                f"{key} {value:.2f}" if isinstance(value, float) else str(value)
                for key, value in row.items()
            )
        )
    options.out.mkdir(parents=True, exist_ok=True)
    found = {"machine": machine(), "body": body.name, "rows": rows}
    (options.out / "live_correctives.json").write_text(json.dumps(found, indent=1))
    print(f"{body.name}; {in_words(found['machine'])}")


def _of_people(body: BodyModel, count: int) -> np.ndarray:
    prior = shipped_prior().for_joints(body.joint_names)
    vectors = np.random.default_rng(7).multivariate_normal(prior.mean, prior.covariance, count)
    turns = matrix_from_rotvec(vectors.reshape(count, -1, 3))
    return np.concatenate([np.broadcast_to(np.eye(3), (count, 1, 3, 3)), turns], axis=1)


def _left_out(animation: Animation, rotations: np.ndarray) -> np.ndarray:
    """How far (m) vertices are from the body's own at rest, (T, V)."""
    body = animation.body
    posed = np.zeros((*rotations.shape[:2], 3)), rotations, np.zeros(body.num_betas)
    driven = body.features, body.hinges, body.shape_features, body.drivers
    directions = body.pose_directions
    known = pose_coefficients(*driven, *posed) @ directions.reshape(-1, directions.shape[-1]).T
    found = np.zeros_like(known)
    if animation.morph_drivers.live.any():
        joints = [
            body.joint_names.index(channel["joint"]) for channel in drivers(animation)["channels"]
        ]
        entries = (rotations[:, joints] - np.eye(3)).reshape(len(rotations), len(joints), 9)
        weights = animation.morph_drivers.weights(entries)
        found = weights @ animation.morphs.reshape(len(animation.morphs), -1)
    return np.linalg.norm((found - known).reshape(len(known), -1, 3), axis=-1)


if __name__ == "__main__":
    main()
