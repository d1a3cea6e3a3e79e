"""Scans of people that a body model does not know: what a structured-light scanner would leave of a
surface.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.fit.points.scan import Scan
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.selection.problem import SELECTION
from habitus.mesh.normals import face_normals, vertex_normals
from habitus.observe.light import harmonic_terms, linear_from_srgb, srgb_bytes
from habitus_lab.population.painted_skin import PaintedSkin, soft_light

PATCH = 0.05
"""Metres: radius of a hole."""
CELL, BEHIND = 0.004, 0.01
"""Metres: what a camera tells apart across, and how far behind the nearest surface it still sees in
a cell.
"""
STANCES: Mapping[str, Mapping[str, tuple[float, float, float]]] = MappingProxyType(
    {
        "A": {"shoulder": (0.0, 0.0, -0.8)},
        "T": {},
        "arms up": {
            "shoulder": (0.0, -0.1, 0.7),
            "collar": (0.0, 0.0, 0.4),
            "elbow": (0.0, -0.3, 0.0),
        },
        "arms forward": {"shoulder": (0.0, -1.3, -0.1), "elbow": (0.0, -0.2, 0.0)},
        "elbows bent": {"shoulder": (0.0, -0.3, -0.7), "elbow": (0.0, -1.6, 0.0)},
        "step": {
            "shoulder": (0.0, 0.0, -1.0),
            "left_hip": (-0.5, 0.0, 0.05),
            "right_hip": (0.3, 0.0, -0.05),
            "left_knee": (0.3, 0.0, 0.0),
            "right_knee": (0.3, 0.0, 0.0),
        },
        "knee up": {
            "shoulder": (0.0, 0.0, -0.7),
            "left_hip": (-1.2, 0.0, 0.1),
            "left_knee": (1.4, 0.0, 0.0),
        },
        "squat": {
            "hip": (-1.0, 0.0, 0.25),
            "knee": (1.3, 0.0, 0.0),
            "ankle": (-0.3, 0.0, 0.0),
            "spine1": (0.2, 0.0, 0.0),
            "shoulder": (0.0, -1.2, -0.1),
        },
        "twisted": {
            "spine1": (0.0, 0.25, 0.0),
            "spine2": (0.0, 0.25, 0.0),
            "spine3": (0.0, 0.2, 0.0),
            "head": (0.0, 0.4, 0.0),
            "left_shoulder": (0.0, -0.6, 0.0),
            "right_shoulder": (0.0, 0.0, 0.9),
        },
        "bent": {
            "spine1": (0.3, 0.0, 0.0),
            "spine2": (0.3, 0.0, 0.0),
            "hip": (-0.4, 0.0, 0.15),
            "shoulder": (0.0, -0.4, -0.9),
            "neck": (-0.2, 0.0, 0.0),
        },
    }
)
"""Ten poses that people are scanned in: joint (of both sides, or of one) to rotation vector, rad,
of the left side.
"""
PIXEL, COLOUR_NOISE = 0.0003, 0.006
"""Metres (sd) that colours are beside where they belong, and their noise (sd, of linear light)."""
GRAZING = 0.15
"""Cosine of surface and line of sight below which a scanner sees nothing."""


@dataclass(frozen=True)
class Scanner:
    """How a scan is made: how many points, noise along every axis (m, sd), the share that holes
    take, and from where.

    ``sides`` are directions (unit, from the person to the camera) of which a point has to be seen
    from one; none: everything is seen. ``colours`` are the places of which a scan that has colours
    has them: pictures show more of a surface than points do (1 to 3 mm a pixel).
    """

    points: int = 100_000
    noise: float = 0.0005
    holes: float = 0.08
    sides: Sequence[tuple[float, float, float]] = ()
    colours: int = 400_000


BONY = ("hand", "wrist", "foot", "head", "toe")
JITTER = 0.08
"""Radians (sd) that joints are off a stance."""


def stance(
    name: str, joint_names: Sequence[str], rng: np.random.Generator
) -> Float[np.ndarray, "J 3"]:
    """A pose (rad) near one of `STANCES`, looking anywhere."""
    return posed_near(STANCES[name], joint_names, rng)


def posed_near(
    angles: Mapping[str, tuple[float, float, float]],
    joint_names: Sequence[str],
    rng: np.random.Generator,
) -> Float[np.ndarray, "J 3"]:
    """A pose (rad) near rotations as in `STANCES`; where these have no root, looking anywhere."""
    pose = np.zeros((len(joint_names), 3))
    off = JITTER * rng.normal(size=(len(joint_names), 3))
    for k, joint in enumerate(joint_names):
        side, _, part = joint.rpartition("_")
        turn = angles.get(joint, angles.get(part if side else joint, (0.0, 0.0, 0.0)))
        mirrored = side == "right" and joint not in angles
        pose[k] = np.array(turn) * ((1.0, -1.0, -1.0) if mirrored else (1.0, 1.0, 1.0)) + off[k]
    if joint_names[0] not in angles:
        pose[0] = 0.0, rng.uniform(-np.pi, np.pi), 0.0
    return pose


def person(
    body: BodyModel,
    pose: Float[np.ndarray, "J 3"],
    rng: np.random.Generator,
    flesh: float = SELECTION.flesh,
) -> Float[np.ndarray, "V 3"]:
    """The surface (m) of a random person in a pose, off what the model knows by ``flesh`` (m, sd)
    along its normals.

    The offset is smooth over some 8 cm (`habitus.fit.selection.held_out.smooth_field`), and a
    quarter as large on hands, feet and head.
    """
    betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
    surface = np.asarray(body(betas, pose).vertices)
    bony = [k for k, name in enumerate(body.joint_names) if name.rpartition("_")[2] in BONY]
    off = smooth_field(body.v_template, rng)[:, 0] * (
        1.0 - 0.75 * body.skinning_weights[:, bony].sum(1)
    )
    return surface + flesh * off[:, None] * vertex_normals(surface, body.faces)


def scanned(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    scanner: Scanner,
    rng: np.random.Generator,
    name: str = "scan",
    skin: PaintedSkin | None = None,
) -> Scan:
    """A cloud of points (m) drawn evenly from a surface, with noise and holes, in no order and
    without normals.

    skin: of that surface's mesh; gives the scan colours, as a camera in soft light sees them that
    is off by a pixel.
    """
    normals = face_normals(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    wanted = scanner.points if skin is None else scanner.colours
    face = rng.choice(len(faces), int(wanted * 1.02 / (1.0 - scanner.holes)), p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), len(face))
    points = np.einsum("pk,pkc->pc", share, vertices[faces[face]])
    unit = normals[face] / np.maximum(area[face], 1e-12)[:, None]
    kept = np.ones(len(points), dtype=bool)
    if scanner.sides:
        kept = np.any([_seen(points, unit, np.array(side)) for side in scanner.sides], axis=0)
    rows = np.flatnonzero(kept)
    rows = rows[~_holes(points[rows], scanner.holes, rng)][:wanted]
    points = points[rows] + scanner.noise * rng.normal(size=(len(rows), 3))
    if skin is None:
        return Scan(name, points)
    corners = faces[face[rows]]
    share = share[rows]
    looking = np.einsum("pk,pkc->pc", share, vertex_normals(vertices, faces)[corners])
    looking /= np.maximum(np.linalg.norm(looking, axis=1, keepdims=True), 1e-12)
    albedo = skin.albedo(corners, share, PIXEL, int(rng.integers(1 << 30)))
    bright = albedo * (harmonic_terms(looking) @ soft_light(rng)).clip(0.05)
    seen = srgb_bytes(bright + COLOUR_NOISE * rng.normal(size=bright.shape))
    return Scan(
        name, points[: scanner.points], colours=linear_from_srgb(seen / 255.0), colour_places=points
    )


def _holes(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Which points lie in holes: balls around points of the surface, as many as make up the
    share.
    """
    gone = np.zeros(len(points), dtype=bool)
    while len(points) and gone.mean() < share:
        gone |= ((points - points[rng.integers(len(points))]) ** 2).sum(1) < (
            PATCH * rng.uniform(0.5, 1.2)
        ) ** 2
    return gone


def _seen(points: np.ndarray, normals: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Which points a far camera on that side sees."""
    across = np.cross(side, np.eye(3)[np.abs(side).argmin()])
    across /= np.linalg.norm(across)
    depth = points @ side
    cells = np.floor(points @ np.stack([across, np.cross(side, across)]).T / CELL).astype(np.int64)
    _, cell = np.unique(cells @ [1 << 20, 1], return_inverse=True)  # one number a cell
    nearest = np.full(cell.max(initial=-1) + 1, -np.inf)
    np.maximum.at(nearest, cell.ravel(), depth)
    return (normals @ side > GRAZING) & (depth > nearest[cell.ravel()] - BEHIND)
