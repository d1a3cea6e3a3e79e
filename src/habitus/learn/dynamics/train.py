"""Training of dynamic blend shapes and of what predicts them, from people in motion (DMPL: S 6)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.dynamics import Dynamics, companion, motion_controls
from habitus.body.joint_layouts import SMPL
from habitus.body.model import BodyModel
from habitus.learn.dynamics.regression import (
    Choice,
    Components,
    DynamicsOptions,
    Example,
    learn_regressor,
    principal_components,
)
from habitus.learn.dynamics.sequences import MovingSurface, check_sequences, rest_residuals
from habitus.parallel.workers import Threads, Workers
from habitus.types import Progress

_BODY_JOINTS = SMPL.joint_names[:22]  # without hands: every set of joints has them


@dataclass(frozen=True, eq=False)
class LearnedDynamics:
    """A body with dynamics; each component's share of the residuals' variance; the choices that
    there were, best first; and the coefficients (T, D) of each sequence.
    """

    body: BodyModel
    shares: Float[np.ndarray, " D"]
    choices: tuple[Choice, ...]
    coefficients: tuple[Float[np.ndarray, "_ D"], ...]

    @property
    def modes(self) -> Float[np.ndarray, "M 2"]:
        """Frequency (Hz) and damping ratio of each way in which the mean person's flesh swings,
        slowest first.
        """
        assert self.body.dynamics is not None
        return swinging(self.body.dynamics)


def learn_dynamics(
    body: BodyModel,
    sequences: Sequence[MovingSurface],
    options: DynamicsOptions | None = None,
    workers: Workers | None = None,
    progress: Progress = lambda stage, share: None,
) -> LearnedDynamics:
    """Dynamic blend shapes of ``body`` and their regressor, in the place of any that it has.

    Residuals of the surfaces are carried back to the rest pose, their principal components are the
    blend shapes, and a regressor that is linear in history, controls and shape is learned by ridge.
    Sequences know betas, pose and trans; all have one rate, at which the regressor is learned.
    Raises HabitusError where they do not fit the body.
    """
    options = options or DynamicsOptions()
    workers = workers or Threads(1)
    sequences = tuple(sequence.for_body(body) for sequence in sequences)
    rate = check_sequences(sequences)
    components = _components(body, sequences, options, workers, progress)
    ends = np.cumsum([len(sequence) for sequence in sequences])
    coefficients = tuple(np.split(components.coefficients, ends[:-1]))
    names = tuple(name for name in _BODY_JOINTS if name in body.joint_names) or body.joint_names
    joints = [body.joint_names.index(name) for name in names]
    examples = []
    for sequence, course in zip(sequences, coefficients, strict=True):
        rest = body.rest_joints(sequence.betas)
        assert (
            sequence.pose is not None and sequence.trans is not None and sequence.betas is not None
        )
        controls = motion_controls(
            options.controls, joints, body.parents, rest, sequence.pose, sequence.trans, rate
        )
        examples.append(Example(course, controls, sequence.betas))
    progress("regressor", 0.0)
    sizes = np.sqrt((components.directions**2).sum((0, 1)))
    examples, group = _grouped(
        examples, [sequence.subject for sequence in sequences], options.settings.pieces
    )
    learned = learn_regressor(examples, group, sizes, names, rate, options)
    progress("regressor", 1.0)
    whole = replace(body, dynamics=Dynamics(components.directions, learned.regressor))
    return LearnedDynamics(whole, components.shares, learned.choices, coefficients)


def _components(
    body: BodyModel,
    sequences: tuple[MovingSurface, ...],
    options: DynamicsOptions,
    workers: Workers,
    progress: Progress,
) -> Components:
    subjects = list(dict.fromkeys(sequence.subject for sequence in sequences))
    personal = [
        subjects.index(sequence.subject) if options.personal and sequence.still is None else -1
        for sequence in sequences
    ]
    group = np.repeat(personal, [len(sequence) for sequence in sequences])

    def blocks():
        done = 0
        for _, rows in rest_residuals(body, sequences, workers, options.settings):
            done += len(rows)
            progress("residuals", done / len(group))
            yield rows

    return principal_components(blocks(), options.components, options.rank, group)


def _grouped(
    examples: list[Example], subjects: list[str], pieces: int
) -> tuple[list[Example], np.ndarray]:
    """What is held out together: people, or where there are not three, sequences; of a single one
    its ``pieces``.
    """
    people = list(dict.fromkeys(subjects))
    if len(people) >= 3:
        return examples, np.array([people.index(subject) for subject in subjects])
    if len(examples) == 1:
        (example,) = examples
        courses, controls = (
            np.array_split(rows, pieces) for rows in (example.coefficients, example.controls)
        )
        examples = [Example(*parts, example.betas) for parts in zip(courses, controls, strict=True)]
    return examples, np.arange(len(examples))


def swinging(
    dynamics: Dynamics, betas: Float[np.ndarray, " B"] | None = None
) -> Float[np.ndarray, "M 2"]:
    """Frequency (Hz) and damping ratio of each way in which flesh swings, of the mean person or of
    ``betas``.

    What dies down without swinging is left out.
    """
    history, _ = dynamics.regressor.of_person(np.zeros(0) if betas is None else betas)
    roots = np.linalg.eigvals(companion(history))
    poles = dynamics.regressor.rate_hz * np.log(roots[roots.imag > 1e-9])
    modes = np.stack([np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)], axis=1)
    return modes[np.argsort(modes[:, 0])]
