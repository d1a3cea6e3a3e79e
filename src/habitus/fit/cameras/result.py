"""The result of a fit to keypoints of cameras: its solution with the verdict."""

from dataclasses import dataclass
from functools import cached_property

from habitus.fit.cameras.judge import judge_cameras
from habitus.fit.cameras.solution import CameraSolution
from habitus.fit.verdict import Verdict


@dataclass(frozen=True, eq=False)
class CameraFit(CameraSolution):
    """A body in motion, estimated from keypoints in calibrated cameras, and how good it is."""

    @cached_property
    def verdict(self) -> Verdict:
        """``level`` (good, doubtful or failed) and ``reasons``, a sentence each."""
        return judge_cameras(self)
