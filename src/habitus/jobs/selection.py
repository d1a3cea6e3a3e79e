"""Markers to choose among: those of layouts, or a set's own and landmarks spread over the body."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.prior import PosePrior, prior_of
from habitus.errors import HabitusError
from habitus.export.npz import motion_arrays, write_arrays
from habitus.files import whole_folder, write_text
from habitus.fit.markers.energy import place
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.selection.full import best_states
from habitus.fit.selection.greedy import Step, additions, removals
from habitus.fit.selection.held_out import held_out_people
from habitus.fit.selection.poses import PoseChoice, choose_poses
from habitus.fit.selection.problem import (
    NOISE,
    SELECTION,
    Candidates,
    SelectionSettings,
    linearised,
)
from habitus.io.layouts.files import load_layout, save_layout
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.jobs.bodies import loaded
from habitus.jobs.options import MarkerSelectionOptions, PoseSelectionOptions, silent, takes
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.parallel.workers import WorkersLike, open_workers
from habitus.report.diagrams import curve_picture, marker_picture
from habitus.types import PathLike, Progress

_NOT_SKIN = (
    "thumb",
    "index",
    "middle",
    "ring",
    "pinky",
    "eye",
    "ear",
    "nose",
    "tip",
    "glabella",
    "sellion",
)


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates, the layout that holds them all, and the groups to start from."""

    candidates: Candidates
    layout: MarkerLayout
    start: tuple[int, ...]


def find_layout(start: int | PathLike) -> MarkerLayout:
    """A layout without its optional markers; a number is that of MoSh's sets. Raises
    HabitusError.
    """
    text = str(start)
    layout = load_layout(f"mosh-{text}" if text.isdigit() else text)
    return layout.restricted_to(
        tuple(marker.label for marker in layout.markers if not marker.optional)
    )


def find_pool(
    body: BodyModel,
    pool: int | str | Sequence[str],
    start: MarkerLayout,
    pairs: bool,
    settings: SelectionSettings = SELECTION,
) -> Pool:
    """The candidates that ``pool`` means (a number, or layouts), those of ``start`` first.

    Raises HabitusError for fewer than the start has.
    """
    text = str(pool) if isinstance(pool, int | str) else ",".join(pool)
    if text.isdigit():
        markers = _spread(body, list(start.markers), int(text), settings.min_distance)
    else:
        others = [
            marker for name in text.split(",") for marker in load_layout(name.strip()).markers
        ]
        markers = _apart(body, [*start.markers, *others], settings.min_distance)
    layout = MarkerLayout("candidates", tuple(markers), num_vertices=start.num_vertices)
    vertices = layout.vertices(body)
    groups = [(k,) for k in range(len(vertices))]
    if pairs:
        groups = _mirrored(body, vertices, settings.min_distance)
    first = tuple(
        k
        for k, group in enumerate(groups)
        if any(layout.labels[each] in start.labels for each in group)
    )
    return Pool(Candidates(layout.labels, vertices, tuple(groups)), layout, first)


def _spread(
    body: BodyModel, markers: list[Marker], count: int, min_distance: float
) -> list[Marker]:
    """``count`` markers: the given ones, then landmarks, each time the one farthest from all
    others, with its twin.
    """
    if count < len(markers):
        raise HabitusError(
            f"{count} candidates, and a start of {len(markers)} markers; expected more candidates"
        )
    names = [name for name in body.landmarks if not any(part in name for part in _NOT_SKIN)]
    places = {name: body.v_template[body.landmarks[name]] for name in names}
    taken = [
        body.v_template[vertex] for vertex in MarkerLayout("start", tuple(markers)).vertices(body)
    ]
    while len(markers) < count:
        distance = {
            name: np.linalg.norm(np.array(taken) - place, axis=1).min()
            for name, place in places.items()
        }
        name = max(distance, key=lambda each: distance[each], default="")
        if not name or distance[name] < min_distance:
            raise HabitusError(
                f"{body.name} has landmarks for {len(markers)} candidates, {count} were asked for"
            )
        for one in dict.fromkeys((name, _other_side(name))):
            if one in places and len(markers) < count:
                markers.append(Marker(_label(one), landmark=one))
                taken.append(places.pop(one))
    return markers


