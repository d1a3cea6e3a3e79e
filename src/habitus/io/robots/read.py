"""A robot's file: MJCF or URDF, by its root element."""

from pathlib import Path

from habitus.body.robot import Robot
from habitus.errors import HabitusError, shown
from habitus.io.limits import read_text_file, read_xml
from habitus.io.robots.mjcf import mjcf_robot
from habitus.io.robots.urdf import urdf_robot
from habitus.types import PathLike

KINDS = {"mujoco": mjcf_robot, "robot": urdf_robot}


def read_robot(path: PathLike) -> Robot:
    """A robot from its MJCF or URDF file; meshes are not needed. Raises HabitusError."""
    source = Path(path)
    try:
        root = read_xml(read_text_file(source))
    except OSError as error:
        raise HabitusError(
            f"{source}: {shown(error.strerror or error)}; expected a robot's MJCF or URDF file"
        ) from error
    except (HabitusError, UnicodeDecodeError) as error:
        raise HabitusError(f"{source}: {shown(error, 160)}; expected MJCF or URDF") from error
    if root.tag not in KINDS:
        raise HabitusError(
            f"{source}: a file whose root element is {shown(root.tag)}; expected a robot, MJCF "
            "(mujoco) or URDF (robot)"
        )
    return KINDS[root.tag](root, source)
