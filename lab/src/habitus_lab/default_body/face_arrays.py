"""All that faces add to a body's file, from the finished arrays of the body.

Lips closed at rest, the jaw's axis, 52 face units, 30 components of identity, teeth, tongue and
lashes. Units and identity are kept for the vertices that they move (`face_vertices`, numbered
through the full mesh and on through the parts).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .contacts import Meetings, apart, with_room
from .face_identity import drawn_faces, face_space
from .face_lines import FaceLines, face_lines
from .face_lips import closed_lips
from .face_parts import Parts, face_parts, part_arrays
from .face_units import TURNING, face_units, head_scale
from .people import Sliders
from .rig import JOINTS, joint_weights, surface_places
from .shape_space import ShapeSpace
from .sliders import ANCHORS, MorphSpace
from .sources import BODY_VERTICES, Source

PEOPLE = 80  # random bodies that parts are bound with
FACES = 300
HEAD = ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")


class FaceMaker:
    """What all bodies of one mesh share, made once: parts, random faces."""

    def __init__(
        self,
        source: Source,
        morphs: MorphSpace,
        base: np.ndarray,
        mirror: np.ndarray,
        hidden: np.ndarray,
        rng: np.random.Generator,
    ):
        """base and mirror (V,) of the mesh; hidden (V,) vertices inside its linings."""
        self.source = source
        weights = joint_weights(source, base, mirror)
        self.head = weights[:, [JOINTS.index(name) for name in HEAD]].sum(1)
        bodies = morphs.bodies(*_drawn(morphs, PEOPLE, rng))
        skin = np.flatnonzero((self.head > 0.5) & ~hidden & (np.arange(len(base)) < BODY_VERTICES))
        self.parts: Parts = face_parts(source, morphs, base, mirror, skin, bodies)
        self.faces = drawn_faces(source, FACES, rng)[:, base]
        self.rng = rng
        self.ties: dict[str, Meetings] = {}
        self.meetings: Meetings | None = None

    def __call__(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The arrays to put into a body's file, in the place of those of the same name."""
        arrays = arrays | _closed(arrays, _head_skins(arrays, self.head))
        arrays = arrays | _jaw_axis(arrays, self.source.mirror)
        rest = arrays["v_template"].astype(float)
        base = np.concatenate([arrays["base_vertices"], self.parts.base])
        binding = self.parts.binding
        count = len(rest)
        weights = np.zeros((count, len(JOINTS)))
        np.put_along_axis(
            weights, arrays["skinning_index"].astype(int), arrays["skinning_value"].astype(float), 1
        )
        units = face_units(
            self.source,
            np.concatenate([rest, binding @ rest]),
            _regressor(arrays) @ rest,
            np.concatenate([weights, self.parts.weights]),
            base,
            np.concatenate([arrays["mirror"], self.parts.mirror]),
            arrays["faces"],
            (arrays["quads"], arrays["hidden_quads"]),
            binding,
            self.ties,
        )
        scale = head_scale(self.source.vertices[arrays["base_vertices"]], rest, weights)
        identity = face_space(
            scale * self.faces,
            rest,
            arrays["shapedirs"].astype(float),
            self.head,
            arrays["mirror"],
            _head_skins(arrays, self.head),
            self.rng,
            self.meetings,
        )
        self.meetings = identity.meetings
        faces = np.concatenate(
            [
                identity.directions,
                (binding @ identity.directions.reshape(count, -1)).reshape(
                    -1, 3, identity.directions.shape[-1]
                ),
            ]
        )
        moved = np.flatnonzero(
            (np.abs(units.directions).max((1, 2)) > 0) | (np.abs(faces).max((1, 2)) > 1e-5)
        )
        changed = ("v_template", "shapedirs", "further_shapedirs", "agedirs", *_REGRESSOR)
        return {
            **{name: arrays[name] for name in changed if name in arrays},
            "face_vertices": moved.astype(np.int32),
            "face_unit_names": np.array(units.names),
            "face_unitdirs": units.directions[moved].astype(np.float16),
            "face_unit_joints": np.array([JOINTS.index(name) for name in TURNING], np.int32),
            "face_unit_turns": units.turns.astype(np.float32),
            "facedirs": faces[moved].astype(np.float16),
            "face_numbers": np.array([identity.between_people, identity.held_out], np.float32),
            **part_arrays(self.parts),
        }


_REGRESSOR = ("joint_regressor_rows", "joint_regressor_cols", "joint_regressor_values")


def face_maker(
    source: Source, morphs: MorphSpace, arrays: dict[str, np.ndarray], rng: np.random.Generator
) -> FaceMaker:
    """For the mesh of a body's arrays."""
    quads, hidden = arrays["quads"], arrays["hidden_quads"]
    inside = np.zeros(len(arrays["base_vertices"]), bool)
    inside[np.setdiff1d(quads[hidden], quads[~hidden])] = True
    return FaceMaker(source, morphs, arrays["base_vertices"], arrays["mirror"], inside, rng)


