"""People before depth cameras: a textured person in a lit room, seen in several views (T 4.6.1),
with the truth.

Hair lies flat under a cap and clothing is tight: skin is a little further out there, and of another
colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.fit.selection.held_out import smooth_field
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import Camera, DepthView, RgbdCapture
from habitus.observe.light import harmonics, srgb_bytes
from habitus.render.draw import draw
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus_lab.population.depth_sensors import SENSORS, DepthSensor, sense, smaller
from habitus_lab.population.painted_skin import dressed

HAIR, CLOTH = 0.005, 0.0008
"""Metres that a flat cap of hair and tight clothing add."""
WOBBLE = 0.04
"""Radians (sd) that joints differ between two views of one person who tries to stand still."""
CAMERA_HEIGHT = 1.0
DISTANCE = 2.6
WALL = 4.0
MISPLACED = 0.006
"""Metres (sd) by which the colour camera is elsewhere than its calibration says."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture and the truth: surfaces (K, V, 3) of the bare body in the sensor's frame, rest (V,
    3), albedo (V, 3), light (9, 3), and where the colour camera really is (its translation).
    """

    capture: RgbdCapture
    surfaces: Float[np.ndarray, "K V 3"]
    rest: Float[np.ndarray, "V 3"]
    albedo: Float[np.ndarray, "V 3"]
    light: Float[np.ndarray, "9 3"]
    colour_translation: Float[np.ndarray, " 3"]


def rgbd_scene(
    body: BodyModel,
    rest: Float[np.ndarray, "V 3"],
    rng: np.random.Generator,
    *,
    sensor: DepthSensor | str = "kinect-v1",
    turns: Sequence[float] = (0.0, 45.0),
    arms: float = 45.0,
    folded: bool = False,
    scale: float = 1.0,
    hair: Float[np.ndarray, " V"] | None = None,
    name: str = "person",
) -> Scene:
    """A person whose rest surface is given, before a sensor, turned by so many degrees in each
    view.

    arms: degrees that they hang below the level (an A-pose has 45, a T-pose 0). folded: forearms
    before the belly, in each person somewhat differently. scale: of the images' sides. hair:
    metres on each vertex, in place of a flat cap of 5 mm.
    """
    kind = SENSORS[sensor] if isinstance(sensor, str) else sensor
    kind = smaller(kind, scale)
    surfaces = _posed(body, rest, turns, arms, folded, rng)
    albedo = person_albedo(body, rng)
    dressed = surfaces + _layers(body, hair)[:, None] * vertex_normals(surfaces, body.faces)
    light = room_light(rng)
    room = _room(rng)
    depth_camera, colour_camera, wrong = _cameras(kind, rng)
    pattern = int(rng.integers(1 << 30))
    drawn = [_shots(kind, (depth_camera, colour_camera), None, room, light, rng, pattern)]
    drawn += [
        _shots(
            kind,
            (depth_camera, colour_camera),
            (vertices, body.faces, albedo),
            room,
            light,
            rng,
            pattern,
        )
        for vertices in dressed
    ]
    (empty, empty_colour), *seen = drawn
    claimed_camera = colour_camera.replace(
        translation=colour_camera.translation - torch.from_numpy(wrong)
    )
    views = tuple(
        DepthView(
            depth, depth_camera, colour, claimed_camera, empty, empty_colour, name=f"{name} {k}"
        )
        for k, (depth, colour) in enumerate(seen)
    )
    return Scene(
        RgbdCapture(name, views), surfaces, rest, albedo, light, colour_camera.translation.numpy()
    )


def planted_rest(
    body: BodyModel, rng: np.random.Generator, off: float = 0.004
) -> Float[np.ndarray, "V 3"]:
    """A person of the model at rest, off it by a smooth field of ``off`` metres (rms) and some 8
    cm.
    """
    rest = body.rest_vertices(np.clip(rng.normal(size=body.num_betas), -2.5, 2.5))
    return rest + off / np.sqrt(3.0) * smooth_field(rest, rng)


def _posed(
    body: BodyModel,
    rest: np.ndarray,
    turns: Sequence[float],
    arms: float,
    folded: bool,
    rng: np.random.Generator,
) -> Float[np.ndarray, "K V 3"]:
    """The person in the sensor's frame, standing on the floor, turned, arms hanging, wobbling from
    view to view.
    """
    joints = body.joint_regressor @ rest
    prepared = body.prepare()
    base = {
        name: rng.normal(size=3) * sd for name, sd in _SPREADS.items() if name in body.joint_names
    }
    down = np.deg2rad(arms + rng.normal() * 6.0)
    bend = abs(rng.normal(0.15, 0.12))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        base[f"{side}_shoulder"] = base[f"{side}_shoulder"] + (0.0, 0.0, sign * down)
        base[f"{side}_elbow"] = base[f"{side}_elbow"] + (0.0, sign * bend, 0.0)
        if folded:
            twist = matrix_from_rotvec(np.array([np.deg2rad(rng.uniform(35.0, 65.0)), 0.0, 0.0]))
            base[f"{side}_shoulder"] = rotvec_from_matrix(
                matrix_from_rotvec(base[f"{side}_shoulder"]) @ twist
            )
            base[f"{side}_elbow"] = base[f"{side}_elbow"] + (
                0.0,
                sign * np.deg2rad(rng.uniform(75.0, 105.0)),
                0.0,
            )
        base[f"{side}_hip"] = base[f"{side}_hip"] + (0.0, 0.0, -sign * np.deg2rad(6.0))
    surfaces = []
    place = np.array([rng.normal() * 0.05, 0.0, DISTANCE + rng.normal() * 0.1])
    for turn in turns:
        pose = {joint: value + WOBBLE * rng.normal(size=3) for joint, value in base.items()}
        posed = prepared.carried(rest, joints, pose)
        yaw = np.deg2rad(turn) + 0.05 * rng.normal()
        posed = posed @ matrix_from_rotvec(np.array([0.0, yaw, 0.0])).T
        posed = posed - np.array([posed[:, 0].mean(), posed[:, 1].min(), posed[:, 2].mean()])
        spot = place + 0.03 * rng.normal(size=3)
        surfaces.append(_to_sensor(posed) + np.array([spot[0], 0.0, spot[2]]))
    return _tilted(np.stack(surfaces))


_SPREADS = {
    **{
        f"{side}_{part}": 0.08
        for side in ("left", "right")
        for part in ("shoulder", "elbow", "hip", "wrist")
    },
    **{
        f"{side}_{part}": 0.04 for side in ("left", "right") for part in ("knee", "ankle", "collar")
    },
    **dict.fromkeys(("spine1", "spine2", "spine3", "neck", "head"), 0.03),
}
_TILT = np.deg2rad(1.0)


def _to_sensor(points: np.ndarray) -> np.ndarray:
    """Points of a world (y up from the floor, facing the camera) before a level camera at
    CAMERA_HEIGHT.
    """
    return points * np.array([1.0, -1.0, -1.0]) + np.array([0.0, CAMERA_HEIGHT, 0.0])


def _tilted(points: np.ndarray) -> np.ndarray:
    return points @ matrix_from_rotvec(np.array([_TILT, 0.0, 0.0])).T


def person_albedo(body: BodyModel, rng: np.random.Generator) -> Float[np.ndarray, "V 3"]:
    """Skin with freckled patches, hair, a shirt with stripes and shorts: linear albedo of each
    vertex.
    """
    tone = np.array([0.62, 0.44, 0.35]) * rng.uniform(0.45, 1.15)
    colour = np.tile(tone, (body.num_vertices, 1)) * np.exp(
        0.15 * smooth_field(body.v_template, rng)[:, :1]
    )
    hair, shirt, shorts = dressed(body)
    colour[hair] = np.array([0.10, 0.07, 0.05]) * rng.uniform(0.5, 4.0)
    colour[shirt] = rng.uniform(0.08, 0.7, 3)
    stripes = np.sin(body.v_template[:, 1] * rng.uniform(60.0, 120.0)) > 0.3
    colour[shirt & stripes] = rng.uniform(0.1, 0.8, 3)
    colour[shorts] = rng.uniform(0.05, 0.5, 3)
    return np.clip(colour, 0.02, 0.95)


def _layers(
    body: BodyModel, thick: Float[np.ndarray, " V"] | None = None
) -> Float[np.ndarray, " V"]:
    """Metres that hair (of its own thickness, or a flat cap) and clothing lie on the skin."""
    hair, shirt, shorts = dressed(body)
    return (HAIR * hair if thick is None else thick) + CLOTH * (shirt | shorts)


def room_light(rng: np.random.Generator) -> Float[np.ndarray, "9 3"]:
    """Harmonics of a room's light in the sensor's frame (y down): much from everywhere, more from
    above and a side.
    """
    light = np.zeros((9, 3))
    white = np.array([1.0, 0.95, 0.88]) ** rng.uniform(-0.5, 1.5)
    light[0] = rng.uniform(0.7, 0.9)
    light[1] = -rng.uniform(0.2, 0.35)
    light[2], light[3] = -rng.uniform(0.1, 0.3), rng.uniform(-0.25, 0.25)
    light[4:] = 0.05 * rng.normal(size=(5, 1))
    return light * white


def _room(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Floor and back wall: vertices in the sensor's frame, faces, albedo."""
    x = np.linspace(-3, 3, 37)
    y = np.linspace(-2.6, CAMERA_HEIGHT, 25)
    z = np.linspace(0.6, WALL, 21)
    floor = np.stack(np.meshgrid(x, [CAMERA_HEIGHT], z, indexing="ij"), -1)[:, 0]
    wall = np.stack(np.meshgrid(x, y, [WALL], indexing="ij"), -1)[:, :, 0]
    points = []
    faces = []
    colours = []
    for grid, tone in ((floor, (0.35, 0.25, 0.18)), (wall, (0.6, 0.6, 0.55))):
        rows, columns = grid.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns) + sum(len(part) for part in points)
        a, b, c, d = (
            part.ravel()
            for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
        )
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
        points.append(grid.reshape(-1, 3))
        colours.append(np.array(tone) * rng.uniform(0.6, 1.4, (rows * columns, 1)))
    return (
        _tilted(np.concatenate(points)),
        np.concatenate(faces),
        np.clip(np.concatenate(colours), 0, 1),
    )


