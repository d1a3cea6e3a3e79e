"""Synthetic registrations with known truth: random people in random poses, to test training on.

Their surface is a model of SMPL's form (`planted_truth`) or none (`out_of_class_surface`).
Registrations are computed when they are read, from seeds, so that a data set of the papers' size (S
4) needs no room.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.mesh.registrations import Registrations, Vertices
from habitus_lab.population.bulging_flesh import FleshySurface
from habitus_lab.population.poses import joint_limits, resting_poses, sample_poses

Surface = BodyModel | FleshySurface
PAPERS_SIZE = {
    "subjects": 40,
    "poses_per_subject": (45,) * 26 + (44,) * 14,
    "shape_people": 3800,
}  # 1,786 poses (S 4)
FURTHEST_BETA = 2.5  # standard deviations: nobody is more unusual than this along a shape direction
PLACE = 0.1  # m: standard deviation of where people stand, along each axis
AT_ONCE = 16  # registrations made together


@dataclass(frozen=True, eq=False)
class PlantedVertices:
    """Vertices (N, V, 3; m) of a surface, made when asked for, with noise of ``sigma`` (m) a
    coordinate.

    The noise of registration k depends on the seed and k alone. Whether read alone or among others,
    a registration is the same to rounding in the last place.
    """

    surface: Surface
    betas: Float[np.ndarray, "N B"]
    pose: Float[np.ndarray, "N J 3"]
    trans: Float[np.ndarray, "N 3"]
    sigma: float
    seed: int
    dtype: Any

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, V, 3)."""
        return (len(self.betas), body_of(self.surface).num_vertices, 3)

    def __getitem__(self, rows: Any) -> np.ndarray:
        ids = np.arange(len(self.betas))[rows]
        if ids.ndim == 0:
            return self[ids[None]][0]
        made = np.empty((len(ids), *self.shape[1:]), self.dtype)
        for first in range(0, len(ids), AT_ONCE):
            made[first : first + AT_ONCE] = self._made(ids[first : first + AT_ONCE])
        return made

    def _made(self, ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n V 3"]:
        state = (
            torch.as_tensor(values[ids], dtype=torch.float64)
            for values in (self.betas, self.pose, self.trans)
        )
        vertices = self.surface(*state).vertices.numpy()
        if self.sigma:
            for k, surface in zip(ids, vertices, strict=True):
                random = np.random.Generator(np.random.SFC64([self.seed, int(k)]))
                surface += self.sigma * random.standard_normal(surface.shape, dtype=np.float32)
        return vertices


@dataclass(frozen=True, eq=False)
class Planted:
    """Registrations and their ground truth.

    ``clean`` are their vertices without noise, exactly ``surface(betas, pose, trans)``. ``betas``,
    ``pose`` (rad) and ``trans`` (m) have a row a registration; ``joints`` (m) a row a subject, in
    the order of ``registrations.subjects``: where the joints are at rest. ``sigma`` (m) is the
    noise of a coordinate.
    """

    registrations: Registrations
    surface: Surface
    clean: PlantedVertices
    betas: Float[np.ndarray, "N B"]
    pose: Float[np.ndarray, "N J 3"]
    trans: Float[np.ndarray, "N 3"]
    joints: Float[np.ndarray, "S J 3"]
    sigma: float


def body_of(surface: Surface) -> BodyModel:
    """The body that a surface's people, tree and skinning are of."""
    return surface if isinstance(surface, BodyModel) else surface.body


def planted_registrations(
    surface: Surface,
    *,
    subjects: int = 8,
    poses_per_subject: int | Sequence[int] = 20,
    shape_people: int = 60,
    test_subjects: int = 4,
    test_poses: int = 6,
    noise_rms: float = 0.001,
    seed: int = 0,
    motions: Float[np.ndarray, "M J 3"] | None = None,
    dtype: Any = np.float32,
    out: str | os.PathLike[str] | None = None,
) -> Planted:
    """A data set of people with this surface: three sets, no person in two of them.

    "pose": ``subjects`` people in ``poses_per_subject`` poses each (or one number for each), the
    first near rest; "shape": ``shape_people`` in one pose near rest; "test": ``test_subjects`` in
    ``test_poses`` poses. ``noise_rms`` (m) is the root mean square distance of vertices from the
    clean surface. Poses are drawn within the limits of human joints, or are those of ``motions``
    (rad, see `motion_poses`), each used once, with a root drawn. ``out``: a folder for
    ``vertices.npy``, which is then read instead of computed. Raises HabitusError where a number
    makes no sense or there are too few motions.
    """
    body = body_of(surface)
    each = (
        [poses_per_subject] * subjects
        if isinstance(poses_per_subject, int)
        else list(poses_per_subject)
    )
    counts = {"pose": each, "shape": [1] * shape_people, "test": [test_poses] * test_subjects}
    if (
        len(each) != subjects
        or min([0, *each, shape_people, test_subjects, test_poses]) < 0
        or not sum(each)
    ):
        raise HabitusError(
            f"{subjects} subjects with {poses_per_subject} poses each asked for; expected at "
            "least one"
        )
    words = _words(counts)
    person = np.repeat(
        np.arange(sum(map(len, counts.values()))), [n for c in counts.values() for n in c]
    )
    random = np.random.default_rng([seed, 1])
    people = np.clip(
        random.standard_normal((person[-1] + 1, body.num_betas)), -FURTHEST_BETA, FURTHEST_BETA
    )
    betas = people[person]
    pose = _poses(np.random.default_rng([seed, 2]), counts, body.joint_names, motions)
    trans = PLACE * random.standard_normal((len(person), 3))
    clean = PlantedVertices(surface, betas, pose, trans, 0.0, seed, dtype)
    sigma = noise_rms / np.sqrt(3)
    vertices: Vertices = replace(clean, sigma=sigma)
    registrations = Registrations(
        vertices=vertices if out is None else _written(vertices, Path(out) / "vertices.npy", dtype),
        faces=body.faces,
        subject=words["subject"],
        sex=tuple(_sexes(body, people)[person]),
        set=words["set"],
        name=words["name"],
    )
    joints = body.rest_joints(people)
    return Planted(
        registrations, surface, clean, betas, pose, trans, joints[np.unique(person)], sigma
    )


def _words(counts: dict[str, list[int]]) -> dict[str, tuple[str, ...]]:
    rows = [
        (f"{kind}{person:04d}", kind, f"{kind}{person:04d}-{k:03d}")
        for kind, numbers in counts.items()
        for person, number in enumerate(numbers)
        for k in range(number)
    ]
    return dict(zip(("subject", "set", "name"), zip(*rows, strict=True), strict=True))


def _sexes(body: BodyModel, people: Float[np.ndarray, "S B"]) -> np.ndarray:
    if body.female_direction is None:
        return np.full(len(people), "")
    direction, bias = body.female_direction
    return np.where(people @ direction + bias > 0, "female", "male")


def _poses(
    rng: np.random.Generator,
    counts: dict[str, list[int]],
    joint_names: tuple[str, ...],
    motions: np.ndarray | None,
) -> Float[np.ndarray, "N J 3"]:
    """Poses of all sets in order: near rest for a person's first, free for the others."""
    limits = joint_limits(joint_names)
    first = np.concatenate([np.arange(n) == 0 for numbers in counts.values() for n in numbers])
    free = int((~first).sum())
    poses = sample_poses(rng, len(first), limits)
    if motions is not None:
        if len(motions) < free or motions.shape[1:] != (len(joint_names), 3):
            raise HabitusError(
                f"motions have shape {motions.shape}; expected at least {free} poses of "
                f"{len(joint_names)} joints"
            )
        poses[~first, 1:] = motions[rng.permutation(len(motions))[:free], 1:]
    poses[first] = resting_poses(rng, int(first.sum()), limits)
    return poses


def _written(vertices: Vertices, path: Path, dtype: Any) -> np.ndarray:
    """The vertices from a file that holds them all, made beside its place first."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.part")
        stored = np.lib.format.open_memmap(part, "w+", np.dtype(dtype), vertices.shape)
        for first in range(0, len(stored), AT_ONCE):
            stored[first : first + AT_ONCE] = vertices[first : first + AT_ONCE]
        stored.flush()
        os.replace(part, path)
    except OSError as error:
        raise HabitusError(
            f"cannot write {path}: {error.strerror or error}; choose a folder with room"
        ) from error
    return np.load(path, mmap_mode="r")
