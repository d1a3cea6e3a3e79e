"""Pictures of an evaluation: error maps, turned heads and worst fits."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.evaluate.generalisation import Generalisation
from habitus.evaluate.neck_twist import head_and_neck, neck_vertices, turned_head, twist_axis
from habitus.evaluate.posable import ComparedModel, PosableBody
from habitus.evaluate.result import Evaluation, ModelEvaluation
from habitus.export.png import png
from habitus.report import drawing
from habitus.report.evaluation.page import Picture
from habitus.rotations import matrix_from_rotvec

WORST = 3  # fits of each model that are shown
HEAD_TURN = 70  # degrees to either side, in the pictures of the neck
_LEAST = 0.0005  # m: scales of error reach at least this far
_ARMS_DOWN = 0.95  # rad: how far the arms of those who stand for error maps are lowered
_UPRIGHT = 0.8  # cosine between the vertical and a neck that is seen from the front
_NECK_BOX = np.array(
    [[x, y, z] for x in (-0.15, 0.15) for y in (-0.13, 0.25) for z in (-0.1, 0.1)]
)  # m, around it


def draw_pictures(evaluation: Evaluation) -> Iterator[Picture]:
    """Error maps, turned heads and worst fits."""
    yield from _error_maps(evaluation)
    yield from _necks(evaluation)
    yield from _worst_fits(evaluation)


def _error_maps(evaluation: Evaluation) -> Iterator[Picture]:
    """Each model's mean person, coloured on one scale by how far off each vertex is on average."""
    curves = [
        (entry, curve)
        for entry in evaluation.models
        for curve in (entry.shape, entry.pose)
        if curve
    ]
    maps = [_of_vertices(curve)[_place(evaluation, curve)] for _, curve in curves]
    limit = max(_LEAST, float(np.nanpercentile(maps, 99)))
    standing = _standing(evaluation)
    for (entry, curve), errors in zip(curves, maps, strict=True):
        faces = evaluation.registrations.faces
        shown = np.isfinite(errors)[:, None]
        ramp = drawing.ramp_colours(np.nan_to_num(errors), limit)
        colours = np.where(shown, ramp, drawing.plain_colours(len(errors)))
        pose = (
            standing
            if len(standing) == len(entry.model.parents)
            else np.zeros((len(entry.model.parents), 3))
        )
        yield Picture(
            kind=f"{curve.measure} error map",
            model=entry.name,
            file=f"error_map_{curve.measure}_{slug(entry.name)}.png",
            caption=f"mean {1e3 * np.nanmean(errors):.2f} mm, worst vertex "
            f"{1e3 * np.nanmax(errors):.1f} mm",
            content=png(
                drawing.front_and_back(entry.model.surface(np.zeros(0), pose), faces, colours)
            ),
            scale=(0.0, 1e3 * limit),
        )


def _standing(evaluation: Evaluation) -> Float[np.ndarray, "J 3"]:
    """The rest pose; arms down, if they are held out and joints are called shoulders (by the first
    model of bodies).
    """
    bodies = [
        entry.model.body for entry in evaluation.models if isinstance(entry.model, PosableBody)
    ]
    if not bodies:
        return np.zeros((0, 3))
    body = bodies[0]
    pose = np.zeros((bodies[0].num_joints, 3))
    across = body.joint_template[:, 0]
    width, height = np.ptp(body.v_template, axis=0)[:2]
    for k, name in enumerate(body.joint_names):
        if "shoulder" in name.lower() and width > 0.8 * height:
            pose[k, 2] = -_ARMS_DOWN * np.sign(across[k])
    return pose


def _of_vertices(curve: Generalisation) -> Float[np.ndarray, "K V"]:
    """Against the noise-free meshes where these are known."""
    return curve.per_vertex if curve.clean_per_vertex is None else curve.clean_per_vertex


def _place(evaluation: Evaluation, curve: Generalisation) -> int:
    """Index in the curve at which all models have as many coefficients; else its end."""
    return (
        curve.counts.index(evaluation.shown)
        if evaluation.shown is not None
        else len(curve.counts) - 1
    )


def _necks(evaluation: Evaluation) -> Iterator[Picture]:
    """Heads turned to the right, not, and to the left; the neck coloured by how much thicker or
    thinner it gets.
    """
    entries = [entry for entry in evaluation.models if entry.twist is not None]
    bodies = [entry.model.body for entry in entries if isinstance(entry.model, PosableBody)]
    if not bodies:
        return
    rows = neck_vertices(bodies)
    necks = [
        [turned_head(body, angle, rows) for angle in (-HEAD_TURN, 0, HEAD_TURN)] for body in bodies
    ]
    limit = max(
        0.05, float(np.percentile([np.abs(change) for each in necks for _, change in each], 99))
    )
    for entry, body, heads in zip(entries, bodies, necks, strict=True):
        views = [_head(body, surface, rows, change, limit) for surface, change in heads]
        assert entry.twist is not None
        girth = dict(zip(entry.twist.angles, entry.twist.girth - 1, strict=True))
        right = girth[-HEAD_TURN]
        left = girth[HEAD_TURN]
        yield Picture(
            kind="neck",
            model=entry.name,
            file=f"neck_{slug(entry.name)}.png",
            caption=f"girth {_percent(right)} at {HEAD_TURN}° right, {_percent(left)} at "
            f"{HEAD_TURN}° left",
            content=png(drawing.side_by_side(views)),
            scale=(-100 * limit, 100 * limit),
        )


