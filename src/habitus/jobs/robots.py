"""``habitus retarget --robot``: a motion on a humanoid robot. Files in, files out."""

from dataclasses import dataclass, replace
from pathlib import Path

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.body.robot import Robot
from habitus.export.rates import at_rate
from habitus.export.robot import check_robot_path, write_robot
from habitus.files import write_text
from habitus.fit.retarget.recipe import turned
from habitus.fit.retarget.robot_pairs import RobotPairs
from habitus.fit.retarget.robot_quality import RobotQuality, robot_quality
from habitus.fit.retarget.robots import (
    ROBOT,
    RobotMotion,
    RobotRetargeting,
    RobotSettings,
    retargeted_to_robot,
)
from habitus.io.robots.pairs import pairs_for, read_pairs
from habitus.io.robots.read import read_robot
from habitus.jobs.motions import motion_of
from habitus.kernels.threads import one_blas_thread
from habitus.report.robot import robot_numbers, robot_page
from habitus.results.save import write_json
from habitus.rotations import up_rotation
from habitus.types import PathLike


@dataclass(frozen=True, eq=False)
class OnRobot:
    """A motion on a robot: ``motion`` (root, turn, angles), ``quality`` with its verdict, and all
    that they were made of (``result``).
    """

    motion: RobotMotion
    quality: RobotQuality
    result: RobotRetargeting
    source: BodyMotion

    def save(self, path: PathLike, style: str = "habitus") -> None:
        """Write the motion (.npz, .csv, .pkl; `habitus.export.robot.write_robot`), and beside it
        under the same name a page (.html) and its numbers (.json). Raises HabitusError.
        """
        target = check_robot_path(path)
        write_robot(self.motion, target, style)
        page = robot_page(self.result, self.quality, _grounded(self.source, self.result))
        write_text(target.with_suffix(".html"), page)
        write_json(target.with_suffix(".json"), robot_numbers(self.result, self.quality))


def retarget_to_robot(
    source: Moving | PathLike,
    robot: Robot | PathLike,
    *,
    pairs: RobotPairs | PathLike | None = None,
    body: BodyModel | PathLike | None = None,
    fps: float | None = None,
    out: PathLike | None = None,
    style: str = "habitus",
    settings: RobotSettings | None = None,
) -> OnRobot:
    """A motion on a humanoid robot, within the limits of its joints.

    source: a fit, a motion, or the npz of one (AMASS's style included). robot: its MJCF or URDF
    file. pairs: which of its links is which segment (a shipped table's name or a TOML file); found
    by the names of its links where missing. body: the model of an npz that names none. fps: frames
    a second of the result; the source's where missing. out: file for the motion; a page and numbers
    go beside it. Raises HabitusError.
    """
    if out is not None:
        check_robot_path(out)
    model = robot if isinstance(robot, Robot) else read_robot(robot)
    if pairs is None:
        table = pairs_for(model)
    else:
        table = pairs if isinstance(pairs, RobotPairs) else read_pairs(pairs)
    motion = BodyMotion.of(at_rate(motion_of(source, body), fps))
    with one_blas_thread():  # the factors are of narrow bands: more threads only wait
        result = retargeted_to_robot(motion, model, table, settings or ROBOT)
    made = OnRobot(result.motion, robot_quality(result), result, motion)
    if out is not None:
        made.save(Path(out), style)
    return made


def _grounded(motion: BodyMotion, result: RobotRetargeting) -> BodyMotion:
    """The person's motion in the robot's world, but +y up."""
    upright = turned(motion, up_rotation(motion.up_axis))
    down = upright.trans - [0.0, result.person.ground, 0.0]
    return replace(upright, trans=down, up_axis="+y")
