"""Does a body's pose come back from three silhouettes and depth images, from 10 degrees off at
every joint?

    python benchmarks/render_body_pose.py [--size 128] [--poses walking sitting] [--starts 2]
    [--images exact sensor]

The default body in its mean shape stands in planted poses before three cameras, 3 m away; behind it
is nothing, told as a depth of 5 m. Observed are its silhouettes and depth images, once exact (drawn
as the fit draws them) and once as from a sensor: of four times as many pixels a side, each a sample
at its centre, its depth with noise of 5 mm; means of 4 x 4 of them are fitted. A fit starts with
every joint, the root too, turned by 10 degrees about a random axis and the body 5 cm off, and moves
pose and translation by Levenberg-Marquardt steps with the images' explicit Jacobians: from the
coarse levels of Gaussian pyramids to the full images. Differences of depth are robust (Geman and
McClure). Joints are held near the start, loosely and in the last stage not at all; there is no
other prior.

The error of a joint is the rotation, relative to its parent, between what was planted and what was
found. It is split into twist about the joint's own bone and the swing that is left. A bone runs, in
the rest pose, from a joint to its child: of the pelvis to the first spine joint, of the last spine
joint to the neck; of hands, feet and the head, which have none, to the middle of the vertices that
they carry most. Goals: 2 degrees of swing on average, no joint more than 5 mm off. Beside that the
table tells what one Jacobian of all images costs, explicit and by forward differentiation.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from common import in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table
from torch import Tensor

import habitus
from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.observe.camera import Camera, look_at
from habitus.observe.images import as_vector, gaussian_pyramid, geman_mcclure
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.jacobians.images import depth_jacobian, silhouette_jacobian
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec, quaternion_from_matrix, rotvec_from_matrix
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize

OFF, BESIDE = math.radians(10), 0.05
"""How far each joint is turned at the start (rad), and how far the body is moved (m)."""
SWING_GOAL, JOINT_GOAL = 2.0, 5.0
"""Degrees on average, mm at most."""
WALL = 5.0
"""Depth of the background (m)."""
NOISE, FINER = 0.005, 4
"""Of the sensor: noise of depth (m), and how many of its pixels make one of the fit's, along each
side.
"""
EYES = ((20.0, 0.35), (140.0, 0.1), (260.0, 0.6))
"""Cameras: degrees around the body, 0 being in front of it, and metres above its pelvis."""
DISTANCE = 3.0
POSES: dict[str, dict[str, tuple[float, float, float]]] = {
    "walking": {
        "pelvis": (0, -6, 0),
        "spine2": (3, 8, 0),
        "left_hip": (-28, 0, 3),
        "left_knee": (12, 0, 0),
        "left_ankle": (-5, 0, 0),
        "right_hip": (18, 0, -3),
        "right_knee": (35, 0, 0),
        "right_ankle": (12, 0, 0),
        "left_shoulder": (18, 0, -68),
        "left_elbow": (0, -20, 0),
        "right_shoulder": (-22, 0, 68),
        "right_elbow": (0, 30, 0),
    },
    "arms raised": {
        "spine1": (-6, 0, 0),
        "head": (-15, 10, 0),
        "left_hip": (-5, 0, 10),
        "right_hip": (3, 0, -12),
        "right_knee": (8, 0, 0),
        "left_collar": (0, 0, 15),
        "left_shoulder": (0, -15, 50),
        "left_elbow": (0, -35, 0),
        "right_collar": (0, 0, -15),
        "right_shoulder": (0, 25, -60),
        "right_elbow": (0, 20, 0),
    },
    "sitting": {
        "spine1": (10, 0, 0),
        "spine2": (8, 0, 0),
        "neck": (10, 0, 0),
        "head": (5, -15, 0),
        "left_hip": (-80, 0, 10),
        "left_knee": (85, 0, 0),
        "right_hip": (-85, 0, -8),
        "right_knee": (75, 0, 0),
        "left_shoulder": (-35, 0, -60),
        "left_elbow": (0, -50, 0),
        "right_shoulder": (-25, 0, 65),
        "right_elbow": (0, 70, 0),
    },
    "lunge": {
        "pelvis": (5, 20, 0),
        "spine1": (8, 10, 0),
        "spine3": (0, 15, 5),
        "neck": (0, -15, 0),
        "left_hip": (-60, 0, 8),
        "left_knee": (70, 0, 0),
        "right_hip": (25, 0, -8),
        "right_knee": (20, 0, 0),
        "right_ankle": (-10, 0, 0),
        "left_shoulder": (0, -60, -10),
        "left_elbow": (0, -15, 0),
        "right_shoulder": (-10, 20, 40),
        "right_elbow": (0, 60, 0),
    },
}
"""Degrees about x, y and z of the parent, z first; each joint is turned by about 3 more at random.
"""


@dataclass(frozen=True)
class Stage:
    """One call of `minimize`.

    levels: the finest and the coarsest of the pyramids, 0 being the images. depth_scale: metres
    from which on depth counts less. near: weight of joints' turns from the start, in units of what
    the start is off on average.
    """

    levels: tuple[int, int]
    depth_scale: float
    near: float
    iterations: int
    tolerance: float = 1e-3


STAGES = (
    Stage((2, 4), 0.3, 0.1, 25),
    Stage((1, 3), 0.2, 0.1, 20),
    Stage((0, 3), 0.1, 0.01, 20),
    Stage((0, 2), 0.02, 0.0, 40, 1e-5),
)


@dataclass(frozen=True, eq=False)
class Room:
    """A body of fixed shape (B,) before cameras."""

    body: BodyModel
    betas: Tensor
    triangles: Triangles
    cameras: tuple[Camera, ...]

    @classmethod
    def of(cls, size: int) -> "Room":
        """The default body in its mean shape, images of size x size pixels."""
        body = habitus.load_body("default")
        betas = torch.zeros(body.num_betas, dtype=torch.float64)
        cameras = []
        for degrees, height in EYES:
            angle = math.radians(degrees)
            target = torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
            eye = torch.tensor(
                [DISTANCE * math.sin(angle), height, DISTANCE * math.cos(angle)],
                dtype=torch.float64,
            )
            rotation, translation = look_at(eye, target)
            cameras.append(
                Camera.of(size, size, 1.05 * size, rotation=rotation, translation=translation)
            )
        return cls(
            body,
            betas,
            Triangles.of(torch.as_tensor(body.faces), torch.as_tensor(body.v_template)),
            tuple(cameras),
        )

    @cached_property
    def bones(self) -> Tensor:
        """Unit directions of the joints' bones in the rest pose (J, 3)."""
        joints = self.body.rest_joints(self.betas)
        parents = self.body.parents
        named = self.body.joint_names.index
        ends = self.body.rest_vertices(self.betas)
        children = {parent: child for child, parent in reversed(list(enumerate(parents)))}
        children |= {named("pelvis"): named("spine1"), named("spine3"): named("neck")}
        middles = [
            ends[torch.as_tensor(self.body.part) == joint].mean(0) for joint in range(len(parents))
        ]
        tips = [joints[children[j]] if j in children else middles[j] for j in range(len(parents))]
        return torch.nn.functional.normalize(torch.stack(tips) - joints, dim=-1)

    def finer(self, factor: int) -> "Room":
        """The same with images of `factor` times as many pixels a side."""
        return replace(self, cameras=tuple(camera.scaled(factor) for camera in self.cameras))

    def shown(self, pose: Tensor, trans: Tensor, boundary: str = "antialias") -> "Shown":
        """The body in a pose (J, 3) and at a translation (3,) as the cameras see it."""
        vertices = self.body(self.betas, pose, trans).vertices
        frames = tuple(draw(camera, vertices, self.triangles, boundary) for camera in self.cameras)
        return Shown(self, pose, trans, vertices, frames)


