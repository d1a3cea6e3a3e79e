"""A made model of SMPL's form in another topology: our body's arrays carried over a map."""

import numpy as np

from habitus.body.model import BodyModel
from habitus.io.models.bodies import load_body
from habitus.io.topologies import load_topology


def planted_model(topology: str, sex: str = "female", betas: int = 10) -> BodyModel:
    """The body of a sex with the vertices of a topology, LBS with pose blend shapes, and its first
    betas. The joints are regressed from the mapped vertices.
    """
    source = load_body(sex, joints="smplh" if topology == "smpl" else "smplx").full
    assert source is not None
    places = load_topology(topology, source)
    onto = places.matrix()

    def carried(array: np.ndarray) -> np.ndarray:
        flat = array.reshape(len(array), -1)
        return np.asarray(onto @ flat).reshape(places.num_vertices, *array.shape[1:])

    template, shapes = carried(source.v_template), carried(source.shapedirs[..., :betas])
    weights = carried(source.skinning_weights)
    index = np.argsort(-weights, axis=1)[:, :6]
    value = np.take_along_axis(weights, index, 1)
    return BodyModel(
        name=f"planted_{topology}",
        v_template=template,
        shapedirs=shapes,
        posedirs=None
        if source.posedirs is None
        else carried(source.posedirs[..., : 9 * len(source.drivers)]),
        joint_regressor=_regressor(template, shapes, source, betas),
        skinning_index=index,
        skinning_value=value / value.sum(1, keepdims=True),
        parents=source.parents,
        faces=places.faces,
        joint_names=source.joint_names,
        pose_joints=source.pose_joints,
    )


def _regressor(
    template: np.ndarray, shapes: np.ndarray, source: BodyModel, betas: int
) -> np.ndarray:
    """The shortest rows that give the source's joints for its shapes, and sum to one."""
    count = len(template)
    known = np.concatenate(
        [template.T, np.moveaxis(shapes, 2, 0).transpose(0, 2, 1).reshape(-1, count)]
    )
    joints = np.concatenate(
        [
            source.joint_template.T,
            np.moveaxis(source.joint_shapedirs[..., :betas], 2, 0)
            .transpose(0, 2, 1)
            .reshape(-1, len(source.parents)),
        ]
    )
    known = np.concatenate([known, np.ones((1, count))])
    joints = np.concatenate([joints, np.ones((1, len(source.parents)))])
    return np.linalg.lstsq(known, joints, rcond=1e-10)[0].T
