# SPDX-License-Identifier: GPL-3.0-or-later
"""The body's arrays and what follows from them: NumPy alone, so that Blender's own Python runs
it.
"""

import math
import zipfile
from pathlib import Path

import numpy as np


class Body:
    """A body of V vertices, J joints, B betas, metres, +y up, facing +z, as `blender/build.py`
    packs it.

    ``ages`` (A,) are the years of its mean people, none for most bodies of files; ``faces`` are
    quads or triangles.
    """

    def __init__(self, arrays: dict, name: str):
        self.arrays, self.name = arrays, name
        self.joint_names = [str(each) for each in arrays["joint_names"]]
        self.parents = arrays["parents"].tolist()
        self.drivers = arrays["drivers"].tolist()
        self.num_betas = arrays["shapedirs"].shape[-1]
        self.ages = arrays.get("age_years", np.zeros(0))

    @classmethod
    def packed(cls, path: Path) -> "Body":
        """One that came with the add-on."""
        with np.load(path) as file:
            return cls({name: file[name] for name in file.files}, path.stem)

    def grown(self, age: float) -> tuple[np.ndarray, float, float]:
        """How much of each of the ages' mean people there is at an age (A,), how tall over the
        adult, and the factor of the shapes; 0: no age.
        """
        if age <= 0 or not len(self.ages):
            return np.zeros(len(self.ages)), 1.0, 1.0
        years = np.clip(age, self.ages[0], self.ages[-1])
        shares = np.array([np.interp(years, self.ages, unit) for unit in np.eye(len(self.ages))])
        tall = self.arrays["age_statures"] / self.arrays["age_adult"]
        return shares, float(tall @ shares), float((tall * self.arrays["age_spread"]) @ shares)

    def rest(self, betas: np.ndarray, age: float = 0.0) -> np.ndarray:
        """The shaped vertices (V, 3) at rest."""
        return self._shaped("v_template", "shapedirs", "age_directions", betas, age)

    def joints(self, betas: np.ndarray, age: float = 0.0) -> np.ndarray:
        """The joints (J, 3) at rest."""
        return self._shaped("joint_template", "joint_shapedirs", "joint_age_directions", betas, age)

    def correctives(self, rotations: np.ndarray, betas: np.ndarray, age: float = 0.0) -> np.ndarray:
        """Pose blend shapes (V, 3; m at rest) for the joints' local rotations (J, 3, 3)."""
        start, vertices, values = (
            self.arrays[f"pose_{name}"] for name in ("start", "vertices", "values")
        )
        offsets = np.zeros_like(self.arrays["v_template"])
        for k, joint in enumerate(self.drivers):
            rows = slice(start[k], start[k + 1])
            offsets[vertices[rows]] += values[rows] @ (rotations[joint] - np.eye(3)).reshape(9)
        for k, weight in enumerate(self.folded(rotations)):
            if weight > 0:
                moved, shape = self.fold(k, betas)
                offsets[moved] += weight * shape
        return self.grown(age)[1] * offsets

    def folded(self, rotations: np.ndarray) -> np.ndarray:
        """Weights (..., C) of the folds for the joints' local rotations (..., J, 3, 3)."""
        joints, rows, bias = (self.arrays[f"fold_{name}"] for name in ("joints", "rows", "bias"))
        turned = rotations[..., joints, :, :] - np.eye(3)
        return np.clip((turned * rows.reshape(-1, 3, 3)).sum((-2, -1)) - bias, 0.0, 1.0) ** 2

    def fold(self, k: int, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The vertices that a fold moves, and how (N, 3; m)."""
        start, vertices, values = (
            self.arrays[f"fold_{name}"] for name in ("start", "vertices", "values")
        )
        rows = slice(start[k], start[k + 1])
        known = np.append(1.0, self.padded(betas)[: values.shape[-1] - 1])
        return vertices[rows], values[rows] @ known

    def _shaped(
        self, template: str, directions: str, ages: str, betas: np.ndarray, age: float
    ) -> np.ndarray:
        shares, _, shape = self.grown(age)
        shaped = self.arrays[template] + shape * (self.arrays[directions] @ self.padded(betas))
        return shaped + self.arrays[ages] @ shares if shares.any() else shaped

    def padded(self, betas: np.ndarray) -> np.ndarray:
        """Betas (B,), of those that were given and zeros."""
        given = np.asarray(betas, np.float64).ravel()[: self.num_betas]
        return np.pad(given, (0, self.num_betas - len(given)))


UP = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
SHIPPED = {"default": "neutral", "neutral": "neutral", "female": "female", "male": "male"}
RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")


class Motion:
    """What an npz says of a body in motion: ``pose`` (T, J, 3; rad), ``trans`` (T, 3; m),
    ``betas``, ``rate`` (Hz).

    ``age`` is 0 where none is told; ``missing`` are joints that turn in the file and that this body
    has not; ``dynamics`` (T, D) are coefficients of the body's soft tissue, or None. Raises
    ValueError for a file that holds no motion of this body.
    """

    def __init__(self, path: str, arrays: dict, body: Body):
        try:
            self._read(path, arrays, body)
        except ValueError:
            raise
        except Exception as error:  # arrays of any kind and shape
            raise ValueError(f"its arrays do not fit together ({type(error).__name__})") from error

    def _read(self, path: str, arrays: dict, body: Body) -> None:
        missing = [name for name in ("poses", "trans") if name not in arrays]
        if missing:
            raise ValueError(
                f"holds no {missing[0]}; expected the body.npz of a fit, or an npz as AMASS has "
                "them"
            )
        rates = [float(arrays[name]) for name in RATES if name in arrays]
        if not rates or not 0 < rates[0] < 1e6:
            raise ValueError("does not say its frames a second, mocap_framerate")
        names = [str(name) for name in arrays["joint_names"]] if "joint_names" in arrays else None
        pose = np.asarray(arrays["poses"], np.float64).reshape(len(arrays["poses"]), -1, 3)
        if names is None:
            names = layouts().get(pose.shape[1])
        if names is None or len(names) != pose.shape[1]:
            raise ValueError(f"poses of {pose.shape[1]} joints without their names")
        self.missing = [
            name
            for k, name in enumerate(names)
            if name not in body.joint_names and pose[:, k].any()
        ]
        self.pose = np.zeros((len(pose), len(body.joint_names), 3))
        for joint, name in enumerate(body.joint_names):
            if name in names:
                self.pose[:, joint] = pose[:, names.index(name)]
        self.name = Path(path).parent.name if Path(path).name == "body.npz" else Path(path).stem
        self.trans = np.asarray(arrays["trans"], np.float64)
        self.betas = np.asarray(
            arrays.get("body_betas", arrays.get("betas", np.zeros(0))), np.float64
        )
        self.age, self.rate = float(arrays.get("age_years", 0.0)), rates[0]
        self.upright = np.array(UP[str(arrays.get("up_axis", "+z"))], np.float64)
        self.dynamics = (
            np.asarray(arrays["soft_tissue_dynamics"]) if "soft_tissue_dynamics" in arrays else None
        )
        numbers = {
            "poses": self.pose,
            "trans": self.trans,
            "betas": self.betas,
            "age_years": self.age,
        }
        numbers |= {} if self.dynamics is None else {"soft_tissue_dynamics": self.dynamics}
        for name, array in numbers.items():
            if not (np.abs(array) <= 1e6).all():
                raise ValueError(f"{name} are not all finite numbers")
        if self.trans.shape != (len(self.pose), 3) or self.betas.ndim != 1 or not len(self.pose):
            raise ValueError("poses, trans and betas of shapes that do not fit together")
        self.left_out = bool(
            np.any(arrays.get("soft_tissue_betas", 0)) or np.any(arrays.get("dmpls", 0))
        )


def read_arrays(path: str) -> dict:
    """All arrays of an npz, none of them pickled. Raises OSError or ValueError for other files, and
    for those whose arrays would fill more than 128 MB and ten times the file.
    """
    try:
        limit = 10 * Path(path).stat().st_size + (1 << 27)
        with zipfile.ZipFile(path) as members:
            if sum(member.file_size for member in members.infolist()) > limit:
                raise ValueError("claims more than a file of its size holds; it is damaged")
            for member in members.namelist():
                with members.open(member) as stream:
                    shape, _, dtype = _header(stream)
                    if math.prod(max(1, n) for n in shape) * max(1, dtype.itemsize) > limit:
                        raise ValueError("claims more than a file of its size holds; it is damaged")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError):
        raise
    except Exception as error:  # a damaged file may raise anything; deep brackets a MemoryError
        raise ValueError(f"is no npz of arrays ({type(error).__name__})") from None


def _header(stream: object) -> tuple:
    """Shape, order and type in the header of an array."""
    version = np.lib.format.read_magic(stream)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read:
        raise ValueError("holds an array of an unknown version")
    return read[version](stream)


def whose(arrays: dict) -> str:
    """The name of the shipped body that a motion's betas belong to; "" where they belong to
    another.
    """
    name = str(arrays.get("surface_model_type", arrays.get("body", "")))
    return "" if "character_vertices" in arrays else SHIPPED.get(name, "")


def layouts() -> dict:
    """Joint names of the bodies of the SMPL family, by how many joints they have."""
    words = (Path(__file__).parent / "joint_names.txt").read_text().splitlines()
    return {len(line.split()): line.split() for line in words}


def quaternions(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (…, 3) as quaternions (…, 4), w first."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate(
        [np.cos(angle / 2), vectors * (0.5 * np.sinc(angle / (2 * np.pi)))], axis=-1
    )


def rotation_vectors(turns: np.ndarray) -> np.ndarray:
    """Quaternions (…, 4), w first, as rotation vectors (…, 3) of less than a turn."""
    turns = turns * np.where(turns[..., :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(turns[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, turns[..., :1])
    return turns[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def matrices(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (…, 3) as matrices (…, 3, 3)."""
    w, x, y, z = np.moveaxis(quaternions(vectors), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