@dataclass(frozen=True, eq=False)
class Shown:
    """A body before all cameras, and how its vertices move."""

    room: Room
    pose: Tensor
    trans: Tensor
    vertices: Tensor
    frames: tuple[Frame, ...]

    @property
    def silhouettes(self) -> Tensor:
        """(N, H, W, 1)."""
        return torch.stack([frame.silhouette() for frame in self.frames])[..., None]

    @property
    def depths(self) -> Tensor:
        """(N, H, W, 1) metres."""
        return torch.stack([frame.depth(WALL) for frame in self.frames])[..., None]

    @cached_property
    def vertex_jacobian(self) -> np.ndarray:
        """dV/d(pose, trans), (V, 3, 3 J + 3)."""
        by_pose = surface_jacobian(
            self.room.body, self.room.betas, self.pose, self.trans
        ).vertices_pose.flatten(2)
        by_trans = torch.eye(3, dtype=by_pose.dtype).expand(len(by_pose), 3, 3)
        return torch.cat([by_pose, by_trans], 2).numpy()

    def chained(self, jacobian: Callable) -> Tensor:
        """The derivative of all images of a kind to pose and translation, (N, H, W, 3 J + 3)."""
        found = [
            jacobian(frame).chain(camera, self.vertices, self.vertex_jacobian)
            for camera, frame in zip(self.room.cameras, self.frames, strict=True)
        ]
        size = self.frames[0].height, self.frames[0].width
        return torch.from_numpy(np.stack(found)).unflatten(1, size)


