"""Flesh in motion: a Newton step of the second backward difference formula a frame, driven by a
moving skeleton.

The formula takes much less of the motion's energy than implicit Euler's steps: what dies down does
so by the flesh's own damping. At rest in the same poses (`stills`) flesh is what motion is told
from.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from habitus_lab.population.flesh.flesh import Flesh
from habitus_lab.population.flesh.newton import Inertia, Solver, newton_step
from habitus_lab.population.flesh.paths import Skeleton, Walk, carried, walk
from habitus_lab.population.flesh.skin import ContactRule

DEEP = 0.025
"""A probe that lies deeper (m) in another part met it by mistake: in one frame flesh does not come
so far.
"""


@dataclass(frozen=True)
class Matter:
    """Density (kg/m^3), shear modulus (Pa) and Rayleigh's stiffness damping (s) of flesh.

    There is no gravity: the rest shape hangs in it already.
    """

    density: float = 1000.0
    shear: float = 15000.0
    damping: float = 0.01


def _solver(tolerance: float, gradients: int) -> Solver:
    return Solver(tolerance, gradients, contact=ContactRule(deep=DEEP))


@dataclass(frozen=True)
class Swing:
    """How motion is simulated: matter, each frame's step, and the walk to where the motion begins.

    Flesh at rest is found in every ``stride``-th frame, in ``steps`` steps from where bones carry
    it, and carried to those between.
    """

    matter: Matter = field(default_factory=Matter)
    solver: Solver = field(default_factory=lambda: _solver(0.02, 80))
    start: Walk = field(default_factory=lambda: Walk(most=10, solver=_solver(0.01, 200)))
    stride: int = 3
    steps: int = 2


def swing(
    flesh: Flesh,
    skeleton: Skeleton,
    poses: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    rate: float,
    way: Swing,
    start: Float[np.ndarray, "N 3"] | None = None,
) -> Iterator[Float[np.ndarray, "N 3"]]:
    """Nodes (m, without trans) in each frame of a motion at `rate` Hz; flesh begins undeformed by
    it.
    """
    nodes = at_rest(flesh, skeleton, poses[0], way) if start is None else start
    yield nodes
    if len(poses) == 1:
        return
    weight = 2.25 * flesh.mass * way.matter.density / way.matter.shear * rate**2
    moved = carried(skeleton, flesh, nodes, poses[0], poses[1])
    shift = trans[1] - trans[0]
    speed = last_speed = moved + shift - nodes  # m a frame
    before = nodes - speed  # the frame before, about the place of this one
    for t in range(1, len(poses)):
        if t > 1:
            moved = carried(skeleton, flesh, nodes, poses[t - 1], poses[t])
            shift = trans[t] - trans[t - 1]
        places = (4 * nodes - before) / 3 + (2 / 9) * (4 * speed - last_speed) - shift
        inertia = Inertia(places, weight, moved, way.matter.damping * rate)
        new, _ = newton_step(flesh, moved, skeleton.goal(poses[t]), way.solver, inertia)
        speed, last_speed = (3 * (new + shift) - 4 * nodes + before) / 2, speed
        before = nodes - shift
        nodes = new
        yield nodes


def stills(
    flesh: Flesh,
    skeleton: Skeleton,
    poses: Float[np.ndarray, "T J 3"],
    way: Swing,
    start: Float[np.ndarray, "N 3"] | None = None,
) -> Iterator[Float[np.ndarray, "N 3"]]:
    """Nodes (m, without trans) at rest in the same poses, one after the other."""
    nodes = at_rest(flesh, skeleton, poses[0], way) if start is None else start
    here = 0
    yield nodes
    while here < len(poses) - 1:
        there = min(here + way.stride, len(poses) - 1)
        new = carried(skeleton, flesh, nodes, poses[here], poses[there])
        goal = skeleton.goal(poses[there])
        for _ in range(way.steps):
            new, _ = newton_step(flesh, new, goal, way.start.solver)
        for t in range(here + 1, there):
            share = (t - here) / (there - here)
            back = carried(skeleton, flesh, new, poses[there], poses[t])
            yield (1 - share) * carried(
                skeleton, flesh, nodes, poses[here], poses[t]
            ) + share * back
        yield new
        nodes = new
        here = there


def at_rest(
    flesh: Flesh, skeleton: Skeleton, pose: Float[np.ndarray, "J 3"], way: Swing
) -> Float[np.ndarray, "N 3"]:
    """Nodes at rest in a pose. The path to it is walked without the root's turn, which changes
    nothing.
    """
    upright = pose.copy()
    upright[0] = 0
    [stop] = walk(flesh, skeleton, [upright], way.start)
    root = skeleton.motions(pose)[0]
    nodes = stop.nodes @ root[:, :3].T + root[:, 3]
    nodes[flesh.free :] = carried(skeleton, flesh, nodes, pose, pose)[flesh.free :]
    return nodes