def _apart(body: BodyModel, markers: Sequence[Marker], min_distance: float) -> list[Marker]:
    """The markers at least ``min_distance`` (m) from all before them, relabelled."""
    numbered = MarkerLayout(
        "all", tuple(replace(marker, label=f"{k}") for k, marker in enumerate(markers))
    )
    kept: dict[str, Marker] = {}
    taken = np.zeros((0, 3))
    for marker, point in zip(markers, body.v_template[numbered.vertices(body)], strict=True):
        if (
            marker.label not in kept
            and np.linalg.norm(taken - point, axis=1).min(initial=np.inf) >= min_distance
        ):
            kept[marker.label] = marker
            taken = np.vstack([taken, point])
    return list(kept.values())


def _mirrored(body: BodyModel, vertices: np.ndarray, min_distance: float) -> list[tuple[int, ...]]:
    """Groups of a marker and its twin on the other side, where there is one."""
    places = body.v_template[vertices]
    groups = []
    free = set(range(len(vertices)))
    for k in range(len(vertices)):
        if k not in free:
            continue
        away = np.linalg.norm(places - places[k] * [-1, 1, 1], axis=1)
        twin = min((j for j in free if j != k), key=lambda j: away[j], default=k)
        group = (
            (k, twin)
            if twin != k and away[twin] < min_distance and abs(places[k, 0]) > min_distance
            else (k,)
        )
        groups.append(tuple(sorted(group)))
        free -= set(group)
    return groups


def _other_side(name: str) -> str:
    side, _, rest = name.partition("_")
    other = {"left": "right", "right": "left"}.get(side)
    return f"{other}_{rest}" if other else name


def _label(landmark: str) -> str:
    side, _, rest = landmark.partition("_")
    return f"{side[0].upper()}_{rest.upper()}" if side in ("left", "right") else landmark.upper()


FILES = ("selection.json", "curve.svg", "markers.svg")
KINDS = ("of the start", "of the {count} best to add", "others that were considered")


@dataclass(frozen=True, eq=False)
class Selection:
    """A path of marker sets, each a marker or a pair more or less than the next; ``pool`` is all
    there was.

    ``removed`` goes down from the start, ``added`` up; each `Step` holds its groups and error (m,
    root mean square). ``noise``: of a marker, as it was taken to be (m).
    """

    body: BodyModel
    pool: Pool
    goal: str
    region: str
    removed: tuple[Step, ...]
    added: tuple[Step, ...]
    noise: float = NOISE

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
        markers = [
            step
            for step in (*self.removed, *self.added)
            if self.pool.candidates.count(step.groups) <= count
        ]
        if not markers:
            raise HabitusError(f"no set of {count} markers; the smallest has {min(self.errors)}")
        best = max(markers, key=lambda step: len(step.groups))
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


