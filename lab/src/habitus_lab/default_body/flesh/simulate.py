"""One person's session: their flesh along a path of poses, measured and written."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus_lab.population.flesh.paths import Walk, walk

from .gates import ruler
from .people import Shape
from .person import Person, make_person
from .poses import Session
from .studio import Studio, open_studio

STEPS = 12  # Newton steps at most where a path stops; they end before where no node moves by .2 mm


@dataclass(frozen=True)
class Workshop:
    """What all sessions share: where cages and results lie, and how paths are walked. It travels to
    other machines.
    """

    folder: Path
    way: Walk = field(default_factory=lambda: Walk(most=STEPS))


@dataclass(frozen=True, eq=False)
class Task:
    """One file to be made."""

    sex: str
    shape: Shape
    session: Session

    def path(self, folder: Path) -> Path:
        """Where it lies."""
        return folder / self.shape.name / f"{self.session.name}.npz"


@lru_cache(maxsize=2)
def _studio(sex: str, folder: Path) -> Studio:
    return open_studio(sex, folder)


@lru_cache(maxsize=2)
def _person(
    sex: str, name: str, betas: tuple[float, ...], age: float | None, folder: Path
) -> Person:
    studio = _studio(sex, folder)
    return make_person(studio, *Shape(name, np.array(betas), age, 0.0).rest(studio.body))


def simulate(shop: Workshop, task: Task) -> str:
    """Do a task unless its file is there; gives a line about it. What cannot be simulated is told,
    not raised.
    """
    path = task.path(shop.folder)
    if path.exists():
        return f"{path.stem} of {task.shape.name}: there already"
    begin = time.thread_time()
    try:
        person = _person(
            task.sex, task.shape.name, tuple(task.shape.betas), task.shape.age, shop.folder
        )
    except HabitusError as error:
        return f"{task.shape.name}: {error}"
    gauge = ruler(person)
    rows = []
    reports = []
    for stop in walk(person.flesh, person, list(task.session.poses), shop.way):
        vertices = person.surface(stop.pose, stop.nodes)
        rows.append(vertices.astype(np.float32))
        reports.append(gauge.gauge(stop.pose, stop.nodes, vertices, stop.steps).words())
    seconds = time.thread_time() - begin
    _write(path, task, person, np.stack(rows), reports, seconds)
    bad = sum(not one["passes"] for one in reports)
    return (
        f"{task.shape.name} {task.session.name}: {len(rows)} poses, {seconds:.1f} s, {bad} "
        "outside the gates"
    )


def _write(
    path: Path,
    task: Task,
    person: Person,
    vertices: np.ndarray,
    reports: list[dict],
    seconds: float,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            vertices=vertices,
            poses=task.session.poses,
            names=np.array(task.session.names),
            betas=task.shape.betas,
            age=np.array(np.nan if task.shape.age is None else task.shape.age),
            rest=person.rest.astype(np.float32),
            gauges=np.array([json.dumps(one) for one in reports]),
            seconds=np.array(seconds),
        )
