"""Flesh in motion: one Newton step of implicit Euler a frame, driven by a skeleton that moves through the world."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from habitus.population.flesh.flesh import Flesh
from habitus.population.flesh.newton import Inertia, Solver, newton_step
from habitus.population.flesh.paths import Skeleton, Walk, carried, walk


@dataclass(frozen=True)
class Matter:
    """Density (kg/m^3), shear modulus (Pa) and Rayleigh's stiffness damping (s) of flesh.

    There is no gravity: the rest shape hangs in it already.
    """

    density: float = 1000.0
    shear: float = 15000.0
    damping: float = 0.01


@dataclass(frozen=True)
class Swing:
    """How motion is simulated: matter, each frame's step, and the walk to where the motion begins."""

    matter: Matter = field(default_factory=Matter)
    solver: Solver = field(default_factory=lambda: Solver(tolerance=0.02, gradients=80))
    start: Walk = field(default_factory=lambda: Walk(most=10))


def swing(
    flesh: Flesh,
    skeleton: Skeleton,
    poses: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    rate: float,
    way: Swing,
) -> Iterator[Float[np.ndarray, "N 3"]]:
    """Nodes (m, in the world) in each frame of a motion at `rate` Hz; flesh begins at rest and moves with the bones."""
    nodes = _at_rest(flesh, skeleton, poses[0], way)
    weight = flesh.mass * way.matter.density / way.matter.shear * rate**2
    velocity: Float[np.ndarray, "N 3"] | None = None
    yield nodes + trans[0]
    for t in range(1, len(poses)):
        moved = carried(skeleton, flesh, nodes, poses[t - 1], poses[t])
        shift = trans[t] - trans[t - 1]
        if velocity is None:
            velocity = moved + shift - nodes
        places = nodes + velocity - shift
        inertia = Inertia(places, weight, moved, way.matter.damping * rate)
        new, _ = newton_step(flesh, moved, skeleton.goal(poses[t]), way.solver, inertia)
        velocity = new + shift - nodes
        nodes = new
        yield nodes + trans[t]


def _at_rest(flesh: Flesh, skeleton: Skeleton, pose: np.ndarray, way: Swing) -> np.ndarray:
    """The path to a pose is walked without the root's turn, which changes nothing."""
    upright = pose.copy()
    upright[0] = 0
    [stop] = walk(flesh, skeleton, [upright], way.start)
    root = skeleton.motions(pose)[0]
    nodes = stop.nodes @ root[:, :3].T + root[:, 3]
    nodes[flesh.free :] = carried(skeleton, flesh, nodes, pose, pose)[flesh.free :]
    return nodes
