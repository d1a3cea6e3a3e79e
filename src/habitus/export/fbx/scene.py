"""What an FBX file is made of beside its objects: settings, their counts, how they hang together,
takes.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from habitus import __version__
from habitus.export.fbx.nodes import CREATED, FILE_ID, VERSION, Node, Value

TICKS = 46_186_158_000
"""Of FBX's clock in a second."""
ROOT = np.int64(0)
_TIME_MODES = {120: 1, 100: 2, 60: 3, 50: 4, 48: 5, 30: 6, 25: 10, 24: 11, 1000: 12, 96: 15, 72: 16}
_CUSTOM = 14
_CREATOR = f"habitus {__version__}"


class Objects:
    """Objects in the order of addition, numbered from ``first`` on, and their connections."""

    def __init__(self, first: int = 1_000_000) -> None:
        self.nodes: list[Node] = []
        self.links: list[Node] = []
        self.kinds: Counter[str] = Counter()
        self._first = first

    def add(
        self, kind: str, name: str, form: str, nodes: Sequence[Node] = (), said: str = ""
    ) -> np.int64:
        """An object of a kind ("Model"), of a form of that ("LimbNode"); its number comes back.

        ``said`` is what it is called where that differs from the kind.
        """
        number = np.int64(self._first + len(self.nodes))
        self.kinds[kind] += 1
        self.nodes.append(Node(kind, (number, f"{name}\0\1{said or kind}", form), nodes))
        return number

    def link(self, child: np.int64, parent: np.int64, prop: str = "") -> None:
        """Hang an object on another, or on one of its properties."""
        values: tuple[Value, ...] = ("OP", child, parent, prop) if prop else ("OO", child, parent)
        self.links.append(Node("C", values))

    def definitions(self) -> Node:
        """How many objects there are of each kind."""
        kinds = {"GlobalSettings": 1, **self.kinds}
        each = [
            Node("ObjectType", (kind,), [Node("Count", (count,))]) for kind, count in kinds.items()
        ]
        return Node(
            "Definitions",
            (),
            [Node("Version", (100,)), Node("Count", (sum(kinds.values()),)), *each],
        )


def prop(name: str, kind: str, label: str, flags: str, *values: Value) -> Node:
    """One property of an object."""
    return Node("P", (name, kind, label, flags, *values))


def props(*each: Node) -> Node:
    """An object's properties."""
    return Node("Properties70", (), each)


def top_nodes(objects: Objects, take: str, frames: int, rate_hz: float) -> list[Node]:
    """All of a file that holds one take: ``frames`` at ``rate_hz``, from 0 s on."""
    end = ticks(np.array([max(frames - 1, 0)]), rate_hz)[0]
    return [
        _header(),
        Node("FileId", (FILE_ID,)),
        Node("CreationTime", (CREATED,)),
        Node("Creator", (_CREATOR,)),
        _settings(rate_hz, end),
        _documents(take),
        Node("References"),
        objects.definitions(),
        Node("Objects", (), objects.nodes),
        Node("Connections", (), objects.links),
        _takes(take, end),
    ]


def ticks(frames: np.ndarray, rate_hz: float) -> np.ndarray:
    """The times of frames on FBX's clock."""
    return np.round(frames * (TICKS / rate_hz)).astype(np.int64)


def _header() -> Node:
    parts = (("Version", 1000), ("Year", 1970), ("Month", 1), ("Day", 1), ("Hour", 10))
    stamp = [
        Node(name, (value,))
        for name, value in (*parts, ("Minute", 0), ("Second", 0), ("Millisecond", 0))
    ]
    return Node(
        "FBXHeaderExtension",
        (),
        [
            Node("FBXHeaderVersion", (1003,)),
            Node("FBXVersion", (VERSION,)),
            Node("EncryptionType", (0,)),
            Node("CreationTimeStamp", (), stamp),
            Node("Creator", (_CREATOR,)),
        ],
    )


def _settings(rate_hz: float, end: np.int64) -> Node:
    """Centimetres, +y up, the front +z, x to the right of who looks at it: what most programs take
    without asking.
    """
    mode = _TIME_MODES.get(int(rate_hz), _CUSTOM) if rate_hz == int(rate_hz) else _CUSTOM
    axes = (("UpAxis", 1), ("FrontAxis", 2), ("CoordAxis", 0), ("OriginalUpAxis", 1))
    numbers = [pair for name, axis in axes for pair in ((name, axis), (f"{name}Sign", 1))]
    return Node(
        "GlobalSettings",
        (),
        [
            Node("Version", (1000,)),
            props(
                *(prop(name, "int", "Integer", "", value) for name, value in numbers),
                prop("UnitScaleFactor", "double", "Number", "", 1.0),
                prop("OriginalUnitScaleFactor", "double", "Number", "", 1.0),
                prop("TimeMode", "enum", "", "", mode),
                prop("TimeSpanStart", "KTime", "Time", "", np.int64(0)),
                prop("TimeSpanStop", "KTime", "Time", "", end),
                prop("CustomFrameRate", "double", "Number", "", float(rate_hz)),
            ),
        ],
    )


def _documents(take: str) -> Node:
    named = props(prop("ActiveAnimStackName", "KString", "", "", take))
    scene = Node("Document", (np.int64(1), "Scene", "Scene"), [named, Node("RootNode", (ROOT,))])
    return Node("Documents", (), [Node("Count", (1,)), scene])


def _takes(take: str, end: np.int64) -> Node:
    spans = [Node(name, (np.int64(0), end)) for name in ("LocalTime", "ReferenceTime")]
    return Node(
        "Takes",
        (),
        [
            Node("Current", (take,)),
            Node("Take", (take,), [Node("FileName", (f"{take}.tak",)), *spans]),
        ],
    )
