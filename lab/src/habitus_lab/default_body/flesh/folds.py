"""Learn hinge channels of knees and elbows, and their turns about rare axes, from the further round
of the simulation, on top of a shipped body's pose blend shapes (`habitus.learn.steps.hinges`).

    python -m habitus_lab.default_body.flesh.folds FLESH [female male neutral] [--bodies FOLDER]
        [--write] [--numbers FILE]

FLESH is what `run.py --further --gather` wrote. What earlier poses say of a joint's blend shapes is
kept by their moments (`damping.trained_poses`). The left side is learned, from everyone and their
mirror images; the right side is its mirror image. Collars are left as they are: in the earlier
poses they move with shoulders, and a change of one alone lets acromia sink.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.steps.hinges import (
    FEATURES,
    Channels,
    Fold,
    Sample,
    channels_of,
    driven_vertices,
    residual,
    solve_fold,
    with_folds,
)
from habitus_lab.default_body.asset import DESCRIPTION, FOLDED, VERSION, write_asset
from habitus_lab.default_body.flesh.damping import FLIP, trained_poses
from habitus_lab.default_body.flesh.poses import SEXES
from habitus_lab.default_body.rig import JOINT_MIRROR
from habitus_lab.repository import BODIES

BEGINS = (60.0, 90.0, 115.0, 135.0)  # degrees of a bend where channels begin
AXES = {"left_knee": (1.0, 0.0, 0.0), "left_elbow": (0.0, -1.0, 0.0)}  # of a bend
SHAPES = 2  # betas that channels are multiplied with: a third tells nothing more of a fold
KNOWN = 0.05  # of the earlier poses' moments: channels take over a part of what these held
PRIOR = 0.03  # with .003 errors are the same, and knees turned aside by 60 degrees lose .4 litres
RIDGE = 3e-3
DEEP = 115.0
CREASE = 0.012  # degrees; m: skin that skinning leaves so far off in deeper folds counts as crease
BINS = (4, 30, 60, 90, 115, 200)
LEAST = 1e-4  # m: a vertex whose channels move it less has none
TURNED = np.outer(FLIP, FLIP).ravel()


@dataclass(frozen=True, eq=False)
class Surface:
    """A simulated surface: whose it is, whether it is of the set "test", and the sample."""

    person: str
    tested: bool
    sample: Sample


def surfaces(folder: Path, body: BodyModel, sexes: tuple[str, ...]) -> Iterator[Surface]:
    """Those of everyone in the folders of some sexes; betas are those nearest to the rest
    surface.
    """
    flat = body.shapedirs.reshape(-1, body.num_betas)
    for path in (path for sex in sexes for path in sorted((folder / sex).glob("*.npz"))):
        with np.load(path) as file:
            arrays = {key: file[key] for key in ("vertices", "weights", "pose", "set")}
            rest = file["rest"][0].astype(float)
        betas = np.linalg.lstsq(flat, (rest - body.v_template).ravel(), rcond=None)[0]
        joints = body.joint_regressor @ rest
        for k, word in enumerate(arrays["set"]):
            given = (arrays[key][k].astype(float) for key in ("vertices", "weights", "pose"))
            sample = Sample(*given, rest, joints, betas)
            yield Surface(path.stem.rstrip("m"), word == "test", sample)


def learn(body: BodyModel, data: list[Surface], space: str) -> BodyModel:
    """The body with channels learned from everything that is not of the set "test"."""
    samples = [one.sample for one in data if not one.tested]
    earlier = trained_poses(space)
    folds = []
    for name in AXES:
        joint = body.joint_names.index(name)
        channels = channels_of(body, name, np.array(AXES[name]), BEGINS)
        features = FEATURES.value(earlier[:, joint])
        moments = features.T @ features / len(features)
        known = KNOWN * moments
        folds.append(solve_fold(body, channels, samples, SHAPES, known, PRIOR, RIDGE))
    return with_folds(body, [*folds, *(mirrored(fold, body.mirror) for fold in folds)])


def mirrored(fold: Fold, mirror: np.ndarray) -> Fold:
    """What was learned, seen in a mirror."""
    channels = Channels(
        JOINT_MIRROR[fold.channels.joint], fold.channels.rows * TURNED, fold.channels.bias
    )
    return Fold(
        channels,
        mirror[fold.vertices],
        FLIP[:, None] * fold.change * TURNED,
        FLIP[:, None, None] * fold.directions,
        fold.linear * TURNED,
    )


def crease(body: BodyModel, data: list[Surface], joint: int) -> np.ndarray:
    """The vertices that plain skinning leaves `CREASE` off, on average, where a joint turns by over
    `DEEP` degrees; all that it drives where it never does.
    """
    vertices = driven_vertices(body, joint)
    plain = replace(body, posedirs=None, hinges=None, finer=None)
    deep = [one.sample for one in data if degrees(one, joint) > DEEP]
    if not deep:
        return vertices
    off = [np.linalg.norm(residual(plain, sample, vertices)[1], axis=1) for sample in deep]
    return vertices[np.mean(off, axis=0) > CREASE]


def degrees(surface: Surface, joint: int) -> float:
    """By which a joint is turned."""
    return float(np.degrees(np.linalg.norm(surface.sample.pose[joint])))


def errors(
    bodies: dict[str, BodyModel], data: list[Surface], people: set[str]
) -> dict[str, dict[str, float]]:
    """Mean distance (mm) from raw surfaces of the set "test" of some people, by joint and its turn,
    of each body, and how many surfaces there are.
    """
    tested = [one for one in data if one.tested]
    table: dict[str, dict[str, list[float]]] = {}
    shipped = bodies["shipped"]
    for name in AXES:
        joint = shipped.joint_names.index(name)
        vertices = crease(shipped, tested, joint)
        for one in tested:
            turn = degrees(one, joint)
            if one.person not in people or turn < BINS[0]:
                continue
            low = max(b for b in BINS if b <= turn)
            row = table.setdefault(f"{name} from {low:3d}", {word: [] for word in bodies})
            for word, body in bodies.items():
                off = np.linalg.norm(residual(body, one.sample, vertices)[1], axis=1)
                row[word].append(1e3 * float(off.mean()))
    return {
        key: {word: float(np.mean(each)) for word, each in row.items()}
        | {"surfaces": len(row["shipped"])}
        for key, row in sorted(table.items())
    }


def write(path: Path, body: BodyModel, space: str) -> None:
    """Put the learned arrays into a shipped body's file."""
    with np.load(path) as own:
        arrays = dict(own)
    if FOLDED in str(arrays["description"]):
        raise HabitusError(f"{space}: it has hinge channels already; expected a body without")
    assert body.posedirs is not None and body.hinges is not None
    hinges = body.hinges
    moved = np.abs(hinges.directions).max((1, 2, 3), keepdims=True) > LEAST
    arrays |= {
        "posedirs": body.posedirs.astype(np.float16),
        "hinge_joints": hinges.joint.astype(np.int32),
        "hinge_rows": hinges.rows.astype(np.float32),
        "hinge_bias": hinges.bias.astype(np.float32),
        "hinge_linear": hinges.linear.astype(np.float32),
        "hingedirs": (hinges.directions * moved).astype(np.float16),
        "description": np.array(DESCRIPTION.format(space=space, pose=FOLDED)),
        "version": np.array(VERSION),
    }
    write_asset(arrays, path)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Learn, measure, write."""
    options = _options()
    numbers = {}
    for space in options.spaces:
        body = load_body(space, detail="full", joints="smplx")
        data = list(surfaces(options.flesh, body, SEXES if space == "neutral" else (space,)))
        folded = learn(body, data, space)
        plain = replace(body, posedirs=None, hinges=None, finer=None)
        bodies = {"skinning": plain, "shipped": body, "folded": folded}
        known = {one.person for one in data if not one.tested}
        strangers = {one.person for one in data} - known
        for words, people in (("people left out", strangers), ("new poses", known)):
            numbers[f"{space}, {words}"] = found = errors(bodies, data, people)
            print(f"{space}, {words}")
            for key, row in found.items():
                print("  ", key, *(f"{word} {value:.1f}" for word, value in row.items()))
        if options.write:
            write(options.bodies / f"{space}.npz", folded, space)
    if options.numbers is not None:
        options.numbers.write_text(json.dumps(numbers, indent=1))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flesh", type=Path)
    parser.add_argument("spaces", nargs="*", default=["female", "male", "neutral"])
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--write", action="store_true", help="put them into the bodies' files")
    parser.add_argument("--numbers", type=Path, help="JSON of what is printed")
    return parser.parse_args()


if __name__ == "__main__":
    main()
