"""What a registered scan is worth, by numbers that can be checked without knowing the truth."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from habitus.fit.verdict import DOUBTFUL, FAILED, GOOD, Verdict, worst

MEDIAN, P95 = (0.0015, 0.004), (0.006, 0.020)
"""Metres: scan to surface, from which on it is doubtful, and failed."""
MODEL = (0.008, 0.020)
"""Metres: scan to model, median."""
MATCHED = (0.93, 0.80)
"""The share of the scan that the model explains (within 5 cm, normals alike)."""
BETAS = (1.9, 2.8)
"""Root mean square of the betas: 1 is usual."""
POSE = (2.2, 3.5)
"""Root mean square of the pose in the prior's standard deviations."""
LEAST_SEEN = (0.6, 0.15)
LOST = (0.0025, 0.006)
"""The share of the scan that lies off the surface in one place: half a hand is 0.5 %."""
CUTS = (40, 800)
"""Pairs of triangles that cut each other in the surface and not in the model: skin that belongs
elsewhere.
"""
MOST_BALLS = 1000
LOST_AWAY, LOST_WIDE = 0.006, 0.06
"""Metres: how far off the surface, and in how large a ball."""


def judge_scan(fit: Any) -> Verdict:
    """The verdict on a `habitus.fit.registration.result.ScanFit`."""
    if not fit.person:
        return Verdict(
            FAILED,
            (
                "nothing in the scan has the form of a person: no more than a rough start was "
                "fitted.",
            ),
        )
    betas = float(np.sqrt(np.mean(np.square(fit.betas)))) if len(fit.betas) else 0.0
    median, p95 = (float(np.percentile(fit.to_surface, share)) for share in (50, 95))
    findings = [
        _above(
            float(np.median(fit.to_model)),
            MODEL,
            "the model is {:.1f} mm from the scan (median)",
            1e3,
        ),
        _below(fit.matched, MATCHED, "only {:.0f} % of the scan is a surface of the body", 100.0),
        _above(median, MEDIAN, "the surface is {:.1f} mm from the scan (median)", 1e3),
        _above(p95, P95, "a twentieth of the scan is {:.0f} mm or more from the surface", 1e3),
        _above(
            fit.lost,
            LOST,
            "{:.1f} % of the scan lie together off the surface: a hand or foot is elsewhere",
            100.0,
        ),
        _above(
            fit.cuts, CUTS, "the surface cuts itself {:.0f} times: a hand or foot is elsewhere", 1.0
        ),
        _above(betas, BETAS, "the shape is {:.1f} times as far from the mean as people are", 1.0),
        _above(
            fit.pose_distance,
            POSE,
            "the pose is {:.1f} times as far from the mean as poses are",
            1.0,
        ),
        _below(
            fit.seen,
            LEAST_SEEN,
            "the scan shows {:.0f} % of the body; the rest continues the model",
            100.0,
        ),
    ]
    if fit.rival is not None and fit.rival < 1.05:
        findings.append((DOUBTFUL, "another pose fits nearly as well"))
    told = sorted((one for one in findings if one[0] != GOOD), key=lambda one: one[0] != FAILED)
    return Verdict(worst([level for level, _ in findings]), tuple(f"{text}." for _, text in told))


def lost_share(points: Float[np.ndarray, "N 3"], away: Float[np.ndarray, " N"]) -> float:
    """The share of a scan's points that lie off the surface (``away``, m) in the place where most
    of them do.
    """
    return lost_piece(points, away)[0]


def lost_piece(
    points: Float[np.ndarray, "N 3"], away: Float[np.ndarray, " N"]
) -> tuple[float, Float[np.ndarray, " 3"]]:
    """That share, and the place (m)."""
    off = points[away > LOST_AWAY]
    if len(off) == 0:
        return 0.0, points.mean(0)
    few = off[:: max(1, len(off) // MOST_BALLS)]
    balls = cKDTree(off).query_ball_point(few, LOST_WIDE, return_length=True)
    return float(balls.max() / len(points)), few[balls.argmax()]


def _above(value: float, limits: tuple[float, float], text: str, unit: float) -> tuple[str, str]:
    level = FAILED if not value <= limits[1] else DOUBTFUL if value > limits[0] else GOOD
    return level, text.format(unit * value)


def _below(value: float, limits: tuple[float, float], text: str, unit: float) -> tuple[str, str]:
    level = FAILED if not value >= limits[1] else DOUBTFUL if value < limits[0] else GOOD
    return level, text.format(unit * value)
