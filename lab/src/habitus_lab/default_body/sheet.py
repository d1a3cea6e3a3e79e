"""Pictures of the default bodies, drawn by the project's own renderer, for docs/images and for
looking at.

    python -m habitus_lab.default_body.sheet [--bodies FOLDER] [--out FOLDER] [--only form,faces]

One PNG a subject: form (four sides, face, hand, foot), expressions, components (each at -2 and +2
standard deviations), people (24 random women, men and children), ages, poses, flesh (skinning alone
beside the learned pose blend shapes), hands, face-units (all units, blink, jaw, faces at random),
skins (three tones).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from habitus import load_body
from habitus.body.hands import HAND_POSES, hand_pose
from habitus.body.model import BodyModel
from habitus.body.skin import Skin, skin_of
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.textures import Texture
from habitus_lab.repository import BODIES, REPOSITORY

SKIN = (0.70, 0.71, 0.73)
EYE = (0.95, 0.95, 0.97)
PARTS = {"lashes": (0.2, 0.2, 0.2), "tongue": (0.62, 0.52, 0.53)}
LINING = (0.45, 0.45, 0.48)  # a grey figure, as of clay
FAR = 20.0  # heights of the picture between camera and body: nearly parallel rays
SEED = 4
AGES = (1, 2, 3, 5, 8, 11, 13, 15, 20, 25, 40, 60, 80, 90)  # years
GAMMA = 2.2
ARMS_DOWN = {"left_shoulder": (0, 0, -68), "right_shoulder": (0, 0, 68), "left_collar": (0, 0, -8)}
ARMS_DOWN |= {"right_collar": (0, 0, 8)}
FIST = {
    f"left_{f}{k}": (0, 0, -60) for f in ("index", "middle", "ring", "pinky") for k in (1, 2, 3)
}
POSES: tuple[dict[str, tuple[float, float, float]], ...] = (
    ARMS_DOWN,
    {
        "left_shoulder": (0, -90, 0),
        "right_shoulder": (0, 90, 0),
        "left_wrist": (80, 0, 0),
        "right_wrist": (80, 0, 0),
    },
    {
        "left_shoulder": (0, 0, 60),
        "right_shoulder": (0, 0, -60),
        "left_collar": (0, 0, 25),
        "right_collar": (0, 0, -25),
    },
    {
        "left_hip": (-90, 0, 0),
        "right_hip": (-90, 0, 0),
        "left_knee": (90, 0, 0),
        "right_knee": (90, 0, 0),
        **ARMS_DOWN,
    },
    {"left_elbow": (0, -120, 0), "right_elbow": (0, 90, 0), "left_knee": (100, 0, 0), **FIST},
    {
        "spine1": (20, 0, 0),
        "spine2": (20, 0, 0),
        "spine3": (20, 0, 0),
        "neck": (15, 0, 0),
        **ARMS_DOWN,
    },
    {
        "left_hip": (0, 0, 30),
        "right_hip": (0, 0, -30),
        "spine2": (0, 25, 0),
        "neck": (0, 30, 0),
        "head": (0, 20, 0),
    },
)

FOLDS: tuple[
    tuple[dict[str, tuple[float, float, float]], float, tuple[float, float, float], float], ...
] = (
    ({"left_elbow": (0, -140, 0)}, 180, (0.42, 0.45, 0.0), 0.5),
    ({"left_knee": (140, 0, 0)}, 100, (0.1, -0.42, -0.1), 0.75),
    (
        {
            "left_hip": (-112, 0, 20),
            "right_hip": (-112, 0, -20),
            "left_knee": (130, 0, 0),
            "right_knee": (130, 0, 0),
        },
        70,
        (0, -0.05, 0.1),
        1.3,
    ),
    ({"left_shoulder": (0, 0, 60), "left_collar": (0, 0, 25)}, 160, (0.1, 0.4, 0), 0.8),
    (
        {
            **ARMS_DOWN,
            "left_hip": (-90, 0, 0),
            "right_hip": (-90, 0, 0),
            "left_knee": (90, 0, 0),
            "right_knee": (90, 0, 0),
        },
        75,
        (0, -0.05, 0.15),
        1.2,
    ),
)
"""Pose, the picture's yaw, its middle and its height."""