def _closed(
    arrays: dict[str, np.ndarray], skins: tuple[np.ndarray, np.ndarray]
) -> dict[str, np.ndarray]:
    """As `closed_lips`, of the first and the further shape directions alike."""
    names = [name for name in ("shapedirs", "further_shapedirs") if name in arrays]
    every = np.concatenate([arrays[name] for name in names], -1)
    closed = closed_lips(arrays | {"shapedirs": every}, _lines(arrays), skins)
    ends = np.cumsum([arrays[name].shape[-1] for name in names])[:-1]
    closed |= dict(zip(names, np.split(closed["shapedirs"], ends, -1), strict=True))
    return closed | kept_apart(arrays | closed, skins)


def kept_apart(
    arrays: dict[str, np.ndarray], skins: tuple[np.ndarray, np.ndarray]
) -> dict[str, np.ndarray]:
    """Shape directions and ages with springs where lips that are closed at rest would pass through
    each other in random people, of an age as well, whose mean person takes on the adult's gaps.
    """
    names = [name for name in ("shapedirs", "further_shapedirs") if name in arrays]
    every = np.concatenate([arrays[name] for name in names], -1).astype(float)
    rest = arrays["v_template"].astype(float)
    mirror = arrays["mirror"]
    count = every.shape[-1]
    nothing = np.zeros(1), np.zeros((1, count))
    space = ShapeSpace(rest, every, np.zeros((1, count)), np.ones(count), 0.0, *nothing)
    found, _ = apart(space, skins, mirror, rest, np.random.default_rng(0))
    ends = np.cumsum([arrays[name].shape[-1] for name in names])[:-1]
    parts = np.split(found.shapedirs, ends, -1)
    changed = {n: part.astype(arrays[n].dtype) for n, part in zip(names, parts, strict=True)}
    if "agedirs" not in arrays:
        return changed
    ages = arrays["agedirs"].astype(float)
    height = np.ptp(rest[:, 1])
    opened = []
    shapes = changed["shapedirs"].astype(float)
    for offset, spread in zip(np.moveaxis(ages, -1, 0), arrays["age_spread"], strict=True):
        size = np.ptp(rest[:, 1] + offset[:, 1]) / height
        own = size * spread * shapes
        meetings = Meetings(len(rest), {})
        mean = with_room(rest + offset, size * rest, own, skins, mirror, meetings)
        opened.append(mean - rest)
    return changed | {"agedirs": np.stack(opened, -1).astype(arrays["agedirs"].dtype)}


def _drawn(
    morphs: MorphSpace, count: int, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    macro = {name: np.clip(rng.normal(0.5, 0.17, count), 0, 1) for name in ANCHORS}
    macro |= {"gender": rng.uniform(0, 1, count), "age": rng.uniform(0.5, 0.8, count)}
    local = rng.normal(0, 0.08, (count, len(morphs.local_names)))
    sliders = Sliders(macro, rng.dirichlet(np.ones(3), count), local)
    return sliders.macro, sliders.races, sliders.local


def _lines(arrays: dict[str, np.ndarray]) -> FaceLines:
    rest = arrays["v_template"].astype(float)
    return face_lines(rest, arrays["quads"], arrays["hidden_quads"])


def _head_skins(arrays: dict[str, np.ndarray], head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of both levels, over the full vertices, whose corners are all of the head."""
    coarse = arrays["coarse_vertices"][arrays["coarse_faces"]]
    return tuple(
        faces[((faces < BODY_VERTICES) & (head[faces] > 0)).all(1)]
        for faces in (arrays["faces"], coarse)
    )


def _regressor(arrays: dict[str, np.ndarray]) -> sparse.csr_matrix:
    rows, cols, values = (arrays[name] for name in _REGRESSOR)
    shape = len(arrays["joint_names"]), len(arrays["v_template"])
    return sparse.csr_matrix((values.astype(float), (rows, cols)), shape)


def _jaw_axis(arrays: dict[str, np.ndarray], mirror: np.ndarray) -> dict[str, np.ndarray]:
    """The regressor with the jaw's row from `rig.JAW_AXIS`, or the coarse vertices nearest to it."""
    jaw = JOINTS.index("jaw")
    rest = arrays["v_template"].astype(float)
    coarse = arrays["coarse_vertices"]
    table = _regressor(arrays).tolil()
    table[jaw] = 0
    for vertex, weight in surface_places("jaw", mirror).items():
        near = coarse[((rest[coarse] - rest[vertex]) ** 2).sum(1).argmin()]
        table[jaw, near] += weight
    found = table.tocoo()
    values = found.row.astype(np.int32), found.col.astype(np.int32), found.data.astype(np.float32)
    return dict(zip(_REGRESSOR, values, strict=True))
