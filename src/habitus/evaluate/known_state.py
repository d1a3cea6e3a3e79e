"""Errors of bodies in the poses and shapes that registrations are known to have: nothing is fitted.

Synthetic registrations come with the pose and the person that they were made from
(`habitus.mesh.known.Known`): a body's error on them is that of its deformation alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.mesh.known import Known
from habitus.mesh.registrations import Registrations
from habitus.parallel.workers import Threads, Workers, in_blocks

_ALONE = Threads(1)
_BLOCK = 8


@dataclass(frozen=True, eq=False)
class KnownErrors:
    """Of N registrations, over their vertices as far as they count: mean distance, root mean
    square, 95th percentile (m).
    """

    mean: Float[np.ndarray, " N"]
    rms: Float[np.ndarray, " N"]
    p95: Float[np.ndarray, " N"]

    def over(self, rows: Bool[np.ndarray, " N"]) -> dict[str, float]:
        """Over some registrations: the mean of the means, the root of the mean square, the mean of
        the percentiles.
        """
        rms = np.sqrt((self.rms[rows] ** 2).mean())
        return {
            "mean": float(self.mean[rows].mean()),
            "rms": float(rms),
            "p95": float(self.p95[rows].mean()),
        }


def known_errors(
    bodies: Mapping[str, BodyModel], registrations: Registrations, workers: Workers = _ALONE
) -> dict[str, KnownErrors]:
    """The errors of each body on registrations with known pose, and known betas or rest surface.

    Where the translation is unknown, it is fitted. Raises HabitusError where pose or person are
    unknown, or given for other joints or shape directions than a body's.
    """
    known = _checked(bodies, registrations)
    shared = (bodies, registrations, known)
    blocks = in_blocks(len(registrations), _BLOCK)
    numbers_of = np.concatenate(list(workers.map(_block, shared, blocks)), 1)
    return {name: KnownErrors(*numbers.T) for name, numbers in zip(bodies, numbers_of, strict=True)}


def _checked(bodies: Mapping[str, BodyModel], registrations: Registrations) -> Known:
    known = registrations.known or Known()
    count = len(registrations)
    people = known.known_rows("betas", count) | np.array(
        [subject in known.rest for subject in registrations.subject], bool
    )
    is_known = known.known_rows("pose", count) & people
    if not count or not is_known.all() or known.pose is None:
        which = registrations.name[int((~is_known).argmax())] if count else "none there"
        raise HabitusError(
            f"{which}: its pose, or its betas and rest surface, are missing; expected them in the "
            "dataset"
        )
    for name, body in bodies.items():
        betas = 0 if known.betas is None else known.betas.shape[1]
        given = (known.pose.shape[1], registrations.num_vertices)
        expected = (body.num_joints, body.num_vertices)
        if given != expected or betas > body.num_betas:
            raise HabitusError(
                f"the dataset has {given[1]} vertices, {given[0]} joints and {betas} betas, {name} "
                f"has {expected[1]}, {expected[0]} and {body.num_betas}; expected registrations "
                "made from this body"
            )
    return known


def _block(
    shared: tuple[Mapping[str, BodyModel], Registrations, Known], rows: range
) -> Float[np.ndarray, "bodies n 3"]:
    bodies, registrations, known = shared
    out = np.empty((len(bodies), len(rows), 3))
    for k, row in enumerate(rows):
        target, weight = registrations.read_seen(row)
        weight = np.ones(len(target)) if weight is None else weight
        for b, body in enumerate(bodies.values()):
            offset = target - _surface(body, registrations.subject[row], known, row)
            offset -= (
                (weight @ offset) / weight.sum()
                if not known.known_rows("trans", len(registrations))[row]
                else 0.0
            )
            out[b, k] = _numbers(np.linalg.norm(offset, axis=1), weight)
    return out


def _surface(body: BodyModel, subject: str, known: Known, row: int) -> Float[np.ndarray, "V 3"]:
    assert known.pose is not None
    trans = (
        known.trans[row]
        if known.trans is not None and np.isfinite(known.trans[row]).all()
        else np.zeros(3)
    )
    if subject not in known.rest:
        assert known.betas is not None
        return body(known.betas[row], known.pose[row], trans).vertices
    rest = known.rest[subject]
    person = replace(body.prepare(), rest_joints=body.joint_regressor @ rest)
    return person.moved(rest.T.flatten(), known.pose[row], trans).vertices


def _numbers(
    distance: Float[np.ndarray, " V"], weight: Float[np.ndarray, " V"]
) -> Float[np.ndarray, " 3"]:
    """Mean, root mean square and 95th percentile of distances, each as much as it counts."""
    order = np.argsort(distance)
    total = weight.sum()
    p95 = distance[order[np.searchsorted(np.cumsum(weight[order]), 0.95 * total)]]
    return np.array([weight @ distance / total, np.sqrt(weight @ distance**2 / total), p95])
