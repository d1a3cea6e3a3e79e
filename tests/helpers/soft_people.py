"""People of tubes in motion whose flesh follows planted dynamics: registrations with betas, pose
and trans.
"""

import numpy as np
from soft_tubes import RATE, shaken

from habitus.body.model import BodyModel
from habitus.body.soft_tissue import simulate_soft_tissue
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.mesh.registrations import Registrations


def soft_people(
    body: BodyModel,
    people: int = 4,
    sequences: int = 2,
    frames: int = 150,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[MovingSurface, ...]:
    """Sequences of people whose first two shape coefficients differ; ``noise`` (m) of each
    vertex.
    """
    rng = np.random.default_rng(seed)
    found = []
    for person in range(people):
        betas = np.concatenate([rng.uniform(-1.5, 1.5, 2), np.zeros(2)])
        for k in range(sequences):
            pose, trans = shaken(frames, seed=100 * seed + 10 * person + k)
            delta = simulate_soft_tissue(body, betas, pose, trans, RATE)
            surfaces = body(betas, pose, trans, dynamics=delta).vertices
            surfaces = surfaces + noise * rng.normal(size=surfaces.shape)
            name = f"person{person}_motion{k}"
            subject = f"person{person}"
            words = {"subject": (subject,), "sex": ("",), "set": ("pose",)}
            names = tuple(f"{name}:{frame}" for frame in range(frames))
            meshes = Registrations(
                surfaces,
                body.faces,
                name=names,
                **{key: word * frames for key, word in words.items()},
            )
            found.append(MovingSurface(name, subject, RATE, meshes, betas, pose, trans))
    return tuple(found)
