"""Builds the pose prior that ships with the body: published ranges of motion, re-estimated from
fitted captures.

    python tools/pose_prior/build.py CAPTURE... [--out src/habitus/assets/pose_prior.npz] [--rounds
    1] [--body default]

Each round fits the captures with the prior so far at twice its spread, or it would only confirm
itself (shape stage, then single frames, each by itself, so that no motion counts twice), and blends
the poses' mean and covariance with those of the ranges. Every capture counts the same; captures
whose names begin alike (five characters) count as one person.
"""

import argparse
from itertools import groupby
from pathlib import Path

import numpy as np
from ranges import range_prior

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, shipped_prior
from habitus.files import atomic_write
from habitus.fit.markers.recordings import random_frames
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import MoshSettings, SequenceSettings
from habitus.fit.markers.start import start_sequence
from habitus.fit.markers.subject import fit_subject
from habitus.io.captures.read import read_capture
from habitus.io.models.bodies import load_body
from habitus.jobs.subjects import person_of

FRAMES = 120
TRUST_MEAN = 0.8
TRUST_COVARIANCE = 0.5
LOOSER = 2.0  # times the prior's standard deviations, in the fits that it is learned from
UNSEEN = (
    "left_hand",
    "right_hand",
    "left_foot",
    "right_foot",
)  # no marker tells these: they keep their ranges


def poses_of(path: Path, prior: PosePrior, body: BodyModel) -> np.ndarray:
    """(F, 3 (J - 1)) joint rotations of some frames of a capture."""
    someone = person_of([read_capture(path)], "auto")
    seen = np.isfinite(someone.recordings[0].observed[..., 0]).any(axis=0)
    layout = someone.layout.restricted_to(
        tuple(x for x, s in zip(someone.layout.labels, seen, strict=True) if s)
    )
    observed = someone.recordings[0].observed[:, seen]
    recording = type(someone.recordings[0])(path.stem, observed, someone.recordings[0].rate_hz)
    subject = fit_subject(body, prior, layout, [recording], MoshSettings())
    observed = observed[random_frames(observed, FRAMES, 0)]
    pose, trans = start_sequence(subject.rig, subject.shape.pose, body.joint_names, observed)
    scales = np.full(observed.shape[1], 0.1)
    result = fit_sequence(
        subject.rig, observed, None, scales, prior, pose, trans, SequenceSettings(acceleration=0.0)
    )
    return result.pose[:, 1:].reshape(len(observed), -1)


def re_estimate(prior: PosePrior, people: list[list[np.ndarray]]) -> PosePrior:
    """The ranges blended with the poses of some people in the joints of ``prior``, left and right
    made alike.
    """
    begin = range_prior().for_joints(("pelvis", *prior.joint_names))
    means = []
    covariances = []
    for captures in people:
        poses = np.concatenate(
            [p[np.linspace(0, len(p) - 1, FRAMES // len(captures)).astype(int)] for p in captures]
        )
        poses = np.concatenate([poses, mirrored(poses, prior.joint_names)])
        means.append(poses.mean(axis=0))
        covariances.append(poses)
    mean = np.mean(means, axis=0)
    spread = np.mean([(p - mean).T @ (p - mean) / len(p) for p in covariances], axis=0)
    mean = TRUST_MEAN * mean + (1 - TRUST_MEAN) * begin.mean
    covariance = TRUST_COVARIANCE * spread + (1 - TRUST_COVARIANCE) * begin.covariance
    for name in UNSEEN:
        rows = 3 * prior.joint_names.index(name) + np.arange(3)
        covariance[rows], covariance[:, rows] = begin.covariance[rows], begin.covariance[:, rows]
        mean[rows] = begin.mean[rows]
    return PosePrior(prior.joint_names, mean, covariance)


def completed(prior: PosePrior) -> PosePrior:
    """The prior with the joints that it lacks as their ranges are."""
    begin = range_prior()
    whole = begin.covariance.copy()
    known = [begin.joint_names.index(name) for name in prior.joint_names]
    rows = np.add.outer(3 * np.array(known), np.arange(3)).ravel()
    mean = begin.mean.copy()
    mean[rows], whole[np.ix_(rows, rows)] = prior.mean, prior.covariance
    return PosePrior(begin.joint_names, mean, whole)


def mirrored(poses: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Poses (F, 3 N) of the mirror image of the body."""
    swap = {"left": "right", "right": "left"}
    order = [
        names.index("_".join(swap.get(word, word) for word in name.split("_"))) for name in names
    ]
    return (poses.reshape(len(poses), -1, 3)[:, order] * np.array([1.0, -1.0, -1.0])).reshape(
        len(poses), -1
    )


def main() -> None:
    """Read the captures, iterate, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("src/habitus/assets/pose_prior.npz"))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--body", default="default")
    options = parser.parse_args()
    body = load_body(options.body)
    prior = shipped_prior().for_joints(body.joint_names)
    for round_ in range(options.rounds):
        by_person = groupby(sorted(options.captures), key=lambda path: path.stem[:5])
        loose = PosePrior(prior.joint_names, prior.mean, LOOSER**2 * prior.covariance)
        people = [[poses_of(path, loose, body) for path in paths] for _, paths in by_person]
        prior = re_estimate(prior, people)
        print(
            f"round {round_ + 1}: {len(people)} people, {sum(map(len, people))} captures",
            flush=True,
        )
    built = completed(prior)
    with atomic_write(options.out) as temporary:
        np.savez_compressed(
            temporary,
            joint_names=np.array(built.joint_names),
            mean=built.mean,
            covariance=built.covariance,
        )


if __name__ == "__main__":
    main()
