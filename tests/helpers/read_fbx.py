"""A second, small reader of binary FBX 7.4 files, and what is seen of them: struct, zlib and NumPy
only.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

ARRAYS = {b"f": "<f4", b"d": "<f8", b"i": "<i4", b"l": "<i8"}
SINGLES = {b"C": "<?", b"I": "<i", b"L": "<q", b"D": "<d"}
TICKS = 46186158000


@dataclass
class Record:
    name: str
    values: list[Any]
    records: list["Record"] = field(default_factory=list)

    def __getitem__(self, name: str) -> "Record":
        return next(record for record in self.records if record.name == name)

    def all(self, name: str) -> list["Record"]:
        return [record for record in self.records if record.name == name]

    def prop(self, name: str) -> list[Any]:
        return next(p.values[4:] for p in self["Properties70"].records if p.values[0] == name)


def read_records(data: bytes) -> list[Record]:
    """The top records; every length and end in the file is checked."""
    assert data[:23] == b"Kaydara FBX Binary  \0\x1a\0" and struct.unpack_from("<I", data, 23) == (
        7400,
    )
    records = []
    at = 27
    while data[at : at + 13] != bytes(13):
        record, at = _record(data, at)
        records.append(record)
    foot = at + 13 + 16
    padding = 16 - foot % 16
    assert not any(data[foot : foot + padding]) and len(data) == foot + padding + 8 + 120 + 16
    assert struct.unpack_from("<II", data, foot + padding) == (0, 7400)
    return records


def _record(data: bytes, at: int) -> tuple[Record, int]:
    end, count, size, letters = struct.unpack_from("<IIIB", data, at)
    at += 13
    record = Record(data[at : at + letters].decode(), [])
    at += letters
    last = at + size
    for _ in range(count):
        value, at = _value(data, at)
        record.values.append(value)
    assert at == last
    while at < end:
        if data[at : at + 13] == bytes(13):
            at += 13
            break
        child, at = _record(data, at)
        record.records.append(child)
    assert at == end
    return record, at


def _value(data: bytes, at: int) -> tuple[Any, int]:
    kind = data[at : at + 1]
    at = at + 1
    if kind in SINGLES:
        return struct.unpack_from(SINGLES[kind], data, at)[0], at + struct.calcsize(SINGLES[kind])
    if kind in ARRAYS:
        count, is_packed, size = struct.unpack_from("<III", data, at)
        raw = data[at + 12 : at + 12 + size]
        array = np.frombuffer(zlib.decompress(raw) if is_packed else raw, ARRAYS[kind])
        assert len(array) == count
        return array, at + 12 + size
    assert kind in b"SR"
    size = struct.unpack_from("<I", data, at)[0]
    raw = data[at + 4 : at + 4 + size]
    return raw.decode() if kind == b"S" else raw, at + 4 + size


class Fbx:
    """A skinned mesh with blend channels in one take, posed as FBX says, in metres."""

    def __init__(self, path: Path):
        self.top = {record.name: record for record in read_records(path.read_bytes())}
        self.objects = {record.values[0]: record for record in self.top["Objects"].records}
        self.links = [record.values for record in self.top["Connections"].records]
        self.children: dict[int, list[tuple[Record, list[Any]]]] = {}
        for link in self.links:
            self.children.setdefault(link[2], []).append((self.objects[link[1]], link[3:]))
        settings = self.top["GlobalSettings"]
        self.metres = settings.prop("UnitScaleFactor")[0] / 100.0
        self.up = settings.prop("UpAxis")[0]
        self.geometry = next(
            o for o in self.objects.values() if o.name == "Geometry" and o.values[2] == "Mesh"
        )

    def below(self, number: int, name: str = "", prop: str | None = None) -> list[Record]:
        return [
            record
            for record, where in self.children.get(number, ())
            if name in ("", record.name) and (prop is None or where == [prop])
        ]

    def curve(self, owner: Record, prop: str, part: str, frame: int, still: float) -> float:
        for node in self.below(owner.values[0], "AnimationCurveNode", prop):
            (curve,) = self.below(node.values[0], "AnimationCurve", f"d|{part}")
            times = curve["KeyTime"].values[0]
            values = curve["KeyValueFloat"].values[0]
            assert (np.diff(times) > 0).all() and len(times) == len(values) == curve[
                "KeyAttrRefCount"
            ].values[0].sum()
            return float(values[frame])
        return still

    def limbs(self) -> list[Record]:
        return [o for o in self.objects.values() if o.name == "Model" and o.values[2] == "LimbNode"]

    @staticmethod
    def before(limb: Record) -> np.ndarray:
        """A limb's PreRotation, which it turns after."""
        names = [p.values[0] for p in limb["Properties70"].records]
        turn = limb.prop("PreRotation") if "PreRotation" in names else [0.0, 0.0, 0.0]
        return Rotation.from_euler("xyz", turn, degrees=True).as_matrix()

    def world(self, frame: int) -> dict[int, np.ndarray]:
        """Matrices of all limbs (parents come first)."""
        found: dict[int, np.ndarray] = {}
        for limb in self.limbs():
            number = limb.values[0]
            local = np.eye(4)
            place = limb.prop("Lcl Translation")
            turn = limb.prop("Lcl Rotation")
            place = [
                self.curve(limb, "Lcl Translation", a, frame, s)
                for a, s in zip("XYZ", place, strict=True)
            ]
            turn = [
                self.curve(limb, "Lcl Rotation", a, frame, s)
                for a, s in zip("XYZ", turn, strict=True)
            ]
            local[:3, :3], local[:3, 3] = (
                self.before(limb) @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix(),
                place,
            )
            (parent,) = (
                link[2]
                for link in self.links
                if link[1] == number and link[0] == "OO" and link[2] in (0, *found)
            )
            found[number] = found[parent] @ local if parent else local
        return found

    def vertices(self, frame: int) -> np.ndarray:
        points = self.geometry["Vertices"].values[0].reshape(-1, 3).copy()
        number = self.geometry.values[0]
        for blend in (d for d in self.below(number, "Deformer") if d.values[2] == "BlendShape"):
            for channel in self.below(blend.values[0], "Deformer"):
                (shape,) = self.below(channel.values[0], "Geometry")
                percent = self.curve(channel, "DeformPercent", "DeformPercent", frame, 0.0)
                assert -1e-4 <= percent <= 100.0001
                points[shape["Indexes"].values[0]] += (
                    percent / 100 * shape["Vertices"].values[0].reshape(-1, 3)
                )
        (skin,) = (d for d in self.below(number, "Deformer") if d.values[2] == "Skin")
        world = self.world(frame)
        moved = np.zeros_like(points)
        total = np.zeros(len(points))
        for cluster in self.below(skin.values[0], "Deformer"):
            (limb,) = self.below(cluster.values[0], "Model")
            index = cluster["Indexes"].values[0]
            weights = cluster["Weights"].values[0]
            bind = cluster["TransformLink"].values[0].reshape(4, 4).T
            assert np.allclose(cluster["Transform"].values[0].reshape(4, 4).T @ bind, np.eye(4))
            carry = world[limb.values[0]] @ np.linalg.inv(bind)
            moved[index] += weights[:, None] * (points[index] @ carry[:3, :3].T + carry[:3, 3])
            np.add.at(total, index, weights)
        assert np.allclose(total, 1.0, atol=1e-5)
        return self.metres * moved
