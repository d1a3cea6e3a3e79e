"""Made people that several sensors observe, and settings that fit them quickly."""

import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from rgbd_scene_small import QUICK_DEPTH

import habitus as hb
from habitus.fit.body_fit import JointStage
from habitus.fit.points.scan import Scan
from habitus.fit.points.settings import SCANS
from habitus.observe.simulated_markers import Faults, simulate_capture

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MOSH = replace(hb.FitSettings().mosh, soft_tissue=False)
QUICK_SCANS = replace(
    SCANS,
    offset_stages=(),
    last_stages=SCANS.offset_stages[:1],
    search=replace(
        SCANS.search, candidates=1, drawn_poses=0, headings=8, checked=60, kept=6, refined=2
    ),
    limbs=replace(
        SCANS.limbs, rounds=0, stages=tuple(replace(one, steps=2) for one in SCANS.limbs.stages)
    ),
    surface=replace(SCANS.surface, points=1500, stages=SCANS.surface.stages[:1], stretched=1.0),
)
QUICK = hb.FitSettings(
    frames=4,
    motion=False,
    stages=(JointStage(0.06, 2.0, iterations=5), JointStage(0.03, 1.0, "pixel", iterations=8)),
    mosh=MOSH,
    depth=QUICK_DEPTH,
    scans=QUICK_SCANS,
)
SHOTS = (0, 30)
"""Frames of the capture at which the depth camera looked."""


@cache
def example():
    """examples/two_sensors.py."""
    spec = importlib.util.spec_from_file_location("two_sensors", EXAMPLES / "two_sensors.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["two_sensors"] = module
    spec.loader.exec_module(module)
    return module


@cache
def body():
    """Of few shape coefficients."""
    return hb.load_body("default").with_betas(6)


@cache
def person(seed):
    """Truth (betas, pose, trans), 12 markers, and two depth views."""
    return example().person(body(), seed)


def scan_of(seed, frame, noise=0.002, count=3000, lowest=-2.0):
    """A noisy scan of a made person, whose root is at the origin, above a height (m), as a sensor."""
    betas, pose, _ = person(seed)[0]
    rng = np.random.default_rng([seed, frame])
    corners = np.asarray(body()(betas, pose[frame], np.zeros(3)).vertices)[body().faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    chance = area * (corners[:, :, 1].min(1) > lowest)
    face = rng.choice(len(area), count, p=chance / chance.sum())
    points = np.einsum("pk,pkc->pc", rng.dirichlet(np.ones(3), count), corners[face])
    points += rng.normal(0.0, noise, points.shape)
    scan = Scan(f"scan {frame}", points, normal[face] / area[face, None])
    return hb.Scan(scan, unit="m", up="+y")


def halves(seed):
    """Two captures of a made person, with the upper and the lower markers of 41: 15 frames each."""
    truth = person(seed)[0]
    layout = hb.load_layout("cmu-41")
    places = (layout.vertices(body()), layout.distances())
    faults = Faults(noise=0.0005, placement=0.01, missing=0.0)
    rng = np.random.default_rng(seed)
    whole = simulate_capture(body(), *truth, *places, faults, rng).observed
    height = whole[..., 1].mean(0) - np.median(whole[..., 1].mean(0))
    upper, lower = (
        np.where(keep[:, None], whole, np.nan) for keep in (height > 0.05, height < 0.25)
    )
    captures = upper[:15], lower[40:55]
    return truth, [hb.Markers(each, layout, fps=30.0) for each in captures]


def shape_error(fit, truth):
    """Mean distance (m) of the skin at rest from the truth."""
    off = body().rest_vertices(fit.betas) - body().rest_vertices(truth[0])
    return np.linalg.norm(off, axis=1).mean()


def joint_error(found, truth, frames):
    """Mean distance (m) of joints (F, J, 3) from the truth in some frames."""
    at = list(frames)
    joints = body()(truth[0], truth[1][at], truth[2][at]).joints
    return np.linalg.norm(np.asarray(found) - joints, axis=2).mean()