class View:
    """Where a picture is taken from: degrees about the vertical and downward, the point in its
    middle, and its size.
    """

    def __init__(
        self, yaw: float, pitch: float, centre: np.ndarray, height: float, width: int, rows: int
    ):
        """centre (3,) and height in metres; width and rows in pixels."""
        y, p = np.radians([yaw, pitch])
        forward = -np.array([np.sin(y) * np.cos(p), np.sin(p), np.cos(y) * np.cos(p)])
        right = np.array([np.cos(y), 0, -np.sin(y)])
        self.axes = np.stack([right, np.cross(forward, right), forward])
        self.centre = np.asarray(centre, float)
        self.away = FAR * height
        self.camera = Camera.of(width, rows, focal_length=FAR * rows)

    def picture(self, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """(rows, width, 3) bytes of a mesh under two lights that stand by the camera."""
        normals = _normals(vertices, faces)
        right, down, forward = self.axes
        light = (
            0.25
            + 0.6 * _lit(normals, -forward + 0.5 * right - 0.6 * down)
            + 0.2 * _lit(normals, -forward - right)
        )
        seen = (vertices - self.centre) @ self.axes.T + [0, 0, self.away]
        frame = draw(self.camera, torch.as_tensor(seen), torch.as_tensor(faces.astype(np.int64)))
        image = frame.image(
            torch.as_tensor(light[:, None] * colours), background=torch.ones(3, dtype=torch.float64)
        )
        return (255 * image.clamp(0, 1)).byte().numpy()

    def painted(self, vertices: np.ndarray, body: BodyModel, skin: Skin) -> np.ndarray:
        """(rows, width, 3) bytes of a body in its skin, lit as `picture` is, in linear light."""
        right, down, forward = self.axes
        normals = _normals(vertices, np.asarray(body.faces))
        light = (
            0.35
            + 0.6 * _lit(normals, -forward + 0.5 * right - 0.6 * down)
            + 0.2 * _lit(normals, -forward - right)
        )
        seen = (vertices - self.centre) @ self.axes.T + [0, 0, self.away]
        faces = torch.as_tensor(np.asarray(body.faces, np.int64))
        image = draw(self.camera, torch.as_tensor(seen), faces).textured(
            Texture.of((skin.image / 255.0) ** GAMMA),
            torch.as_tensor(skin.mesh.uv.astype(np.float64)),
            torch.as_tensor(skin.mesh.triangle_uv(body.faces)),
            torch.as_tensor(light[:, None]),
            background=torch.ones(3, dtype=torch.float64),
        )
        return (255 * image.clamp(0, 1) ** (1 / GAMMA)).byte().numpy()


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    each = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.ravel(), np.repeat(each[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _lit(normals: np.ndarray, towards: np.ndarray) -> np.ndarray:
    return np.clip(normals @ (towards / np.linalg.norm(towards)), 0, 1)


def _colours(body: BodyModel) -> np.ndarray:
    """(V, 3): skin, eyeballs, the lining of the mouth."""
    colours = np.tile(SKIN, (body.num_vertices, 1))
    quads = np.asarray(body.mesh.quads)
    hidden = np.asarray(body.mesh.hidden)
    colours[np.setdiff1d(quads[hidden], quads[~hidden])] = LINING
    eyes = np.flatnonzero(
        np.isin(
            body.skinning_index[:, 0], [k for k, n in enumerate(body.joint_names) if "eye" in n]
        )
    )
    colours[eyes] = EYE
    if "part_index" in body.extras:
        of_parts = body.extras["part_index"]
        names = body.extras["part_names"][of_parts].tolist()
        first = body.num_vertices - len(of_parts)
        colours[first:] = [PARTS.get(name, EYE) for name in names]
    return colours


def posed(
    body: BodyModel,
    pose: dict[str, tuple[float, float, float]],
    **more: np.ndarray | dict[str, float],
) -> np.ndarray:
    """Vertices (V, 3); turns by joint, degrees."""
    turns = {name: np.radians(turn) for name, turn in pose.items()}
    return np.asarray(body(pose=turns, **more).vertices, float)


def grid(pictures: list[np.ndarray], columns: int) -> Image.Image:
    """Pictures of one size in rows."""
    rows = [np.concatenate(pictures[k : k + columns], 1) for k in range(0, len(pictures), columns)]
    width = max(row.shape[1] for row in rows)
    return Image.fromarray(np.concatenate([_padded(row, width) for row in rows]))


def _padded(row: np.ndarray, width: int) -> np.ndarray:
    return np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255)


def _mark(body: BodyModel, vertices: np.ndarray, name: str) -> np.ndarray:
    return vertices[body.landmarks[name]]


def _whole(vertices: np.ndarray, yaw: float, width: int, rows: int, height: float = 1.95) -> View:
    """All of a person who stands on the picture's lower edge."""
    low = vertices[:, 1].min()
    return View(yaw, 0, np.array([0, low + 0.48 * height, 0]), height, width, rows)


def form(bodies: dict[str, BodyModel]) -> Image.Image:
    """Woman and man: four sides, then face, profile, hand, palm, foot."""
    pictures = []
    for name in ("female", "male"):
        body = bodies[name]
        v = posed(body, {})
        colours = _colours(body)
        take = partial(_taken, v, body.faces, colours)
        pictures += [take(_whole(v, yaw, 400, 420)) for yaw in (0, 90, 180, 40)]
        head = _mark(body, v, "head_top") - [0, 0.13, -0.02]
        hand = _mark(body, v, "left_middle_tip") - [0.09, 0, 0]
        foot = _mark(body, v, "left_toe_tip") - [0, 0, 0.1]
        pictures += [take(View(yaw, 0, head, 0.32, 400, 420)) for yaw in (0, 60)]
        pictures += [
            take(View(0, 89, hand, 0.25, 400, 420)),
            take(View(25, 50, foot, 0.27, 400, 420)),
        ]
    return grid(pictures, 4)


def _taken(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, view: View) -> np.ndarray:
    return view.picture(vertices, np.asarray(faces), colours)


def expressions(bodies: dict[str, BodyModel]) -> Image.Image:
    """The ten components at -2 and +2 standard deviations, and the jaw open."""
    body = bodies["neutral"]
    colours = _colours(body)
    rest = posed(body, {})
    view = View(20, 0, _mark(body, rest, "head_top") - [0, 0.14, -0.02], 0.27, 200, 230)
    pictures = []
    for k in range(10):
        for sign in (-2.0, 2.0):
            face = posed(body, {}, expression=sign * np.eye(10)[k])
            pictures.append(view.picture(face, np.asarray(body.faces), colours))
    shown = [posed(body, {"jaw": (angle, 0, 0)}) for angle in (0, 10, 20)]
    pictures += [view.picture(face, np.asarray(body.faces), colours) for face in shown]
    return grid(pictures, 10)


def face_units(bodies: dict[str, BodyModel]) -> Image.Image:
    """The 52 units of the woman at full strength; then a blink and an opening jaw in steps,
    a smile, closed lips over an open jaw, and random weights of all units; last, faces of random
    identity.
    """
    body = bodies["parts"]
    colours = _colours(body)
    rest = _mark(body, posed(body, {}), "head_top") - [0, 0.14, -0.02]
    both = ("Left", "Right")
    rows = [{name: 1.0} for name in body.face_unit_names]
    rows += [{f"eyeBlink{side}": weight for side in both} for weight in (0.0, 0.5, 1.0)]
    rows += [{"jawOpen": weight} for weight in (0.5, 1.0)]
    rows += [{f"mouthSmile{side}": 1.0 for side in both}, {"jawOpen": 1.0, "mouthClose": 1.0}]
    rng = np.random.default_rng(SEED)
    for _ in range(6):
        some = rng.choice(len(body.face_unit_names), 5, replace=False)
        rows.append({body.face_unit_names[k]: float(rng.uniform(0.3, 0.9)) for k in some})
    faces = [posed(body, {}, face=row) for row in rows]
    faces += [posed(body, {"jaw": (angle, 0, 0)}) for angle in (10, 20, 25)]
    count = body.num_face_betas
    faces += [posed(body, {}, face_betas=rng.normal(size=count)) for _ in range(10)]
    view = View(20, 0, rest, 0.27, 150, 175)
    return grid([view.picture(each, np.asarray(body.faces), colours) for each in faces], 13)


def components(bodies: dict[str, BodyModel]) -> Image.Image:
    """Every component of the neutral space: -2 above +2."""
    body = bodies["neutral"]
    colours = _colours(body)
    count = body.num_betas
    pictures = []
    for first in range(0, count, 12):
        for sign in (-2.0, 2.0):
            for k in range(first, min(first + 12, count)):
                v = posed(body, ARMS_DOWN, betas=sign * np.eye(count)[k])
                pictures.append(
                    _whole(v, 30, 120, 260, 2.05).picture(v, np.asarray(body.faces), colours)
                )
    return grid(pictures, 12)


def people(bodies: dict[str, BodyModel]) -> Image.Image:
    """24 women, 24 men and 24 children drawn at random."""
    rng = np.random.default_rng(SEED)
    pictures = []
    crowd = [(bodies["female"], None)] * 24 + [(bodies["male"], None)] * 24
    crowd += [(bodies["female" if k % 2 else "male"], 5 + 10 * k / 23) for k in range(24)]
    for body, years in crowd:
        person = body if years is None else body.at_age(years)
        v = posed(person, ARMS_DOWN, betas=body.draw_betas(1, rng)[0])
        pictures.append(
            _whole(v, 30, 120, 250, 2.05).picture(v, np.asarray(body.faces), _colours(body))
        )
    return grid(pictures, 12)


def ages(bodies: dict[str, BodyModel]) -> Image.Image:
    """Mean women and men of 1 to 90 years, then from the side."""
    pictures = []
    for name in ("female", "male"):
        body = bodies[name]
        for yaw in (30, 90):
            for years in AGES:
                v = posed(body.at_age(years), ARMS_DOWN)
                view = _whole(v, yaw, 150, 320, 1.95)
                pictures.append(view.picture(v, np.asarray(body.faces), _colours(body)))
    return grid(pictures, len(AGES))


def poses(bodies: dict[str, BodyModel]) -> Image.Image:
    """Seven poses of woman and man."""
    pictures = []
    for name, yaw in (("female", 35), ("male", 35), ("male", 100)):
        body = bodies[name]
        for pose in POSES:
            v = posed(body, pose)
            view = View(yaw, 0, np.array([0, 0.12, 0]), 2.4, 230, 300)
            pictures.append(view.picture(v, np.asarray(body.faces), _colours(body)))
    return grid(pictures, len(POSES))


def flesh(bodies: dict[str, BodyModel]) -> Image.Image:
    """Deep folds of woman and man: skinning alone, then with the pose blend shapes."""
    pictures = []
    for name in ("female", "male"):
        body = bodies[name]
        for one in (replace(body, posedirs=None), body):
            for pose, yaw, centre, height in FOLDS:
                view = View(yaw, 10, np.array(centre), height, 250, 250)
                pictures.append(
                    view.picture(posed(one, pose), np.asarray(body.faces), _colours(body))
                )
    return grid(pictures, len(FOLDS))


def hands(bodies: dict[str, BodyModel]) -> Image.Image:
    """The hand poses of woman and man: palm, back, and the side of the thumb."""
    pictures = []
    for name in ("female", "male"):
        body = bodies[name]
        middle = 0.5 * (
            _mark(body, posed(body, {}), "left_middle_tip")
            + body.rest_joints()[body.joint_names.index("left_wrist")]
        )
        for yaw, pitch in ((0, -89), (0, 89), (0, 0)):
            view = View(yaw, pitch, middle, 0.26, 240, 240)
            for pose in HAND_POSES:
                v = np.asarray(body(pose=hand_pose(body, pose)).vertices, float)
                pictures.append(view.picture(v, np.asarray(body.faces), _colours(body)))
    return grid(pictures, len(HAND_POSES))


def skins(bodies: dict[str, BodyModel]) -> Image.Image:
    """Light, medium and dark skin: front, back, face, hand, palm, foot."""
    pictures = []
    for name, tone in (("female", "light"), ("male", "medium"), ("female", "dark")):
        body = bodies[name]
        skin = skin_of(body.mesh, tone)
        v, still = posed(body, ARMS_DOWN), posed(body, {})
        hand = _mark(body, still, "left_middle_tip") - [0.09, 0, 0]
        foot = _mark(body, still, "left_toe_tip") - [0, 0, 0.1]
        head = _mark(body, v, "head_top") - [0, 0.13, -0.02]
        shots = [(_whole(v, yaw, 210, 400), v) for yaw in (0, 180)]
        shots += [(View(yaw, 0, head, 0.3, 320, 400), v) for yaw in (0, 50)]
        shots += [(View(90, pitch, hand, 0.26, 220, 400), still) for pitch in (89, -89)]
        shots += [(View(25, 50, foot, 0.27, 260, 400), still)]
        pictures.append(np.concatenate([view.painted(at, body, skin) for view, at in shots], 1))
    return grid(pictures, 1)


SHEETS: dict[str, Callable[[dict[str, BodyModel]], Image.Image]] = {
    "form": form,
    "expressions": expressions,
    "face-units": face_units,
    "components": components,
    "people": people,
    "ages": ages,
    "poses": poses,
    "flesh": flesh,
    "hands": hands,
    "skins": skins,
}


COLOURED = ("skins",)
"""Sheets of more colours than a palette holds."""


def main() -> None:
    """Draw and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs/images")
    parser.add_argument("--only", default=",".join(SHEETS))
    options = parser.parse_args()
    bodies = {
        name: load_body(options.bodies / f"{name}.npz", detail="full", joints="smplx")
        for name in ("female", "male", "neutral")
    }
    bodies["parts"] = load_body(options.bodies / "female.npz", detail="parts", joints="smplx")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only.split(","):
        sheet = SHEETS[name](bodies)
        path = options.out / f"default-body-{name}.{'jpg' if name in COLOURED else 'png'}"
        few = sheet if name in COLOURED else sheet.quantize(128, dither=Image.Dither.NONE)
        few.save(path, optimize=True, quality=88)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
