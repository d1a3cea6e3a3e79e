# SPDX-License-Identifier: Apache-2.0
"""habitus in Maya: pose blend shapes that follow the joints, by a node of its own. Python API 2.0,
Maya 2022 and later.

    import habitus_maya
    habitus_maya.attach("walk.correctives.json", "body")  # the mesh that the FBX brought

The node, habitusCorrectives, takes the joints' world matrices and drives the blend shape node; it
keeps what the JSON says in the scene. Scenes that have it need this file and habitus_correctives.py
in MAYA_PLUG_IN_PATH and MAYA_SCRIPT_PATH.
"""

import functools
import os

import maya.api.OpenMaya as om
from habitus_correctives import Correctives, from_matrices, plain
from maya import cmds

NODE, NUMBER = "habitusCorrectives", 0x0007F1AB
"""Autodesk keeps numbers below 0x80000 free for everybody."""


def maya_useNewAPI():
    """Maya asks for it: this is Python API 2.0."""


@functools.lru_cache(maxsize=16)
def _read(text):
    return Correctives(text)


class HabitusCorrectives(om.MPxNode):
    """From data (the JSON's text), strength, worldMatrix[k] and bindPreMatrix[k] of its k-th joint,
    weight[channel].
    """

    data = strength = world = bind = weight = None

    @staticmethod
    def creator():
        """Maya makes nodes with it."""
        return HabitusCorrectives()

    @classmethod
    def initialize(cls):
        """Its attributes."""
        typed, matrix, number = (
            om.MFnTypedAttribute(),
            om.MFnMatrixAttribute(),
            om.MFnNumericAttribute(),
        )
        cls.data = typed.create("data", "dat", om.MFnData.kString)
        cls.strength = number.create("strength", "str", om.MFnNumericData.kDouble, 1.0)
        number.keyable = True
        cls.world = matrix.create("worldMatrix", "wm")
        matrix.array = True
        cls.bind = matrix.create("bindPreMatrix", "bpm")
        matrix.array = True
        cls.weight = number.create("weight", "w", om.MFnNumericData.kDouble, 0.0)
        number.array = True
        number.usesArrayDataBuilder = True
        number.writable = False
        for attribute in (cls.data, cls.strength, cls.world, cls.bind, cls.weight):
            cls.addAttribute(attribute)
        for attribute in (cls.data, cls.strength, cls.world, cls.bind):
            cls.attributeAffects(attribute, cls.weight)

    def compute(self, plug, block):
        """The weights of all channels."""
        if plug.attribute() != self.weight:
            return
        told = _read(block.inputValue(self.data).asString())
        strength = block.inputValue(self.strength).asDouble()
        binds, worlds = (_by_index(block.inputArrayValue(each)) for each in (self.bind, self.world))
        known = [
            (told.joints[k], binds[k], worlds[k])
            for k in sorted(binds)
            if k in worlds and k < len(told.joints)
        ]
        axes = told.axes({name: _rest(bind) for name, bind, _ in known})
        turns = {
            name: from_matrices(_numbers(bind), _numbers(world)) for name, bind, world in known
        }
        handle = block.outputArrayValue(self.weight)
        builder = handle.builder()
        for channel, weight in enumerate(told.weights(turns, axes)):
            builder.addElement(channel).setDouble(strength * weight)
        handle.set(builder)
        handle.setAllClean()


def _by_index(handle):
    found = {}
    for k in range(len(handle)):
        handle.jumpToPhysicalElement(k)
        found[handle.elementLogicalIndex()] = handle.inputValue().asMatrix()
    return found


def _numbers(matrix):
    return [matrix.getElement(row, column) for row in range(4) for column in range(4)]


def _rest(bind):
    """Where a joint rests, from its bind-pre matrix."""
    inverse = bind.inverse()
    return [inverse.getElement(3, column) for column in range(3)]


def initializePlugin(plugin):
    """Maya calls it when the plug-in is loaded."""
    made = HabitusCorrectives.creator, HabitusCorrectives.initialize
    om.MFnPlugin(plugin, "habitus", "0.1").registerNode(NODE, om.MTypeId(NUMBER), *made)


def uninitializePlugin(plugin):
    """Maya calls it when it is unloaded."""
    om.MFnPlugin(plugin).deregisterNode(om.MTypeId(NUMBER))


def attach(path, mesh=None):
    """Let the joints of a skinned mesh drive its blend shapes, as a .correctives.json says; the new
    node comes back.

    mesh: its transform or shape; what is selected, if left out. Baked weights of these channels are
    disconnected; soft tissue's stay. Raises ValueError where mesh and JSON do not belong together.
    """
    with open(path, encoding="utf-8") as file:
        text = file.read()
    told, mesh = _read(text), mesh or (cmds.ls(selection=True) or [""])[0]
    skin, blend = (_deformer(mesh, kind) for kind in ("skinCluster", "blendShape"))
    joints = _influences(skin)
    missing = [name for name in told.needed if name not in joints]
    shapes = _shapes(blend)
    missing += [name for name in told.channels if name not in shapes]
    if missing:
        named = ", ".join(missing[:3])
        raise ValueError(
            f"{path}: {mesh} has no {named}; export both with the same --bake-correctives"
        )
    if not cmds.pluginInfo(os.path.basename(__file__), query=True, loaded=True):
        cmds.loadPlugin(os.path.abspath(__file__))
    node = cmds.createNode(NODE, name="habitus_correctives")
    cmds.setAttr(node + ".data", text, type="string")
    for k, name in enumerate(told.joints):
        if name in joints:
            joint, index = joints[name]
            bind = cmds.getAttr(f"{skin}.bindPreMatrix[{index}]")
            cmds.setAttr(f"{node}.bindPreMatrix[{k}]", *bind, type="matrix")
            cmds.connectAttr(joint + ".worldMatrix[0]", f"{node}.worldMatrix[{k}]")
    for channel, name in enumerate(told.channels):
        cmds.connectAttr(f"{node}.weight[{channel}]", f"{blend}.{shapes[name]}", force=True)
    return node


def _deformer(mesh, kind):
    found = cmds.ls(cmds.listHistory(mesh) or [], type=kind) if mesh else []
    if not found:
        raise ValueError(
            f"{mesh or 'nothing'} has no {kind}; name or select the mesh that the FBX brought"
        )
    return found[0]


def _influences(skin):
    """Joints by their plain names: their nodes, and their places in the skin."""
    pairs = (
        cmds.listConnections(skin + ".matrix", source=True, destination=False, connections=True)
        or []
    )
    return {
        plain(joint): (joint, int(plug.rpartition("[")[2][:-1]))
        for plug, joint in zip(pairs[::2], pairs[1::2])
    }


def _shapes(blend):
    """Attributes of blend shapes by their plain names."""
    pairs = cmds.aliasAttr(blend, query=True) or []
    return {plain(alias): attribute for alias, attribute in zip(pairs[::2], pairs[1::2])}
