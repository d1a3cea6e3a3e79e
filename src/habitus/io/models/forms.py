"""A body model as named arrays for a file: under official names, or under the project's own."""

import numpy as np

from habitus.body.model import BodyModel
from habitus.io.models.details import ages_form, mesh_form
from habitus.io.models.dynamics import dynamics_form


def is_official(model: BodyModel) -> bool:
    """Whether an official file can hold it: pose blend shapes, if any, are linear in vec(R - I)
    alone.
    """
    return model.pose_features == "rotations" and not model.shape_features


def official_form(model: BodyModel) -> dict[str, np.ndarray]:
    """The arrays under the names and in the shapes of the SMPL family's own files, and what only
    our files hold.
    """
    return _official_arrays(model) | _own_arrays(model) | _smplx_fillers(model)


def own_form(model: BodyModel) -> dict[str, np.ndarray]:
    """The arrays under the project's own names: regressor and skinning weights without their
    zeros.
    """
    regressor = model.joint_regressor
    rows, columns = np.nonzero(regressor)
    keys = (
        "v_template",
        "shapedirs",
        "posedirs",
        "expressiondirs",
        "skinning_index",
        "skinning_value",
        "faces",
    )
    arrays = {key: value for key in keys if (value := getattr(model, key)) is not None}
    arrays |= {
        "joint_regressor_rows": rows,
        "joint_regressor_cols": columns,
        "joint_regressor_values": regressor[rows, columns],
        "parents": np.array(model.parents),
        "skinning": np.array(model.skinning),
        "pose_features": np.array(model.pose_features),
        "shape_features": np.array(model.shape_features),
    }
    return arrays | _own_arrays(model) | dict(model.extras)


def _official_arrays(model: BodyModel) -> dict[str, np.ndarray]:
    """What ``smplx`` reads, too."""
    v = model.num_vertices
    j = model.num_joints
    posedirs = model.smpl_posedirs()
    shapedirs = model.shapedirs
    expression = model.expressiondirs
    if expression is not None:  # smplx looks for expressions at a fixed place
        gap = max(0, (300 if expression.shape[-1] == 100 else 10) - model.num_betas)
        shapedirs = np.concatenate([shapedirs, np.zeros((v, 3, gap)), expression], -1)
    return {
        "v_template": model.v_template,
        "shapedirs": shapedirs,
        "num_betas": np.array(model.num_betas),
        "num_expressions": np.array(0 if expression is None else expression.shape[-1]),
        "posedirs": np.zeros((v, 3, 9 * (j - 1)), np.float32) if posedirs is None else posedirs,
        "J_regressor": model.joint_regressor,
        "weights": model.skinning_weights,
        "kintree_table": np.array([model.parents, range(j)]).astype(np.uint32),
        "f": model.faces.astype(np.uint32),
        "bs_style": np.array(model.skinning),
        "bs_type": np.array("lrotmin"),
    }


def _own_arrays(model: BodyModel) -> dict[str, np.ndarray]:
    """What only this project's files hold."""
    arrays = {"joint_names": np.array(model.joint_names)}
    arrays |= {
        key: value
        for key in ("part", "mirror", "people_mean")
        if (value := getattr(model, key)) is not None
    }
    arrays |= ages_form(model.ages) | mesh_form(model.mesh) | dynamics_form(model.dynamics)
    if model.pose_joints is not None:
        arrays["posedirs_joints"] = np.array(model.pose_joints, np.int64)
    if model.landmarks:
        arrays["landmark_names"] = np.array(list(model.landmarks))
        arrays["landmark_vertices"] = np.array(list(model.landmarks.values()))
    if model.pose_prior is not None:
        arrays["pose_mean"] = model.pose_prior.mean
        arrays["pose_precision"] = model.pose_prior.precision
    if model.female_rows is not None:
        arrays["gender_weights"], arrays["gender_bias"] = model.female_rows
    elif model.female_direction is not None:
        arrays["female_weights"] = model.female_direction[0]
        arrays["female_bias"] = np.array(model.female_direction[1])
    return arrays


def _smplx_fillers(model: BodyModel) -> dict[str, np.ndarray]:
    """The file's own extras, over neutral ones that ``smplx`` insists on: flat hands, landmarks at
    the first face.
    """
    mean = np.zeros(45)
    components = np.eye(45)
    fillers: dict[str, np.ndarray] = {}
    if model.num_joints == 16:
        fillers = {"hands_mean": mean, "hands_components": components}
    if model.num_joints in (52, 55):
        fillers = {f"hands_mean{side}": mean for side in "lr"} | {
            f"hands_components{side}": components for side in "lr"
        }
    if model.num_joints == 55:
        fillers |= {
            "lmk_faces_idx": np.zeros(51, np.int64),
            "lmk_bary_coords": np.eye(3)[np.zeros(51, np.int64)],
        }
    return fillers | dict(model.extras)
