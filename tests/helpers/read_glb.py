"""A second, small reader of skinned, morphed and animated GLB files: struct, json and NumPy
only.
"""

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

TYPES = {5121: "u1", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    def __init__(self, path: Path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json = json.loads(data[20 : 20 + size])
        self.blob = data[20 + size + 8 :]

    def array(self, accessor: int) -> np.ndarray:
        a = self.json["accessors"][accessor]
        if "sparse" in a:
            return self._sparse(a)
        view = self.json["bufferViews"][a["bufferView"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        width = WIDTH[a["type"]]
        flat = np.frombuffer(self.blob, TYPES[a["componentType"]], a["count"] * width, start)
        return flat.reshape(a["count"], width) if width > 1 else flat

    def _sparse(self, a: dict) -> np.ndarray:
        sparse = a["sparse"]
        dense = np.zeros((a["count"], WIDTH[a["type"]]))
        assert not {"bufferView", "byteOffset"} & set(a)
        start = [
            self.json["bufferViews"][sparse[part]["bufferView"]]["byteOffset"]
            for part in ("indices", "values")
        ]
        index = np.frombuffer(
            self.blob, TYPES[sparse["indices"]["componentType"]], sparse["count"], start[0]
        )
        assert (np.diff(index.astype(int)) > 0).all()
        dense[index] = np.frombuffer(self.blob, "f4", sparse["count"] * 3, start[1]).reshape(-1, 3)
        return dense

    def vertices(self, time: float) -> np.ndarray:
        """The surface at ``time`` (s), as the glTF 2.0 specification says (3.7.2.2 morph targets,
        3.7.3 skins).
        """
        nodes = [dict(node) for node in self.json["nodes"]]
        weights = self._sample(nodes, time)
        primitive = self.json["meshes"][0]["primitives"][0]
        attributes = primitive["attributes"]
        points = self.array(attributes["POSITION"]).astype(float)
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            points = points + weight * self.array(target["POSITION"])
        skin = self.json["skins"][0]
        bind = (
            self.array(skin["inverseBindMatrices"])
            .reshape(-1, 4, 4)
            .transpose(0, 2, 1)
            .astype(float)
        )
        whole = self._world(nodes)
        matrices = np.stack([whole[node] for node in skin["joints"]]) @ bind
        homogeneous = np.c_[points, np.ones(len(points))]
        moved = np.zeros((len(points), 4))
        for k in range(9):
            if f"JOINTS_{k}" not in attributes:
                break
            index = self.array(attributes[f"JOINTS_{k}"])
            value = self.array(attributes[f"WEIGHTS_{k}"])
            for c in range(4):
                moved += value[:, c, None] * np.einsum(
                    "vij,vj->vi", matrices[index[:, c]], homogeneous
                )
        return moved[:, :3]

    def _sample(self, nodes: list[dict], time: float) -> np.ndarray:
        weights = np.array(self.json["meshes"][0].get("weights", []))
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times = self.array(sampler["input"])
            values = self.array(sampler["output"])
            values = values.reshape(len(times), -1)
            value = np.array([np.interp(time, times, column) for column in values.T])
            if channel["target"]["path"] == "weights":
                weights = value
            else:
                nodes[channel["target"]["node"]][channel["target"]["path"]] = value
        return weights

    @staticmethod
    def _world(nodes: list[dict]) -> dict[int, np.ndarray]:
        parent = {child: k for k, node in enumerate(nodes) for child in node.get("children", [])}

        def local(node: dict) -> np.ndarray:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            matrix[:3, 3] = node.get("translation", [0, 0, 0])
            return matrix

        def whole(k: int) -> np.ndarray:
            return whole(parent[k]) @ local(nodes[k]) if k in parent else local(nodes[k])

        return {k: whole(k) for k in range(len(nodes))}
