"""A small humanoid robot, as MJCF and as URDF, and its table of pairs."""

import re

HALF = """
<body name="{side}_thigh" pos="0 {y} -0.05">
  <joint name="{side}_hip_pitch" axis="0 1 0" range="-2 2"/>
  <joint name="{side}_hip_roll" axis="1 0 0" range="-0.5 0.5"/>
  <joint name="{side}_hip_yaw" class="small" axis="0 0 1"/>
  <body name="{side}_shank" pos="0 0 -0.3">
    <joint name="{side}_knee" axis="0 1 0" range="-0.1 2.5"/>
    <body name="{side}_foot" pos="0 0 -0.3">
      <joint name="{side}_ankle_pitch" axis="0 1 0" range="-0.9 0.6"/>
      <joint name="{side}_ankle_roll" axis="1 0 0" range="-0.3 0.3"/>
    </body>
  </body>
</body>"""
ARM = """
<body name="{side}_upper_arm" pos="0 {y} 0.25" euler="{roll} 0 0">
  <joint name="{side}_shoulder_pitch" axis="0 1 0" range="-3 3"/>
  <joint name="{side}_shoulder_roll" axis="1 0 0" range="-3 3"/>
  <joint name="{side}_shoulder_yaw" axis="0 0 1" range="-2 2"/>
  <body name="{side}_forearm" pos="0 0 -0.2">
    <joint name="{side}_elbow" axis="0 1 0" pos="0.01 0 0.02" range="-2.6 0.1"/>
  </body>
</body>"""


def mjcf() -> str:
    """MJCF with degrees for nothing, a default class, several joints a body, and euler angles."""
    legs = "".join(HALF.format(side=side, y=y) for side, y in (("left", 0.1), ("right", -0.1)))
    arms = "".join(
        ARM.format(side=side, y=y, roll=roll)
        for side, y, roll in (("left", 0.17, 0.2), ("right", -0.17, -0.2))
    )
    text = f"""<mujoco model="made">
<compiler angle="radian" inertiafromgeom="true"/>
<default>
  <joint type="hinge" armature="0.1"/>
  <geom type="sphere" size="0.02"/>
  <default class="small"><joint range="-1 1"/></default>
</default>
<worldbody>
  <geom name="floor" type="plane" size="0 0 0.01"/>
  <body name="pelvis" pos="0 0 0.7">
    <freejoint/>
    {legs}
    <body name="torso" pos="0 0 0.05" quat="0.99 0 0.02 0">
      <joint name="waist" axis="0 0 1" range="-1.5 1.5"/>
      {arms}
    </body>
  </body>
</worldbody>
</mujoco>"""
    return re.sub(r"(<body [^>]*>)", r"\1<geom/>", text)


PAIRS = """
name = "made"
velocity = 25
[segments]
pelvis = { link = "pelvis", up = [0, 0, 1], left = [0, 1, 0] }
torso = { link = "torso", up = [0, 0, 1], left = [0, 1, 0] }
"[left|right]_thigh" = { link = "[left|right]_thigh", along = [0, 0, -1] }
"[left|right]_shank" = { link = "[left|right]_shank", along = [0, 0, -1] }
"[left|right]_foot" = { link = "[left|right]_foot", along = [1, 0, 0], up = [0, 0, 1] }
"[left|right]_upper_arm" = { link = "[left|right]_upper_arm", along = [0, 0.198669, -0.980067] }
"[left|right]_forearm" = { link = "[left|right]_forearm", along = [0, 0.198669, -0.980067] }
[soles]
"[left|right]" = { link = "[left|right]_foot", heel = [[-0.05, 0.03, -0.04], [-0.05, -0.03, -0.04]], toes = [[0.12, 0.03, -0.04], [0.12, -0.03, -0.04]] }
[capsules]
torso = { link = "torso", to = [0, 0, 0.2], radius = 0.09 }
"[left|right]_forearm" = { link = "[left|right]_forearm", to = [0, 0.03, -0.15], radius = 0.03 }
"[left|right]_shank" = { link = "[left|right]_shank", to = [0, 0, -0.25], radius = 0.04 }
"""

URDF = """<robot name="made">
<link name="world"/><link name="pelvis"/><link name="thigh"/><link name="shank"/><link name="fixed"/>
<joint name="root" type="floating"><parent link="world"/><child link="pelvis"/></joint>
<joint name="hip" type="revolute"><parent link="pelvis"/><child link="thigh"/>
<origin xyz="0 0.1 -0.05" rpy="0.1 -0.2 0.3"/><axis xyz="0 2 0"/>
<limit lower="-1" upper="1.5" velocity="12" effort="9"/></joint>
<joint name="knee" type="continuous"><parent link="thigh"/><child link="shank"/>
<origin xyz="0 0 -0.3"/><axis xyz="1 1 0"/></joint>
<joint name="weld" type="fixed"><parent link="shank"/><child link="fixed"/>
<origin xyz="0.1 0 0" rpy="0 0 1.5"/></joint>
</robot>"""
