"""Scenes for tests of marker fits: a small random body in smooth motion, and the markers seen of
it.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from rigged_body import random_body

from habitus.body.pose_features import Hinges
from habitus.fit.markers.marker_sequence import KernelSequence
from habitus.fit.markers.sequence import fit_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import BodyMarkers, predict
from habitus.observe.marker_rig import marker_rig
from habitus.observe.markers import attach


class DoubleSequence(KernelSequence):
    """The compiled kernels in float64, whose formulas are compared to the last digits."""

    dtype = np.float64


def scene(frames=12, seed=0, markers=25, noise=0.001, **kind):
    """A rig, its prior, a smooth motion of it and the markers that were seen."""
    rng = np.random.default_rng(seed)
    shapes = kind.pop("hinge_shapes", None)
    body = random_body(seed, **({"joints": 5, "posedirs": False, "betas": 4} | kind))
    if shapes is not None:
        body = replace(body, hinges=random_hinges(body, rng, shapes))
    betas = rng.normal(size=4)
    rest = body.v_template + body.shapedirs @ betas
    corners = body.faces[:markers]
    latent = rest[corners[:, 0]] + 0.03 * rng.normal(size=(markers, 3))
    attachment = attach(latent, rest, body.faces, triangles=corners)
    rig = marker_rig(body, betas, attachment)
    marked = BodyMarkers(body, betas, attachment)
    size = 3 * len(body.parents) - 3
    spread = rng.normal(size=(size, size))
    prior = SimpleNamespace(
        mean=0.2 * rng.normal(size=size),
        precision=spread @ spread.T / size + np.eye(size),
        joint_names=body.joint_names[1:],
    )
    time = np.arange(frames) / 30
    phase = rng.uniform(0, 6, (size + 3, 1))
    rate = rng.uniform(0.5, 2, (size + 3, 1))
    pose = (0.3 * np.sin(rate * time + phase)).T.reshape(frames, -1, 3)
    trans = np.stack([time, 1 + 0.1 * np.sin(time), -time], axis=1)
    observed = predict(rig, pose, trans) + noise * rng.normal(size=(frames, markers, 3))
    return SimpleNamespace(
        rig=rig, marked=marked, prior=prior, pose=pose, trans=trans, observed=observed, rng=rng
    )


def random_hinges(body, rng, shapes):
    """Three channels of two joints, in the middle of their range at small turns; one of them moves
    vertices that its joint's pose blend shapes do not.
    """
    directions = 0.05 * rng.normal(size=(body.num_vertices, 3, 3, 1 + shapes))
    directions[::3] = 0.0
    rows = rng.normal(size=(3, 9))
    joints = np.array([body.drivers[0], body.drivers[-1], body.drivers[-1]])
    return Hinges(joints, rows, np.full(3, -0.4), 0.3 * rng.normal(size=(3, 9)), directions)


def fit(s, observed=None, soft_tissue=None, weights=None, scales=None, **settings):
    start = s.pose + np.radians(8) * s.rng.normal(size=s.pose.shape)
    observed = s.observed if observed is None else observed
    settings = SequenceSettings(**settings)
    return fit_sequence(
        s.rig,
        observed,
        weights,
        scales,
        s.prior,
        start,
        s.trans + 0.05,
        settings,
        soft_tissue=soft_tissue,
    )


def degrees_apart(a, b):
    return np.degrees(np.abs(a - b).max())
