"""The trained arrays as a body model, with what the template's own body knows besides (landmarks,
pose prior, sex).
"""

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.pose_features import of_joints
from habitus.learn.posing.rig import Rig
from habitus.learn.shape.shape_space import ShapeSpace
from habitus.mesh.template import Template

_OF_THE_FILE = ("license", "version", "description")  # of a body file, not of the body
SIGNS = "joint_regressor_signs"
"""The name, among the ``extras`` of a trained body, of what its joint regressor's weights are:
"non-negative", as SMPL's (S 4.1), or "signed".
"""
_CARRIED = ("pose_prior", "part", "expressiondirs", "face", "ages", "mesh")


def assemble(
    name: str,
    template: Template,
    rig: Rig,
    regressor: Float[np.ndarray, "J V"],
    shape: ShapeSpace,
    body: BodyModel | None = None,
) -> BodyModel:
    """The trained arrays as a body model; ``body`` is the one that the template is of, if it is of
    any.

    All that such a body knows and training does not find is carried over as it is: ages,
    expressions, quads, texture, parts, mirror, pose prior, hands.
    """
    trained = BodyModel(
        name=name,
        v_template=np.array(shape.mean, np.float64),
        shapedirs=np.array(shape.directions, np.float64),
        joint_regressor=np.array(regressor),
        skinning_index=rig.index.copy(),
        skinning_value=rig.value.copy(),
        parents=template.parents,
        faces=np.array(template.faces, np.int64),
        joint_names=template.joint_names,
        skinning=rig.skinning,
        landmarks=MappingProxyType(dict(template.landmarks)),
        part=np.array(template.part, np.int64),
        mirror=None if template.mirror is None else np.array(template.mirror, np.int64),
        pose_features=rig.pose_features,
        shape_features=rig.shape_features,
        **_pose_shapes(rig),
    )
    if body is not None:
        trained = replace(trained, **_carried_over(body, shape))
    signs = np.array("signed" if (regressor < 0.0).any() else "non-negative")
    return replace(trained, extras=MappingProxyType({**trained.extras, SIGNS: signs}))


def _pose_shapes(rig: Rig) -> dict[str, Any]:
    """Pose blend shapes of the joints that drive any; of all where all do, and where none does."""
    if rig.posedirs is None:
        return {"posedirs": None}
    joints = tuple(range(1, rig.num_joints))
    blocks = rig.posedirs.reshape(*rig.posedirs.shape[:2], 1 + rig.shape_features, len(joints), -1)
    drivers = tuple(
        joint for joint, drives in zip(joints, np.any(blocks, (0, 1, 2, 4)), strict=True) if drives
    )
    if not drivers or drivers == joints:
        return {"posedirs": rig.posedirs.copy()}
    return {
        "posedirs": of_joints(rig.posedirs, blocks.shape[-1], joints, drivers, rig.shape_features),
        "pose_joints": drivers,
    }


def _carried_over(body: BodyModel, shape: ShapeSpace) -> dict[str, Any]:
    """What a body knows that training does not find, for the same mesh and the same joints."""
    extras = {key: value for key, value in body.extras.items() if key not in _OF_THE_FILE}
    same = shape.directions.shape == body.shapedirs.shape and np.array_equal(
        shape.directions, body.shapedirs
    )
    same = same and np.array_equal(shape.mean, body.v_template)
    return {
        **{key: getattr(body, key) for key in _CARRIED},
        "female_direction": body.female_direction if same else sex_direction(body, shape),
        "female_rows": body.female_rows if same else None,
        "extras": MappingProxyType(extras),
    }


def sex_direction(
    body: BodyModel, shape: ShapeSpace
) -> tuple[Float[np.ndarray, " B"], float] | None:
    """A body's sex direction by the coefficients of another shape space of the same mesh; None
    where it has none.

    A surface of the space is brought to the body's coefficients by least squares over vertices and
    a translation, which is linear: so is what says how likely its person is a woman.
    """
    if body.female_direction is None:
        return None
    direction, bias = body.female_direction
    places = np.tile(np.eye(3), (body.num_vertices, 1))
    columns = np.concatenate([body.shapedirs.reshape(-1, body.num_betas), places], 1)
    surfaces = np.concatenate([(shape.mean - body.v_template)[..., None], shape.directions], -1)
    betas = np.linalg.lstsq(columns, surfaces.reshape(len(columns), -1), rcond=None)[0][
        : body.num_betas
    ]
    scores = direction @ betas
    return scores[1:], bias + float(scores[0])