@takes(MarkerSelectionOptions)
def select_markers(
    *,
    options: MarkerSelectionOptions,
    out: PathLike | None = None,
    workers: WorkersLike = None,
    progress: Progress = silent,
) -> Selection:
    """The markers that determine a body best: from a set markers are removed one by one, and others
    added (M 7, eqs. 11 to 13).

    pool: a number of candidates (those of ``start`` and landmarks spread over the body), or the
    layouts that have them. start: a layout (47 and 67 are MoSh's). people: posed, held out, drawn
    from other shape spaces than the body's, with skin that no space explains. out: a folder for
    selection.json, curve.svg, markers.svg and a layout for each number in ``keep``. progress:
    called with (stage, share done). Raises HabitusError for unknown names, and for too small a
    pool.
    """
    pool = options.pool
    start = options.start
    goal = options.goal
    region = options.region
    pairs = options.pairs
    tell = progress
    model = loaded(options.body)
    prior = prior_of(model)
    settings = options.settings or SELECTION
    selected = find_pool(model, pool, find_layout(start), pairs, settings)
    tell("people", 0.0)
    others = [load_body(name) for name in ("female", "male")] if _shares_mesh(model) else [model]
    drawn = held_out_people(others, prior, options.people, options.seed, settings)
    vertices = np.unique(np.linspace(0, model.num_vertices - 1, settings.sample).astype(int))
    known = best_states(model, prior, drawn, vertices, settings.noise)
    problem = linearised(
        model, prior, known, selected.candidates, goal, region, settings.noise, settings.free
    )
    with open_workers(workers) as shared:
        least = min(len(selected.start), max(1, -(-options.min_markers // (2 if pairs else 1))))
        removed = _reported(
            removals(problem, selected.start, least, shared),
            "remove",
            len(selected.start) - least,
            tell,
        )
        most = len(selected.candidates.groups)
        added = _reported(
            additions(problem, selected.start, most, shared),
            "add",
            most - len(selected.start),
            tell,
        )
    selection = Selection(model, selected, goal, region, removed, added, settings.noise)
    if out is not None:
        _write(selection, Path(out), options.keep)
    return selection


def _reported(steps: Iterator[Step], stage: str, count: int, tell: Progress) -> tuple[Step, ...]:
    out = []
    for step in steps:
        out.append(step)
        tell(stage, min(1.0, len(out) / max(count, 1)))
    return tuple(out)


def _shares_mesh(body: BodyModel) -> bool:
    return body.name in SHIPPED and body.age is None


def _write(selection: Selection, folder: Path, keep: Sequence[int]) -> None:
    layouts = {f"markers-{count}.toml": selection.layout(count) for count in keep}
    best = 20
    kinds = _kinds(selection, best)
    names = [name.format(count=best) for name in KINDS]
    with whole_folder(folder, (*FILES, *layouts)) as partial:
        write_text(partial / "selection.json", json.dumps(_numbers(selection), indent=1) + "\n")
        write_text(
            partial / "curve.svg",
            curve_picture(
                selection.errors, selection.start, f"{selection.goal}, {selection.region}"
            ),
        )
        picture = marker_picture(selection.body, selection.pool.candidates.vertices, kinds, names)
        write_text(partial / "markers.svg", picture)
        for name, layout in layouts.items():
            save_layout(layout, partial / name)


def _kinds(selection: Selection, best: int) -> list[int]:
    """0 for the markers of the start, 1 for the first that were added, 2 for the others."""
    groups = selection.pool.candidates.groups
    kinds = np.full(len(selection.pool.candidates.labels), 2)
    more = [step.group for step in selection.added[1:] if step.group is not None]
    for group in more:
        if (kinds == 1).sum() < best:
            kinds[list(groups[group])] = 1
    for group in selection.added[0].groups:
        kinds[list(groups[group])] = 0
    return kinds.tolist()


def _numbers(selection: Selection) -> dict[str, object]:
    """The path as JSON has it: which labels go and come, and the error at each number of
    markers.
    """
    labels = selection.pool.candidates.labels
    groups = selection.pool.candidates.groups

    def as_json(steps: Sequence[Step]) -> list[dict[str, object]]:
        return [
            {
                "markers": selection.pool.candidates.count(step.groups),
                "changed": [] if step.group is None else [labels[k] for k in groups[step.group]],
                "error_mm": round(1e3 * step.error, 3),
            }
            for step in steps
        ]

    return {
        "goal": selection.goal,
        "region": selection.region,
        "candidates": list(labels),
        "start": [labels[k] for group in selection.added[0].groups for k in groups[group]],
        "marker_noise_mm": round(1e3 * selection.noise, 2),
        "removed": as_json(selection.removed),
        "added": as_json(selection.added),
    }


@takes(PoseSelectionOptions)
def select_poses(
    *, options: PoseSelectionOptions, out: PathLike | None = None, workers: WorkersLike = None
) -> tuple[PoseChoice, Float[np.ndarray, "count J 3"]]:
    """The poses that together determine a person's shape best with a layout's markers: a body scan
    (M 10).

    candidates: plain poses (arms down, T-pose, sitting, crouching, arms up) and others drawn from
    the pose prior, with both legs alike and the body over its feet, so that they can be held. out:
    an .npz that receives the poses as a motion of one pose a second, with AMASS's names. Returns
    the choice and the poses (rad). Raises HabitusError for a layout that the body lacks, and for
    fewer candidates than poses.
    """
    layout = options.layout
    count = options.count
    candidates = options.candidates
    seed = options.seed
    if not 0 < count <= candidates:
        raise HabitusError(
            f"{count} poses of {candidates}; expected 1 or more, and no more than there are"
        )
    model = loaded(options.body)
    prior = prior_of(model)
    markers = find_layout(layout)
    settings = options.settings or SELECTION
    poses = _candidate_poses(model, prior, candidates, seed, settings.min_ankle_offset)
    with open_workers(workers) as shared:
        choice = choose_poses(
            model,
            prior,
            place(markers, model),
            poses,
            count,
            settings=settings,
            seed=seed,
            workers=shared,
        )
    chosen = poses[list(choice.poses)]
    if out is not None:
        _write_poses(model, chosen, choice, markers, Path(out))
    return choice, chosen


def _candidate_poses(
    body: BodyModel, prior: PosePrior, count: int, seed: int, min_ankle_offset: float
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
    return np.stack([_stood(body, pose, min_ankle_offset) for pose in poses])


def _stood(
    body: BodyModel, pose: Float[np.ndarray, "J 3"], min_ankle_offset: float
) -> Float[np.ndarray, "J 3"]:
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
    if body((), out, vertices=[0]).joints[left["ankle"], 0] < min_ankle_offset:
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
