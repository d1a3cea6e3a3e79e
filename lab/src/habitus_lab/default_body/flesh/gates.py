"""What is measured of a simulated pose before anything is learned from it."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from habitus_lab.population.flesh.assembly_kernels import determinants

from ..intersections import intersecting_pairs
from .person import Person
from .studio import SKIN, below

LIMBS = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
MOST_PAIRS = 20
WHOLE = 1.0
LIMB = 3.0  # pairs of triangles, per cent of the volume


@dataclass(frozen=True)
class Gauge:
    """Inverted tetrahedra and the least J; volume of skin and of the limb that changes most (%);
    new intersecting pairs

    of triangles; 95th percentile of bones' distances from their places (mm) by group; Newton steps
    at the end.
    """

    inverted: int
    least: float
    whole: float
    limb: float
    pairs: int
    bones: dict[str, float]
    steps: int

    @property
    def passes(self) -> bool:
        """Whether the pose is fit to be learned from."""
        return (
            self.inverted == 0
            and self.pairs <= MOST_PAIRS
            and abs(self.whole) <= WHOLE
            and abs(self.limb) <= LIMB
        )

    def words(self) -> dict:
        """For JSON."""
        return asdict(self) | {"passes": self.passes}


def judged(words: dict) -> dict:
    """What was measured of a pose, read from a file and judged by the gates of today."""
    gauge = Gauge(**{key: value for key, value in words.items() if key != "passes"})
    return gauge.words()


@dataclass(frozen=True, eq=False)
class Ruler:
    """A person's rest: volume, pairs that meet already, limbs' tetrahedra."""

    person: Person
    volume: float
    pairs: frozenset
    limbs: tuple[np.ndarray, ...]

    def gauge(self, pose: np.ndarray, nodes: np.ndarray, vertices: np.ndarray, steps: int) -> Gauge:
        """The measures of nodes (N, 3) and the full body's vertices (V, 3) in a pose."""
        person = self.person
        flesh = self.person.flesh
        det = np.empty(len(flesh.tets))
        determinants(nodes, flesh.tets, flesh.inverse, det)
        skin = vertices[:SKIN]
        faces = person.studio.faces
        errors = 1000 * person.bone_errors(pose, nodes)
        groups = {
            str(word): errors[person.bones.group == word] for word in np.unique(person.bones.group)
        }
        limbs = [_change(nodes, flesh.cage.nodes, flesh.cage.tets[tets]) for tets in self.limbs]
        return Gauge(
            int((det <= 0).sum()),
            float(det.min()),
            100 * (volume(skin, faces) / self.volume - 1),
            max(limbs, key=abs),
            len(meeting(skin, faces, person.moving) - self.pairs),
            {word: float(np.percentile(each, 95)) for word, each in groups.items()},
            steps,
        )


def ruler(person: Person) -> Ruler:
    """The ruler of a person."""
    studio = person.studio
    skin = person.rest[:SKIN]
    limbs = []
    for name in LIMBS:
        weight = studio.weights[:, below(studio.body, name)].sum(1)
        limbs.append(np.flatnonzero(weight[studio.cage.tets].mean(1) > 0.5))
    return Ruler(
        person, volume(skin, studio.faces), meeting(skin, studio.faces, person.moving), tuple(limbs)
    )


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed, m^3."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def meeting(vertices: np.ndarray, faces: np.ndarray, moving: np.ndarray) -> frozenset:
    """Pairs of triangles that cut each other, one of them simulated: toes and fingers are
    skinning's.
    """
    pairs = intersecting_pairs(vertices, faces)
    simulated = moving[faces[pairs]].any((1, 2))
    return frozenset(map(tuple, pairs[simulated].tolist()))


def _change(nodes: np.ndarray, rest: np.ndarray, tets: np.ndarray) -> float:
    def total(points: np.ndarray) -> float:
        corners = points[tets]
        return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum())

    return 100 * (total(nodes) / total(rest) - 1)
