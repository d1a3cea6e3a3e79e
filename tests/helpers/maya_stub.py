"""The few commands and classes of Maya that habitus_maya uses, as its references describe them;
matrices are real.
"""

import types
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class MMatrix:
    """Points stand in front of it; row after row."""

    def __init__(self, values: Any):
        self.values = np.reshape(np.array(values, float), (4, 4))

    def getElement(self, row: int, column: int) -> float:
        return float(self.values[row, column])

    def inverse(self) -> "MMatrix":
        return MMatrix(np.linalg.inv(self.values))


@dataclass
class Attribute:
    """An attribute object, and what made it: its kind, its default."""

    name: str
    kind: str
    default: Any = None


class _Function:
    """A function set that makes attributes and is then set to what the last one shall be."""

    kind = ""

    def create(self, name: str, short: str, data: Any = None, default: Any = None) -> Attribute:
        self.array = self.usesArrayDataBuilder = False
        self.made = Attribute(name, self.kind, default)
        self.made.how = self
        return self.made


class MPxNode:
    """Collects what a class declares."""

    attributes: dict[str, Attribute]
    affects: list[tuple[str, str]]

    @classmethod
    def addAttribute(cls, attribute: Attribute) -> None:
        cls.attributes[attribute.name] = attribute

    @classmethod
    def attributeAffects(cls, attribute: Attribute, other: Attribute) -> None:
        cls.affects.append((attribute.name, other.name))


class _Value:
    def __init__(self, value: Any):
        self.value = value

    def asString(self) -> str:
        assert isinstance(self.value, str)
        return self.value

    def asDouble(self) -> float:
        return float(self.value)

    def asMatrix(self) -> MMatrix:
        return MMatrix(self.value)

    def setDouble(self, value: float) -> None:
        self.value = float(value)


class _Array:
    """An array of a data block, which may have holes."""

    def __init__(self, values: dict[int, Any]):
        self.values = values
        self.at = 0
        self.clean = False

    def __len__(self) -> int:
        return len(self.values)

    def jumpToPhysicalElement(self, k: int) -> None:
        self.at = sorted(self.values)[k]

    def elementLogicalIndex(self) -> int:
        return self.at

    def inputValue(self) -> _Value:
        return _Value(self.values[self.at])

    def builder(self) -> "_Array":
        return _Array({})

    def addElement(self, k: int) -> _Value:
        return self.values.setdefault(k, _Value(0.0))

    def set(self, builder: "_Array") -> None:
        self.values = {k: value.value for k, value in builder.values.items()}

    def setAllClean(self) -> None:
        self.clean = True


@dataclass
class Scene:
    """Nodes by name: their type and attributes; what is connected to what; plug-ins."""

    nodes: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)
    plugins: dict[str, Any] = field(default_factory=dict)
    types: dict[str, type] = field(default_factory=dict)
    load: Any = None

    def ls(self, names: Any = None, type: str = "", selection: bool = False) -> list[str]:
        return [] if selection else [name for name in names if self.nodes[name][0] == type]

    def listHistory(self, mesh: str) -> list[str]:
        return self.history if mesh == "body" else []

    def listConnections(
        self, plug: str, source: bool, destination: bool, connections: bool
    ) -> list[str]:
        assert source and connections and not destination
        pairs = [(into, out) for into, out in self.links.items() if into.startswith(f"{plug}[")]
        return [word for into, out in pairs for word in (into, out.partition(".")[0])]

    def aliasAttr(self, node: str, query: bool) -> list[str]:
        return [word for pair in self.nodes[node][1]["aliases"].items() for word in pair]

    def getAttr(self, plug: str) -> Any:
        node, _, name = plug.partition(".")
        return self.nodes[node][1][name]

    def setAttr(self, plug: str, *values: Any, type: str) -> None:
        node, _, name = plug.partition(".")
        assert (type, len(values)) in (("string", 1), ("matrix", 16))
        self.nodes[node][1][name] = values if type == "matrix" else values[0]

    def pluginInfo(self, name: str, query: bool, loaded: bool) -> bool:
        return name in self.plugins

    def loadPlugin(self, path: str) -> None:
        self.load(self, path)

    def createNode(self, kind: str, name: str) -> str:
        made = f"{name}1"
        self.nodes[made] = (kind, {})
        return made

    def connectAttr(self, out: str, into: str, force: bool = False) -> None:
        assert force or into not in self.links, f"{into} is connected already"
        self.links[into] = out

    def evaluated(self, node: str) -> dict[int, float]:
        """The weights that a node of a plug-in computes."""
        kind, held = self.nodes[node]
        made = self.types[kind]()
        block = _Block(self, node, held, made)
        made.compute(types.SimpleNamespace(attribute=lambda: made.weight), block)
        assert block.out.clean
        return block.out.values


@dataclass
class _Block:
    scene: Scene
    node: str
    held: dict[str, Any]
    made: Any
    out: Any = None

    def inputValue(self, attribute: Attribute) -> _Value:
        return _Value(self.held.get(attribute.name, attribute.default))

    def inputArrayValue(self, attribute: Attribute) -> _Array:
        start = f"{attribute.name}["
        found = {}
        for name, value in self.held.items():
            if name.startswith(start):
                found[int(name[len(start) : -1])] = value
        for into, out in self.scene.links.items():
            if into.startswith(f"{self.node}.{start}"):
                found[int(into.rpartition("[")[2][:-1])] = self.scene.getAttr(out)
        return _Array(found)

    def outputArrayValue(self, attribute: Attribute) -> _Array:
        assert attribute.how.array and attribute.how.usesArrayDataBuilder
        self.out = _Array({})
        return self.out


def modules(scene: Scene) -> dict[str, types.ModuleType]:
    """What `import maya` finds."""
    maya, api, om, cmds = (
        types.ModuleType(name) for name in ("maya", "maya.api", "maya.api.OpenMaya", "maya.cmds")
    )
    maya.api = api
    api.OpenMaya = om
    maya.cmds = cmds
    om.MPxNode = MPxNode
    om.MMatrix = MMatrix
    for name in ("MFnTypedAttribute", "MFnMatrixAttribute", "MFnNumericAttribute"):
        setattr(om, name, type(name, (_Function,), {"kind": name}))
    om.MFnData = types.SimpleNamespace(kString=4)
    om.MFnNumericData = types.SimpleNamespace(kDouble=12)
    om.MTypeId = int

    class MFnPlugin:
        def __init__(self, plugin: str, vendor: str = "", version: str = ""):
            self.plugin = plugin

        def registerNode(self, name: str, number: int, creator: Any, initialize: Any) -> None:
            made = type(creator())
            made.attributes = {}
            made.affects = []
            assert 0 < number < 0x80000
            initialize()
            scene.types[name], scene.plugins[self.plugin] = made, made

    om.MFnPlugin = MFnPlugin
    for name in (
        "ls",
        "listHistory",
        "listConnections",
        "aliasAttr",
        "getAttr",
        "setAttr",
        "pluginInfo",
        "loadPlugin",
    ):
        setattr(cmds, name, getattr(scene, name))
    cmds.createNode = scene.createNode
    cmds.connectAttr = scene.connectAttr
    return {module.__name__: module for module in (maya, api, om, cmds)}