def terms(
    room: Room, silhouettes: Tensor, depths: Tensor, start: Tensor, stage: Stage
) -> dict[str, Callable]:
    """What a stage minimises: differences of silhouettes and of depths, in pyramids, and joints'
    turns since the start.

    Both kinds of images are taken of the same frames, drawn once for each pose that is tried.
    """
    last: list[Shown] = []
    (finest, coarsest), usual = stage.levels, OFF / 3**0.5

    def shown(pose: Tensor, trans: Tensor) -> Shown:
        if not last or last[0].pose is not pose or last[0].trans is not trans:
            last[:] = [room.shown(pose, trans)]
        return last[0]

    def pyramids(images: Tensor) -> tuple[Tensor, ...]:
        return gaussian_pyramid(images, coarsest)[finest:]

    def by_unknowns(jacobian: Tensor) -> dict[str, Tensor]:
        rows = torch.cat([level.flatten(1, 2) for level in pyramids(jacobian)], 1).flatten(0, 1)
        return {"pose": rows[:, :-3], "trans": rows[:, -3:]}

    def silhouette(pose: Tensor, trans: Tensor):
        now = shown(pose, trans)
        residual = pyramids(now.silhouettes - silhouettes)
        return as_vector(residual).flatten(), lambda: by_unknowns(now.chained(silhouette_jacobian))

    def depth(pose: Tensor, trans: Tensor):
        now = shown(pose, trans)
        off = (now.depths - depths) / stage.depth_scale
        robust, derivative = torch.func.jvp(
            lambda off: geman_mcclure(off, 1.0), (off,), (torch.ones_like(off),)
        )
        scale = derivative / stage.depth_scale

        def jacobians() -> dict[str, Tensor]:
            return by_unknowns(scale * now.chained(lambda frame: depth_jacobian(frame, WALL)))

        return as_vector(pyramids(robust)).flatten(), jacobians

    def near(pose: Tensor):
        return (pose - start).flatten() / usual, {"pose": np.eye(pose.numel()) / usual}

    return {"silhouettes": silhouette, "depths": depth, "near": near}


def fit(
    room: Room, observed: tuple[Tensor, Tensor], pose: Tensor, trans: Tensor
) -> tuple[dict[str, Tensor], dict]:
    """Pose and translation found from a start, and iterations, seconds and the costs of the last
    stage's terms.
    """
    start = pose
    iterations = 0
    seconds = 0.0
    values = {"pose": pose, "trans": trans}
    costs = {}
    for stage in STAGES:
        found = minimize(
            terms(room, *observed, start, stage),
            values,
            "levenberg",
            weights={"near": stage.near},
            max_iterations=stage.iterations,
            tolerances=Tolerances(cost=stage.tolerance),
        )
        values = found.values
        costs = found.costs
        iterations = iterations + found.iterations
        seconds = seconds + found.seconds
    return values, {"iterations": iterations, "seconds": seconds, "costs": costs}


