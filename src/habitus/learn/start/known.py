"""What is known of registrations that were made: people and poses to start from, or to hold
fixed.
"""

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.learn.estimate import Problem
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.posing.surface import surface
from habitus.learn.steps.poses import PoseFit, mean_of
from habitus.mesh.known import Known
from habitus.parallel.workers import Workers, in_blocks


def check_known(problem: Problem, body: BodyModel | None) -> None:
    """Raise HabitusError where what is known is not by this body's joints and shape directions, or
    does not suffice for what is held fixed.
    """
    known = problem.registrations.known
    fixed = problem.options.fixed
    data = problem.registrations
    if known is not None and body is not None and problem.options.start == "body":
        for name, array, count in (
            ("pose", known.pose, body.num_joints),
            ("betas", known.betas, body.num_betas),
        ):
            if array is not None and (
                array.shape[1] != count if name == "pose" else array.shape[1] > count
            ):
                raise HabitusError(
                    f"the registrations' {name} have {array.shape[1]} rows of numbers, "
                    f"{body.name} has {count}; "
                    "expected those of this body: choose its joints (--joints) or another body"
                )
    for word, told in (("people", told_people(problem)), ("poses", told_poses(problem))):
        if word in fixed and not told.all():
            some = data.subjects if word == "people" else data.name
            raise HabitusError(
                f"{word} fixed, but those of {int((~told).sum())} of {len(told)} (first "
                f"{some[int((~told).argmax())]}) "
                f"are not told; expected {'betas or rest' if word == 'people' else 'pose'} in the "
                "dataset"
            )


def told_poses(problem: Problem) -> Bool[np.ndarray, " N"]:
    """The registrations whose poses are known and are to be started from."""
    return _known(problem).told("pose", len(problem.registrations))


def told_people(problem: Problem) -> Bool[np.ndarray, " S"]:
    """The subjects whose rest surfaces are known and are to be started from."""
    data = problem.registrations
    known = _known(problem)
    by_betas = known.told("betas", len(data))[_first_rows(problem)]
    return np.array([subject in known.rest for subject in data.subjects], bool) | by_betas


def people(
    problem: Problem, general: Float[np.ndarray, "V 3"], body: BodyModel | None
) -> Float[np.ndarray, "S V 3"]:
    """Rest surfaces (m) of the subjects: those known, the general one of the others."""
    data = problem.registrations
    known = _known(problem)
    found = np.repeat(general[None], problem.subjects, 0)
    for k, (subject, row) in enumerate(zip(data.subjects, _first_rows(problem), strict=True)):
        if subject in known.rest:
            found[k] = known.rest[subject]
        elif known.betas is not None and body is not None and np.isfinite(known.betas[row]).all():
            found[k] = body.rest_vertices(known.betas[row])
    return found


def known_fits(
    problem: Problem, rig: Rig, persons: list[RestPerson], rows: np.ndarray, workers: Workers
) -> list[PoseFit]:
    """The known poses of some registrations; their places as known, or where they lie best."""
    blocks = [rows[block.start : block.stop] for block in in_blocks(len(rows), 32)]
    return [
        fit for block in workers.map(_known_fits, (problem, rig, persons), blocks) for fit in block
    ]


def _known_fits(shared: tuple[Problem, Rig, list[RestPerson]], rows: np.ndarray) -> list[PoseFit]:
    problem, rig, persons = shared
    known = _known(problem)
    data = problem.registrations
    fits = []
    places = known.told("trans", len(data))
    for row in rows:
        pose = known.pose[row]
        if places[row]:
            fits.append(PoseFit(pose, known.trans[row], np.nan))
            continue
        target, weight = data.read_seen(row)
        away = target - surface(rig, persons[data.subject_index[row]], pose)
        fits.append(PoseFit(pose, mean_of(away, weight), np.nan))
    return fits


def _known(problem: Problem) -> Known:
    """What is known, where training starts from a body; nothing otherwise: joints would be other
    ones.
    """
    known = problem.registrations.known
    return Known() if known is None or problem.options.start != "body" else known


def _first_rows(problem: Problem) -> np.ndarray:
    """The first registration of each subject."""
    return np.array([problem.rows_of(k)[0] for k in range(problem.subjects)], np.int64)
