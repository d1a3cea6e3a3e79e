"""Numbers about a finished space, on soldiers that were not used to build it."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from .contacts import draws
from .crowd import Crowd, measured
from .intersections import intersecting_pairs, turned_over
from .landmarks import MIDLINE
from .measure import MEASURES, Tapes
from .rig import JOINTS
from .shape_space import ShapeSpace, female_direction

COMPONENTS = 20
DRAWN = 200


def vertex_errors(
    space: ShapeSpace,
    vertices: np.ndarray,
    measures: np.ndarray | None,
    counts: tuple[int, ...],
    among: np.ndarray,
) -> dict[int, float]:
    """Components -> mean distance in mm between bodies (N,V,3) and their best fit with so many
    components, over the vertices `among`.

    measures (N,M): betas in the space's own metric; None: those of vertices alone.
    """
    found = {}
    for count in counts:
        miss = np.linalg.norm(space.bodies(space.fit(vertices, count, measures)) - vertices, axis=2)
        found[count] = round(1000 * float(miss[:, among].mean()), 2)
    return found


def surface_errors(
    space: ShapeSpace, vertices: np.ndarray, area: np.ndarray, counts: tuple[int, ...]
) -> dict[int, tuple[float, float]]:
    """Components -> mean and 95th percentile of the distance in mm between bodies (N,V,3) and their
    best fit, over the surface: area (V,) is what each vertex stands for.
    """
    root = np.sqrt(area / area.sum())[:, None]
    found = {}
    for count in counts:
        basis = (space.shapedirs[..., :count] * root[..., None]).reshape(-1, count)
        offsets = ((vertices - space.mean) * root).reshape(len(vertices), -1)
        betas = np.linalg.solve(basis.T @ basis, basis.T @ offsets.T).T
        miss = np.linalg.norm(space.bodies(betas) - vertices, axis=2)
        order = np.argsort(miss, 1)
        share = np.cumsum(area[order], 1) / area.sum()
        far = np.take_along_axis(miss, order, 1)[np.arange(len(miss)), (share < 0.95).sum(1)]
        mean = float((miss * area).sum(1).mean() / area.sum())
        found[count] = round(1000 * mean, 2), round(1000 * float(far.mean()), 2)
    return found


def measured_from_betas(
    betas: tuple[np.ndarray, np.ndarray], train: Crowd, test: Crowd, tapes: dict[bool, Tapes]
) -> dict[str, dict[str, float]]:
    """Column -> errors in mm (kg) over held-out soldiers, from the first 20 betas (N,20) of both
    crowds' bodies.

    "regressed": RMSE of the survey's value told by a linear regression on the betas. "bias",
    "rmse": of the tape laid round the body that the betas give, taken back to the survey's postures
    through its measuring points.
    """
    here, there = (np.concatenate([b, np.ones((len(b), 1))], 1) for b in betas)
    predicted = there @ np.linalg.lstsq(here, train.values, rcond=None)[0]
    points = np.zeros(test.points.shape)
    for woman in np.unique(test.female):  # measuring points differ between the sexes
        known, new = train.female == woman, test.female == woman
        own = train.points[known].reshape(known.sum(), -1)
        line = np.linalg.lstsq(here[known], own, rcond=None)[0]
        points[new] = (there[new] @ line).reshape(-1, *points.shape[1:])
    errors = predicted - test.values, measured(points, test.female, tapes) - test.values
    unit = np.where(np.array(MEASURES) == "weightkg", 1.0, 1000.0)
    rms = [unit * np.sqrt((e**2).mean(0)) for e in errors]
    bias = unit * errors[1].mean(0)
    return {
        name: {"regressed": _round(rms[0][k]), "bias": _round(bias[k]), "rmse": _round(rms[1][k])}
        for k, name in enumerate(MEASURES)
    }


def _round(value: float) -> float:
    return round(float(value), 2)


def meeting_share(
    space: ShapeSpace, faces: np.ndarray, rng: np.random.Generator, count: int = DRAWN
) -> dict[str, dict[str, float]]:
    """For normal and uniform draws: the shares of bodies that cut themselves, or turn a triangle
    over, or either.
    """
    found = {}
    for kind in ("normal", "uniform"):
        cut = np.zeros(count, bool)
        over = np.zeros(count, bool)
        for k, body in enumerate(space.bodies(draws(count, space.shapedirs.shape[-1], kind, rng))):
            cut[k] = len(intersecting_pairs(body, faces)) > 0
            over[k] = turned_over(body, faces, space.mean).any()
        found[kind] = {
            "cut": float(cut.mean()),
            "turned": float(over.mean()),
            "either": float((cut | over).mean()),
        }
    return found


def prominence(tapes: Tapes, points: np.ndarray) -> np.ndarray:
    """(N,) metres by which the chest's foremost point lies before the midline at the breasts'
    level, of people of one sex.
    """
    ring = points.reshape(len(points), -1)[:, tapes.where["chestdepth"]].reshape(len(points), -1, 3)
    front = np.where(
        ring[..., 2] > np.median(ring[..., 2], 1)[:, None], np.abs(ring[..., 0]), np.inf
    )
    return ring[..., 2].max(1) - ring[np.arange(len(ring)), front.argmin(1), 2]


def read_as_own_sex(
    neutral: ShapeSpace,
    female: np.ndarray,
    spaces: dict[bool, ShapeSpace],
    rng: np.random.Generator,
) -> dict[str, float]:
    """Share of random draws of the women's and the men's space that a classifier of neutral betas
    reads as such.
    """
    weights, bias = female_direction(neutral.betas, female)
    found = {}
    for woman, space in spaces.items():
        bodies = space.bodies(draws(DRAWN, space.shapedirs.shape[-1], "normal", rng))
        score = neutral.fit(bodies) @ weights + bias
        found["female" if woman else "male"] = float(((score > 0) == woman).mean())
    return found


def joint_errors(
    regressor: sparse.csr_matrix, vertices: np.ndarray, joints: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Joint -> (mean, 95th percentile) distance in mm between regressed and true joints."""
    found = np.stack([regressor @ body for body in vertices])
    miss = 1000 * np.linalg.norm(found - joints, axis=2)
    return {
        name: (round(float(miss[:, k].mean()), 1), round(float(np.percentile(miss[:, k], 95)), 1))
        for k, name in enumerate(JOINTS)
    }


def stature_range(space: ShapeSpace, limit: float) -> tuple[float, float]:
    """Smallest and largest stature in metres with every |beta| <= limit (head top above the lowest
    vertex of the mean).
    """
    top = MIDLINE["head_top"]
    sole = int(space.mean[:, 1].argmin())
    middle = space.mean[top, 1] - space.mean[sole, 1]
    reach = limit * np.abs(space.shapedirs[top, 1] - space.shapedirs[sole, 1]).sum()
    return round(float(middle - reach), 3), round(float(middle + reach), 3)
