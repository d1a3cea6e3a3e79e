"""Errors of bodies in the poses and shapes that registrations are known to have: nothing is fitted.

Registrations that were made, by a simulation say, tell the pose and the person they were made from
(`habitus.mesh.known.Known`): what a body's surface is off by there is its flesh's error alone.
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
    """The errors of each body on registrations that tell pose, and betas or rest surface.

    Where a place is not told, the surface is moved to where it lies best. Raises HabitusError where
    something is not told, or by other joints or shape directions than a body's.
    """
    known = _checked(bodies, registrations)
    shared = (bodies, registrations, known)
    blocks = in_blocks(len(registrations), _BLOCK)
    found = np.concatenate(list(workers.map(_block, shared, blocks)), 1)
    return {name: KnownErrors(*numbers.T) for name, numbers in zip(bodies, found, strict=True)}


def _checked(bodies: Mapping[str, BodyModel], registrations: Registrations) -> Known:
    known = registrations.known or Known()
    count = len(registrations)
    people = known.told("betas", count) | np.array(
        [one in known.rest for one in registrations.subject], bool
    )
    told = known.told("pose", count) & people
    if not count or not told.all() or known.pose is None:
        which = registrations.name[int((~told).argmax())] if count else "none there"
        raise HabitusError(
            f"{which}: its pose, and betas or rest surface, are not told; expected them in the "
            "dataset"
        )
    for name, body in bodies.items():
        betas = 0 if known.betas is None else known.betas.shape[1]
        have = (known.pose.shape[1], registrations.num_vertices)
        want = (body.num_joints, body.num_vertices)
        if have != want or betas > body.num_betas:
            raise HabitusError(
                f"the dataset has {have[1]} vertices, {have[0]} joints and {betas} betas, {name} "
                f"has {want[1]}, "
                f"{want[0]} and {body.num_betas}; expected registrations made from this body"
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
            away = target - _surface(body, registrations.subject[row], known, row)
            away -= (
                (weight @ away) / weight.sum()
                if not known.told("trans", len(registrations))[row]
                else 0.0
            )
            out[b, k] = _numbers(np.linalg.norm(away, axis=1), weight)
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
