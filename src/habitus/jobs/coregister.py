"""Coregistration (T 5.4): the scans of several people are registered, a body is trained on the
surfaces, and registers the same scans again, begun where the first round ended.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.errors import HabitusError, check_extra
from habitus.fit.points.scan import Scan
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.points.scans import Registrar
from habitus.mesh.registrations import Registrations
from habitus.types import Progress

HELD = ("skinning_weights", "posedirs", "joint_regressor")
"""What a few scans do not determine: it stays the first body's."""
ROUNDS = 3
"""Of the training."""


class Coregistration(NamedTuple):
    """The trained body, and the fits of each person's scans by it and by the first body."""

    body: BodyModel
    fits: dict[str, list[ScanFit]]
    before: dict[str, list[ScanFit]]


def coregistered(
    registrar: Registrar,
    people: Mapping[str, Sequence[Scan]],
    asked: Mapping[str, Any],
    progress: Progress,
    begin: Mapping[str, BodyState] = MappingProxyType({}),
) -> Coregistration:
    """Each person's scans registered, a body trained, the scans registered with it.

    asked: arguments of `Registrar.register`. begin: states to begin with, one of all scans a
    person, where they are known. The trained body has the first one's skinning weights,
    joints and pose blend shapes, the mean of these people, and as many betas as there are people.
    Raises HabitusError for fewer than two people.
    """
    check_extra("torch", "coregistration")
    if len(people) < 2:
        raise HabitusError(
            f"coregister was given the scans of {len(people)} person; expected two people or more, "
            "each in a folder of their own"
        )
    first = _round(registrar, people, begin, asked, progress)
    progress("train", 0.5)
    body = trained(registrar.body, first)
    again = Registrar.of(body, prior_of(registrar.body), registrar.settings)
    ended = {
        name: BodyState(
            np.zeros(body.num_betas),
            np.stack([fit.pose for fit in fits]),
            np.stack([fit.trans for fit in fits]),
        )
        for name, fits in first.items()
    }
    return Coregistration(body, _round(again, people, ended, asked, progress), first)


def trained(body: BodyModel, fits: Mapping[str, Sequence[ScanFit]]) -> BodyModel:
    """The body that the registrations of people give, begun at ``body``; failed ones are left
    out.
    """
    from habitus.jobs.train import Trainer

    every = [(name, fit) for name, each in fits.items() for fit in each]
    people = [name for name, _ in every]
    data = registrations([fit for _, fit in every], [fit.scan_name for _, fit in every], people)
    trainer = Trainer(start="body", fixed=HELD, num_betas=len(fits), rounds=ROUNDS)
    return trainer.fit(data, template=body, workers=1).body


def registrations(
    fits: Sequence[ScanFit], names: Sequence[str], subjects: Sequence[str], sex: str = ""
) -> Registrations:
    """Registered scans as the data that a body is trained on: those of people with several scans
    belong to the set "pose", the others to "shape".
    """
    return Registrations(
        vertices=np.stack([fit.vertices for fit in fits]),
        faces=fits[0].body.faces,
        subject=tuple(subjects),
        sex=(sex,) * len(fits),
        set=tuple("pose" if list(subjects).count(one) > 1 else "shape" for one in subjects),
        name=tuple(names),
        weights=np.stack([fit.weights for fit in fits]),
        verdict=tuple(fit.verdict.level for fit in fits),
    )


def _round(
    registrar: Registrar,
    people: Mapping[str, Sequence[Scan]],
    begin: Mapping[str, BodyState],
    asked: Mapping[str, Any],
    progress: Progress,
) -> dict[str, list[ScanFit]]:
    """The fits of all people with one body."""
    fits = {}
    for k, (name, scans) in enumerate(people.items()):
        progress(f"person {name}", k / len(people))
        fits[name] = registrar.register(scans, **asked, previous=begin.get(name))
    return fits
