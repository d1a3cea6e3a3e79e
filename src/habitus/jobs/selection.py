"""Marker sets and poses chosen for a goal (M 7, M 10). Names and files in, layouts, numbers and
pictures out.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.prior import PosePrior
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.export.npz import motion_arrays, write_arrays
from habitus.files import whole_folder, write_text
from habitus.fit.markers.energy import place
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.selection.full import best_states
from habitus.fit.selection.greedy import Step, additions, removals
from habitus.fit.selection.held_out import held_out_people
from habitus.fit.selection.poses import PoseChoice, choose_poses
from habitus.fit.selection.problem import NOISE, linearised
from habitus.io.layouts.files import save_layout
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.jobs.bodies import loaded
from habitus.jobs.marker_pools import Pool, find_layout, find_pool
from habitus.markers.layouts import MarkerLayout
from habitus.parallel.choose import WorkersLike, open_workers
from habitus.report.diagrams import curve_picture, marker_picture
from habitus.types import PathLike, Progress

SAMPLE = 500  # vertices at which the best state of a held-out surface is fitted
APART = 0.06  # metres of an ankle from the body's middle, in poses that somebody holds
FILES = ("selection.json", "curve.svg", "markers.svg")
KINDS = ("of the start", "of the {count} best to add", "others that were considered")


@dataclass(frozen=True, eq=False)
class Selection:
    """A path of marker sets, each a marker or a pair more or less than the next; ``pool`` is all
    there was.

    ``removed`` goes down from the start, ``added`` up; each `Step` holds its groups and error (m,
    root mean square).
    """

    body: BodyModel
    pool: Pool
    goal: str
    region: str
    removed: tuple[Step, ...]
    added: tuple[Step, ...]

    @property
    def errors(self) -> Mapping[int, float]:
        """The error (m) by the number of markers."""
        steps = (*self.removed[::-1], *self.added[1:])
        return {self.pool.candidates.count(step.groups): step.error for step in steps}

    @property
    def start(self) -> int:
        """How many markers it began with."""
        return self.pool.candidates.count(self.added[0].groups)

    def layout(self, count: int) -> MarkerLayout:
        """The set of at most so many markers. Raises HabitusError where the path has none as
        small.
        """
        found = [
            step
            for step in (*self.removed, *self.added)
            if self.pool.candidates.count(step.groups) <= count
        ]
        if not found:
            raise HabitusError(f"no set of {count} markers; the smallest has {min(self.errors)}")
        best = max(found, key=lambda step: len(step.groups))
        chosen = sorted(k for group in best.groups for k in self.pool.candidates.groups[group])
        said = (
            f"Chosen for the error of the {self.goal} ({self.region}), expected "
            f"{1e3 * best.error:.1f} mm, of "
        )
        return replace(
            self.pool.layout.restricted_to(tuple(self.pool.candidates.labels[k] for k in chosen)),
            name=f"selected-{len(chosen)}",
            title=f"{len(chosen)} markers chosen for the {self.goal} ({self.region})",
            description=f"{said}{len(self.pool.candidates.labels)} candidates.",
        )


def select_markers(
    pool: int | str | Sequence[str] = 114,
    start: int | PathLike = "mosh-47",
    *,
    goal: str = "surface",
    region: str = "all",
    pairs: bool = False,
    min_markers: int = 5,
    people: int = 40,
    keep: Sequence[int] = (25, 67),
    body: PathLike | BodyModel = "default",
    seed: int = 0,
    workers: WorkersLike = None,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> Selection:
    """Which markers tell a body best: from a set markers go one by one, and others come (M 7, eqs.
    11 to 13).

    pool: so many candidates, those of ``start`` and landmarks spread over the body, or the layouts
    that have them. start: a layout (47 and 67 are MoSh's). goal: error of the posed "surface" (eq.
    13), of the "shape" at rest, or of joints in their "pose"; region: of all, legs, arms, trunk or
    head. pairs: left and right go together. people: posed, held out, drawn from other shape spaces
    than the body's, with skin that no space explains. out: a folder for selection.json, curve.svg,
    markers.svg and a layout for each number in ``keep``. progress: told (stage, share done). Raises
    HabitusError for names that there are not, and for too small a pool.
    """
    tell = progress or (lambda stage, share: None)
    model = loaded(body)
    prior = prior_of(model)
    found = find_pool(model, pool, find_layout(start), pairs)
    tell("people", 0.0)
    others = [load_body(name) for name in ("female", "male")] if _shares_mesh(model) else [model]
    drawn = held_out_people(others, prior, people, seed)
    vertices = np.unique(np.linspace(0, model.num_vertices - 1, SAMPLE).astype(int))
    known = best_states(model, prior, drawn, vertices)
    problem = linearised(model, prior, known, found.candidates, goal, region)
    with open_workers(workers) as shared:
        least = min(len(found.start), max(1, -(-min_markers // (2 if pairs else 1))))
        removed = _told(
            removals(problem, found.start, least, shared), "remove", len(found.start) - least, tell
        )
        most = len(found.candidates.groups)
        added = _told(
            additions(problem, found.start, most, shared), "add", most - len(found.start), tell
        )
    selection = Selection(model, found, goal, region, removed, added)
    if out is not None:
        _write(selection, Path(out), keep)
    return selection


def _told(steps: Iterator[Step], stage: str, count: int, tell: Progress) -> tuple[Step, ...]:
    out = []
    for step in steps:
        out.append(step)
        tell(stage, min(1.0, len(out) / max(count, 1)))
    return tuple(out)


def _shares_mesh(body: BodyModel) -> bool:
    return body.name in SHIPPED and body.age is None


def _write(found: Selection, folder: Path, keep: Sequence[int]) -> None:
    layouts = {f"markers-{count}.toml": found.layout(count) for count in keep}
    best = 20
    kinds = _kinds(found, best)
    names = [name.format(count=best) for name in KINDS]
    with whole_folder(folder, (*FILES, *layouts)) as partial:
        write_text(partial / "selection.json", json.dumps(_numbers(found), indent=1) + "\n")
        write_text(
            partial / "curve.svg",
            curve_picture(found.errors, found.start, f"{found.goal}, {found.region}"),
        )
        picture = marker_picture(found.body, found.pool.candidates.vertices, kinds, names)
        write_text(partial / "markers.svg", picture)
        for name, layout in layouts.items():
            save_layout(layout, partial / name)


def _kinds(found: Selection, best: int) -> list[int]:
    """0 for the markers of the start, 1 for the first that were added, 2 for the others."""
    groups = found.pool.candidates.groups
    kinds = np.full(len(found.pool.candidates.labels), 2)
    more = [step.group for step in found.added[1:] if step.group is not None]
    for group in more:
        if (kinds == 1).sum() < best:
            kinds[list(groups[group])] = 1
    for group in found.added[0].groups:
        kinds[list(groups[group])] = 0
    return kinds.tolist()


def _numbers(found: Selection) -> dict[str, object]:
    """The path as JSON has it: which labels go and come, and the error at each number of
    markers.
    """
    labels = found.pool.candidates.labels
    groups = found.pool.candidates.groups

    def told(steps: Sequence[Step]) -> list[dict[str, object]]:
        return [
            {
                "markers": found.pool.candidates.count(step.groups),
                "changed": [] if step.group is None else [labels[k] for k in groups[step.group]],
                "error_mm": round(1e3 * step.error, 3),
            }
            for step in steps
        ]

    return {
        "goal": found.goal,
        "region": found.region,
        "candidates": list(labels),
        "start": [labels[k] for group in found.added[0].groups for k in groups[group]],
        "marker_noise_mm": round(1e3 * NOISE, 2),
        "removed": told(found.removed),
        "added": told(found.added),
    }


def select_poses(
    layout: PathLike = "mosh-47",
    count: int = 12,
    *,
    candidates: int = 200,
    body: PathLike | BodyModel = "default",
    seed: int = 0,
    workers: WorkersLike = None,
    out: PathLike | None = None,
) -> tuple[PoseChoice, Float[np.ndarray, "count J 3"]]:
    """The ``count`` poses that together tell a person's shape best with a layout's markers: a body
    scan (M 10).

    candidates: poses to choose among, plain ones (arms down, T-pose, sitting, crouching, arms up)
    and others drawn from the pose prior, with both legs alike and the body over its feet, so that
    they can be held. out: an .npz that receives the poses as a motion of one pose a second, with
    AMASS's names. Returns the choice and the poses (rad). Raises HabitusError for a layout that the
    body has not, and for fewer candidates than poses.
    """
    if not 0 < count <= candidates:
        raise HabitusError(
            f"{count} poses of {candidates}; expected 1 or more, and no more than there are"
        )
    model = loaded(body)
    prior = prior_of(model)
    found = find_layout(layout)
    poses = _candidate_poses(model, prior, candidates, seed)
    with open_workers(workers) as shared:
        choice = choose_poses(
            model, prior, place(found, model), poses, count, seed=seed, workers=shared
        )
    chosen = poses[list(choice.poses)]
    if out is not None:
        _write_poses(model, chosen, choice, found, Path(out))
    return choice, chosen


def _candidate_poses(
    body: BodyModel, prior: PosePrior, count: int, seed: int
) -> Float[np.ndarray, "N J 3"]:
    own = prior.for_joints(body.joint_names)
    rng = np.random.default_rng(seed)
    plain = np.stack([plain_pose(body.joint_names, angles) for angles in PLAIN_POSES])[:count]
    drawn = (
        own.mean
        + rng.normal(size=(count - len(plain), len(own.mean)))
        @ np.linalg.cholesky(own.covariance).T
    )
    poses = drawn.reshape(len(drawn), len(own.joint_names), 3)
    poses = np.concatenate([plain, np.concatenate([np.zeros((len(poses), 1, 3)), poses], axis=1)])
    return np.stack([_stood(body, pose) for pose in poses])


def _stood(body: BodyModel, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
    """A pose that can be held: legs apart, the right as the left, and the body leaning so that it
    is over its feet.
    """
    out = pose.copy()
    names = body.joint_names
    left = {
        part: names.index(f"left_{part}")
        for part in ("hip", "knee", "ankle", "foot")
        if f"left_{part}" in names
    }
    if body((), out, vertices=[0]).joints[left["ankle"], 0] < APART:
        out[left["hip"]] *= [1, -1, -1]
    for part, joint in left.items():
        out[names.index(f"right_{part}")] = out[joint] * [1, -1, -1]
    surface = body((), out)
    over = surface.vertices.mean(axis=0) - surface.joints[
        [left["ankle"], names.index("right_ankle")]
    ].mean(axis=0)
    out[0] = [-np.arctan2(over[2], over[1]), 0.0, 0.0]
    return out


def _write_poses(
    body: BodyModel, poses: np.ndarray, choice: PoseChoice, layout: MarkerLayout, target: Path
) -> None:
    if target.suffix.lower() != ".npz":
        raise HabitusError(f"cannot write poses to {target.name}: expected a name in .npz")
    standing = [-float(body((), pose).vertices[:, 1].min()) for pose in poses]
    motion = BodyMotion(
        body,
        np.zeros(body.num_betas),
        poses,
        np.outer(standing, [0.0, 1.0, 0.0]),
        rate_hz=1.0,
        up_axis="+y",
        capture_name=target.stem,
        body_name=body.name,
        made=(f"poses that constrain the shape best with the layout {layout.name}, best first",),
    )
    errors = {"shape_error_mm": 1e3 * np.array(choice.errors)}
    write_arrays(target, motion_arrays(motion) | {"made": np.array(motion.made)} | errors)