def planted(room: Room, name: str, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """One of `POSES` (J, 3), each joint turned some more at random, and a translation (3,)."""
    axes = torch.eye(3, dtype=torch.float64)
    angles = (
        torch.tensor([POSES[name].get(joint, (0, 0, 0)) for joint in room.body.joint_names])
        .double()
        .deg2rad()
    )
    about = [matrix_from_rotvec(angles[:, k, None] * axes[k]) for k in range(3)]
    more = matrix_from_rotvec(math.radians(3) / 3**0.5 * _normal(generator, len(angles), 3))
    return rotvec_from_matrix(about[0] @ about[1] @ about[2] @ more), 0.03 * _normal(generator, 3)


def turned(pose: Tensor, trans: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Every joint off by `OFF` about a random axis, the body by `BESIDE` in a random direction."""
    axes, way = (
        torch.nn.functional.normalize(_normal(generator, *size), dim=-1)
        for size in (pose.shape, (3,))
    )
    return rotvec_from_matrix(
        matrix_from_rotvec(pose) @ matrix_from_rotvec(OFF * axes)
    ), trans + BESIDE * way


def _normal(generator: torch.Generator, *size: int) -> Tensor:
    return torch.randn(size, generator=generator, dtype=torch.float64)


def observe(
    room: Room, pose: Tensor, trans: Tensor, kind: str, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Silhouettes and depth images: "exact", or of a "sensor", made smaller."""
    if kind == "exact":
        shown = room.shown(pose, trans)
        return shown.silhouettes, shown.depths
    shown = room.finer(FINER).shown(pose, trans, boundary="none")
    noisy = shown.depths + NOISE * _normal(generator, *shown.depths.shape)
    return _smaller(shown.silhouettes), _smaller(noisy)


def _smaller(images: Tensor) -> Tensor:
    """Means of `FINER` x `FINER` pixels."""
    return images.unflatten(2, (-1, FINER)).unflatten(1, (-1, FINER)).mean((2, 4))


def errors(room: Room, found: dict[str, Tensor], pose: Tensor, trans: Tensor) -> dict[str, float]:
    """Degrees of rotation, swing and twist, mean and largest over joints, and distances of joints
    (mm).
    """
    turn = quaternion_from_matrix(matrix_from_rotvec(pose).mT @ matrix_from_rotvec(found["pose"]))
    along = (turn[:, 1:] * room.bones).sum(-1).abs()
    scalar = turn[:, 0].abs()
    across = turn[:, 1:].norm(dim=-1) ** 2 - along**2
    angles = {
        "rotation_deg": 2 * torch.atan2(turn[:, 1:].norm(dim=-1), scalar).rad2deg(),
        "swing_deg": 2
        * torch.atan2(across.clamp(min=0).sqrt(), torch.hypot(scalar, along)).rad2deg(),
        "twist_deg": 2 * torch.atan2(along, scalar).rad2deg(),
    }
    planted, fitted = (
        room.body(room.betas, *each).joints for each in ((pose, trans), found.values())
    )
    angles["joints_mm"] = 1e3 * (planted - fitted).norm(dim=-1)
    return {
        f"{name}_{what}": float(getattr(x, what)())
        for name, x in angles.items()
        for what in ("mean", "max")
    }


def jacobian_seconds(room: Room, pose: Tensor, trans: Tensor, repeats: int = 5) -> dict[str, float]:
    """Medians for the Jacobian of all silhouettes and depths to pose and translation, explicit and
    by forward mode.
    """

    def explicit() -> tuple[Tensor, ...]:
        shown = room.shown(pose, trans)
        return shown.chained(silhouette_jacobian), shown.chained(
            lambda frame: depth_jacobian(frame, WALL)
        )

    def images(pose: Tensor, trans: Tensor) -> tuple[Tensor, ...]:
        shown = room.shown(pose, trans)
        return shown.silhouettes, shown.depths

    def forward() -> object:
        return torch.func.jacfwd(images, argnums=(0, 1))(pose, trans)

    times: dict[str, list[float]] = {"explicit": [], "forward": []}
    for _ in range(repeats):
        for name, function in (("explicit", explicit), ("forward", forward)):
            began = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - began)
    return {name: float(np.median(each)) for name, each in times.items()}


def run(room: Room, name: str, start: int, kind: str) -> dict:
    """One fit; a pose is planted with the same seed for all its starts."""
    seed = list(POSES).index(name)
    pose, trans = planted(room, name, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(1000 * seed + start + 1)
    first = dict(zip(("pose", "trans"), turned(pose, trans, generator), strict=True))
    observed = observe(room, pose, trans, kind, generator)
    found, told = fit(room, observed, **first)
    before, after = (errors(room, each, pose, trans) for each in (first, found))
    met = after["swing_deg_mean"] <= SWING_GOAL and after["joints_mm_max"] <= JOINT_GOAL
    return {
        "pose": name,
        "start": start,
        "images": kind,
        "met": met,
        **after,
        "before": before,
        **told,
    }


def table(rows: list[dict], title: str) -> Table:
    """One row a fit."""
    goals = f"goals: swing {SWING_GOAL:g} degrees on average, joints {JOINT_GOAL:g} mm at most"
    found = Table(
        title=title,
        caption=f"{goals}; degrees and mm, mean and largest over joints, in brackets at the start",
    )
    for head in ("images", "pose", "start", "swing", "twist", "joints mm", "steps", "s", "met"):
        found.add_column(head, justify="left" if head in ("images", "pose", "met") else "right")
    for row in rows:
        found.add_row(
            row["images"],
            row["pose"],
            str(row["start"]),
            *(_pair(row, name) for name in ("swing_deg", "twist_deg", "joints_mm")),
            str(row["iterations"]),
            f"{row['seconds']:.1f}",
            "yes" if row["met"] else "no",
        )
    return found


def _pair(row: dict, name: str) -> str:
    now, before = (
        f"{each[name + '_mean']:.2f} {each[name + '_max']:6.2f}" for each in (row, row["before"])
    )
    return f"{now} ({before})"


def main() -> None:
    """Fit all, print a table, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--size", type=int, default=128, help="pixels a side")
    arguments.add_argument("--poses", nargs="+", choices=POSES, default=list(POSES), metavar="NAME")
    arguments.add_argument("--starts", type=int, default=2, help="random starts for each pose")
    arguments.add_argument(
        "--images", nargs="+", choices=("exact", "sensor"), default=["exact", "sensor"]
    )
    options = arguments.parse_args()
    where = machine()
    room = Room.of(options.size)
    rows = []
    seconds = jacobian_seconds(room, *planted(room, "walking", torch.Generator().manual_seed(0)))
    for kind in options.images:
        for name in options.poses:
            for start in range(options.starts):
                row = run(room, name, start, kind)
                rows.append(row)
                print(
                    f"{kind} {name} {start}: swing {row['swing_deg_mean']:.2f} degrees, joints at "
                    "most "
                    f"{row['joints_mm_max']:.2f} mm off, {row['seconds']:.0f} s",
                    flush=True,
                )
    size = f"{options.size} x {options.size}"
    Console(width=150).print(
        table(rows, f"pose of a body from 3 images of {size} pixels: {in_words(where)}")
    )
    print(f"{sum(row['met'] for row in rows)} of {len(rows)} fits meet the goals")
    print(
        f"one Jacobian of all images to pose and translation: {1e3 * seconds['explicit']:.0f} ms "
        "explicit, "
        f"{1e3 * seconds['forward']:.0f} ms by forward differentiation"
    )
    write_json(
        options.out,
        {"machine": where, "size": options.size, "jacobian_seconds": seconds, "rows": rows},
    )


if __name__ == "__main__":
    main()
