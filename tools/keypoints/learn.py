"""Learns where a detector puts its keypoints on a body, and how well it finds them.

    python tools/keypoints/pictures.py learn CAPTURE... --people 120 --seed 1
    python tools/keypoints/pictures.py test OTHER_CAPTURE... --people 40 --seed 2
    python tools/keypoints/detect.py learn; python tools/keypoints/detect.py test
    python tools/keypoints/learn.py blazepose33 learn test

Each keypoint's place in its bone's frame, beside the joints and landmarks of
``habitus/assets/keypoints.toml``: the mean over people (left and right mirrored), the spread of
people about it, and the noise of one detection as a share of the person's height, by least squares
with Geman-McClure's loss over the pixels of known cameras. Prints the tables to be put into the
file, and the errors on the second folder's people with and without the learned places.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import habitus as hb
from habitus.observe.keypoints import KeypointRig, convention_names
from habitus.solve.terms import geman_mcclure_weight

REACH = 0.04
"""Of the robust loss, as a share of the person's height."""
WRONG = 0.1
"""Median error from which on a picture's detections are somebody else's, or nobody's."""
MIN_VISIBILITY = 0.5
PRIOR = 0.03
"""Standard deviation of a person's own place about the mean (m)."""
STEPS = 10


@dataclass(frozen=True)
class Seen:
    """Of each picture and keypoint: the pixel of the place without offset less the detected one, as
    a share of the height; its derivative by the offset (left side, m); whether it counts.
    """

    person: np.ndarray
    off: np.ndarray
    slope: np.ndarray
    there: np.ndarray


def seen(folder: Path, convention: str) -> Seen:
    """What the detector found in the pictures of a folder."""
    names = convention_names(convention)
    people = np.load(folder / "people.npz")
    found = np.load(folder / "detections.npz")["keypoints"]
    bodies = {name: hb.load_body(name) for name in ("female", "male")}
    rigs = {name: KeypointRig.of(body, names, "") for name, body in bodies.items()}
    mirror = np.array([name.startswith("right_") for name in names])
    off, slope = [], []
    for k, own in enumerate(found):
        rig = rigs[str(people["body"][k])]
        shaped = rig.shaped(people["betas"][k], np.zeros((len(names), 3)))
        world, _ = shaped.skeleton(people["pose"][k][None], np.zeros((1, 3)))
        points = shaped.points(people["pose"][k][None], np.zeros((1, 3)))[0]
        turn = people["rotation"][k]
        there = points @ turn.T + people["translation"][k]
        focal, depth = people["focal"][k], there[:, 2:]
        height = 1.7 * focal.mean() / depth.mean()
        pixels = focal * there[:, :2] / depth + people["centre"][k]
        by_point = np.zeros((len(names), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = focal[0] / depth[:, 0]
        by_point[:, :, 2] = -focal * there[:, :2] / depth**2
        by_offset = by_point @ turn @ world[0, rig.bone]
        by_offset[mirror, :, 0] *= -1.0
        off.append((pixels - own[:, :2]) / height)
        slope.append(by_offset / height)
    table = np.array(off)
    size = np.linalg.norm(table, axis=-1)
    right = np.nanmedian(np.where(np.isfinite(size), size, np.inf), axis=1) < WRONG
    there = np.isfinite(size) & (found[..., 2] > MIN_VISIBILITY) & right[:, None]
    return Seen(people["person"], np.nan_to_num(table), np.array(slope), there)


def learned(data: Seen, columns: list[int]) -> tuple[np.ndarray, np.ndarray, float]:
    """A keypoint's mean offset (3; m, left side), spread over people (3; m) and noise (share)."""
    off, slope = data.off[:, columns], data.slope[:, columns]
    there = data.there[:, columns]
    people = np.unique(data.person)
    mean = np.zeros(3)
    own = np.zeros((len(people), 3))
    noise = 0.02
    for _ in range(STEPS):
        moved = own[np.searchsorted(people, data.person)] + mean
        rest = off + np.einsum("pcui,pi->pcu", slope, moved)
        weight = there * geman_mcclure_weight(np.linalg.norm(rest, axis=-1), REACH)
        noise = np.sqrt((weight * (rest**2).sum(-1)).sum() / (2.0 * weight.sum()))
        matrix = np.einsum("pc,pcui,pcuj->pij", weight, slope, slope) / noise**2
        right = -np.einsum("pc,pcui,pcu->pi", weight, slope, off) / noise**2
        whole, pull = np.zeros((3, 3)), np.zeros(3)
        parts = []
        for k, who in enumerate(people):
            rows = data.person == who
            a, b = matrix[rows].sum(0), right[rows].sum(0)
            gain = np.linalg.inv(np.eye(3) + PRIOR**2 * a)  # the mean's share of one's own data
            whole, pull = whole + a @ gain, pull + gain.T @ b
            parts.append((k, a, b))
        mean = np.linalg.solve(whole + 1e-6 * np.eye(3), pull)
        for k, a, b in parts:
            own[k] = np.linalg.solve(a + np.eye(3) / PRIOR**2, b - a @ mean)
    return mean, own.std(0), float(noise)


def main() -> None:
    """Learn, judge and print."""
    options = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    options.add_argument("convention")
    options.add_argument("learn", type=Path)
    options.add_argument("test", type=Path)
    asked = options.parse_args()
    names = convention_names(asked.convention)
    data, other = seen(asked.learn, asked.convention), seen(asked.test, asked.convention)
    print(f"# {data.there.any(1).mean():.0%} of {len(data.off)} pictures; judged on "
          f"{other.there.any(1).mean():.0%} of {len(other.off)}")  # fmt: skip
    errors = []
    for plain in dict.fromkeys(n.removeprefix("left_").removeprefix("right_") for n in names):
        columns = [k for k, n in enumerate(names) if n.endswith(plain) and
                   n.removeprefix("left_").removeprefix("right_") == plain]  # fmt: skip
        mean, spread, noise = learned(data, columns)
        if len(columns) == 1:
            mean[0] = 0.0
        there = other.there[:, columns]
        as_is = np.linalg.norm(other.off[:, columns], axis=-1)[there]
        moved = other.off[:, columns] + other.slope[:, columns] @ mean
        better = np.linalg.norm(moved, axis=-1)[there]
        errors.append((plain, np.median(as_is), np.median(better)))
        place = ", ".join(f"{x:.4f}" for x in mean)
        print(f"[{asked.convention}.{plain}]\noffset = [{place}]\n"
              f"definition = {max(0.003, float(np.sqrt((spread**2).mean()))):.4f}\n"
              f"noise = {noise:.4f}")  # fmt: skip
    print("# keypoint: median error on the other people, % of the height, before and after")
    for plain, before, after in errors:
        print(f"# {plain:12s} {100 * before:5.2f} {100 * after:5.2f}")
    both = 100 * np.array([error[1:] for error in errors]).mean(0)
    print(f"# mean         {both[0]:5.2f} {both[1]:5.2f}")


if __name__ == "__main__":
    main()
