"""Learn hinge channels of knees and elbows, and their turns about rare axes, from simulated flesh,
on top of a body's pose blend shapes (`habitus.learn.steps.hinges`).

What all simulated poses say of a joint's blend shapes is kept by their moments. The left side is
learned, from everyone and their mirror images; the right side is its mirror image. Collars are left
as they are: they move with shoulders in most poses, and a change of one alone lets acromia sink.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
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
from habitus_lab.default_body.flesh.symmetry import FLIP
from habitus_lab.default_body.rig import JOINT_MIRROR

BEGINS = (60.0, 90.0, 115.0, 135.0)  # degrees of a bend where channels begin
AXES = {"left_knee": (1.0, 0.0, 0.0), "left_elbow": (0.0, -1.0, 0.0)}  # of a bend
SHAPES = 2  # betas that channels are multiplied with: a third tells nothing more of a fold
KNOWN = 0.05  # of the moments of all poses: channels take over a part of what these held
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


def folded_body(body: BodyModel, data: list[Surface]) -> BodyModel:
    """The body with channels learned from everything that is not of the set "test"."""
    samples = [one.sample for one in data if not one.tested]
    poses = np.array([one.pose for one in samples])
    folds = []
    for name in AXES:
        joint = body.joint_names.index(name)
        channels = channels_of(body, name, np.array(AXES[name]), BEGINS)
        features = FEATURES.value(poses[:, joint])
        known = KNOWN * features.T @ features / len(features)
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


def errors(bodies: dict[str, BodyModel], data: list[Surface]) -> dict[str, dict[str, float]]:
    """Mean distance (mm) from raw surfaces of the set "test", of people that were left out and of
    others, by joint and its turn, of each body, and how many surfaces there are.

    The last body's blend shapes determine which vertices a joint moves.
    """
    tested = [one for one in data if one.tested]
    known = {one.person for one in data if not one.tested}
    table: dict[str, dict[str, list[float]]] = {}
    last = list(bodies.values())[-1]
    for name in AXES:
        joint = last.joint_names.index(name)
        vertices = crease(last, tested, joint)
        for one in tested:
            turn = degrees(one, joint)
            if turn < BINS[0]:
                continue
            low = max(b for b in BINS if b <= turn)
            whose = "known people" if one.person in known else "people left out"
            row = table.setdefault(f"{whose}, {name} from {low:3d}", {word: [] for word in bodies})
            for word, body in bodies.items():
                off = np.linalg.norm(residual(body, one.sample, vertices)[1], axis=1)
                row[word].append(1e3 * float(off.mean()))
    return {
        key: {word: float(np.mean(each)) for word, each in row.items()}
        | {"surfaces": len(row[next(iter(bodies))])}
        for key, row in sorted(table.items())
    }