def _cameras(kind: DepthSensor, rng: np.random.Generator) -> tuple[Camera, Camera, np.ndarray]:
    """Depth and colour camera as they are, and how far the latter's calibration is off."""
    depth = Camera.of(kind.width, kind.height, kind.focal)
    wrong = MISPLACED * rng.normal(size=3)
    focal = kind.focal * rng.uniform(0.89, 0.91)
    aside = np.array([-kind.colour_baseline, 0.0, 0.0])
    return depth, Camera.of(kind.width, kind.height, focal, translation=aside + wrong), wrong


Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]
"""Vertices, faces and albedo: a person's and the room's are of different sizes."""


def _shots(
    kind: DepthSensor,
    cameras: tuple[Camera, Camera],
    person: Mesh | None,
    room: Mesh,
    light: np.ndarray,
    rng: np.random.Generator,
    pattern: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m) and colour (sRGB) of the room, with a person or without."""
    vertices, faces, albedo = room if person is None else _joined(person, room)
    triangles = Triangles.of(faces, vertices)
    points = torch.from_numpy(vertices)
    normals = vertex_normals(vertices, faces)
    frame = draw(cameras[0], points, triangles, boundary="none")
    depth = frame.depth().numpy()
    seen = frame.normals(torch.from_numpy(normals)).numpy()
    rows, columns = np.indices(depth.shape)
    rays = cameras[0].rays(
        torch.from_numpy(np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)).double()
    )
    rays = (rays / rays.norm(dim=-1, keepdim=True)).numpy().reshape(*depth.shape, 3)
    measured = sense(kind, depth, (seen * rays).sum(-1), rng, pattern)
    bright = (harmonics(torch.from_numpy(normals)).numpy() @ light).clip(0.02) * albedo
    picture = draw(cameras[1], points, triangles).image(torch.from_numpy(bright)).numpy()
    return measured, srgb_bytes(picture + 0.006 * rng.normal(size=picture.shape))


def _joined(one: Mesh, other: Mesh) -> Mesh:
    count = len(one[0])
    return (
        np.concatenate([one[0], other[0]]),
        np.concatenate([one[1], other[1] + count]),
        np.concatenate([one[2], other[2]]),
    )