def _percent(change: float) -> str:
    return f"{100 * change:+.1f} %".replace("-", "−")


def _head(
    body: BodyModel, surface: np.ndarray, rows: np.ndarray, change: np.ndarray, limit: float
) -> drawing.Rgba:
    changes = np.zeros(len(surface))
    changes[rows] = change
    colours = drawing.ramp_colours(changes, limit, drawing.CHANGE_RAMP, -limit)
    towards, frame = head_view(body, rows)
    return drawing.picture(surface, body.faces, colours, drawing.axes_from(towards), frame=frame)


def head_view(
    body: BodyModel, rows: np.ndarray
) -> tuple[tuple[float, float, float], Float[np.ndarray, "n 3"]]:
    """From where a turned head is seen, and what is to be in the picture: of an upright neck the
    front, and a box around it; of any other (an animal's) the side, and all that turns.
    """
    if twist_axis(body)[1] > _UPRIGHT:
        size = float(np.ptp(body.v_template[:, 1])) / 1.7
        return (0.0, 0.08, 1.0), _NECK_BOX * size + body.v_template[rows].mean(0)
    return (1.0, 0.25, 0.35), body.v_template[head_and_neck(body)]


@dataclass(frozen=True, eq=False)
class _Shown:
    """A fit to be drawn: its vertices, those of the registration, and where the person looks."""

    entry: ModelEvaluation
    name: str
    fitted: Float[np.ndarray, "V 3"]
    target: Float[np.ndarray, "V 3"]
    facing: tuple[float, float, float]

    @property
    def distances(self) -> Float[np.ndarray, " V"]:
        return np.linalg.norm(self.fitted - self.target, axis=1)


def _worst_fits(evaluation: Evaluation) -> Iterator[Picture]:
    """For each model the registrations that it fits worst: the registration, and beside it the
    fit.
    """
    chosen = [fit for entry in evaluation.models for fit in _worst(evaluation, entry)]
    limit = max(_LEAST, float(np.percentile([fit.distances for fit in chosen], 99)))
    faces = evaluation.registrations.faces
    ranks = dict[str, int]()
    for fit in chosen:
        name = fit.entry.name
        errors = fit.distances
        ranks[name] = ranks.get(name, 0) + 1
        colours = (drawing.plain_colours(len(errors)), drawing.ramp_colours(errors, limit))
        frame = np.concatenate([fit.target, fit.fitted])
        axes = drawing.axes_from(fit.facing)
        views = [
            drawing.picture(surface, faces, colour, axes, height=360, frame=frame)
            for surface, colour in zip((fit.target, fit.fitted), colours, strict=True)
        ]
        yield Picture(
            kind="worst fits",
            model=name,
            file=f"worst_{slug(name)}_{ranks[name]}.png",
            caption=f"{fit.name}: mean {1e3 * errors.mean():.2f} mm, furthest "
            f"{1e3 * errors.max():.1f} mm",
            content=png(drawing.side_by_side(views, 4)),
            scale=(0.0, 1e3 * limit),
        )


def _worst(evaluation: Evaluation, entry: ModelEvaluation) -> Iterator[_Shown]:
    curve = entry.pose or entry.shape
    k = _place(evaluation, curve)
    for n in np.argsort(-curve.errors[k], kind="stable")[:WORST]:
        name = curve.registrations[n]
        fitted = entry.model.surface(curve.shape(k, n), curve.pose[k, n]) + curve.trans[k, n]
        target, weight = evaluation.registrations.read_seen(int(curve.rows[n]))
        if weight is not None:
            target = np.where(weight[:, None] > 0.0, target, fitted)
        yield _Shown(entry, name, fitted, target, _facing(entry.model, curve.pose[k, n]))


def _facing(model: ComparedModel, pose: np.ndarray) -> tuple[float, float, float]:
    """The horizontal direction from which a person is seen from the front, a little from the
    side.
    """
    root = matrix_from_rotvec(pose[model.parents.index(-1)])
    x, _, z = root @ np.array([0.35, 0.0, 1.0])
    length = float(np.hypot(x, z))
    return (x / length, 0.12, z / length) if length > 0.2 else (0.35, 0.12, 1.0)


def slug(name: str) -> str:
    """The name as part of a file's."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_") or "model"
