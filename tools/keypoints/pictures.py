"""Pictures of made people whose keypoints are known, for a detector to look at.

    python tools/keypoints/pictures.py FOLDER CAPTURE... [--people 60] [--seed 1]

Each person is a draw of the women's or men's body in painted skin, with shirt, trousers or shorts,
shoes and hair as colours, in poses of the captures (fitted by `habitus.mosh`), seen from around at
the height of a person, before a background of smooth noise. FOLDER gets a .png for each picture and
people.npz: betas, poses, places, cameras and bodies.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import zoom

import habitus as hb
from habitus.body.model import BodyModel
from habitus.body.skin import skin_of
from habitus.observe.camera_rig import RigCamera
from habitus.report.drawing import draw_surface
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation

SIZE = 512
"""Pixels of a picture's sides."""
VIEWS = 6
"""Pictures of a person, each in another pose and from another side."""
SHIRT = ("spine1", "spine2", "spine3", "left_collar", "right_collar")
SLEEVES = ("left_shoulder", "right_shoulder")
LONG_SLEEVES = (*SLEEVES, "left_elbow", "right_elbow")
SHORTS = ("pelvis", "left_hip", "right_hip")
TROUSERS = (*SHORTS, "left_knee", "right_knee")
SHOES = ("left_ankle", "right_ankle", "left_foot", "right_foot")


def dressed(body: BodyModel, rng: np.random.Generator) -> np.ndarray:
    """Colours (V, 3; 0 to 1) of a person: skin, hair and clothes."""
    skin = skin_of(body.mesh, float(rng.uniform(0.05, 0.95)))
    assert skin is not None
    colours = skin.colours / 255.0
    strongest = np.array(body.joint_names)[body.skinning_weights.argmax(1)]
    for joints in (
        (*SHIRT, *(LONG_SLEEVES if rng.random() < 0.4 else SLEEVES)),
        TROUSERS if rng.random() < 0.6 else SHORTS,
        SHOES,
    ):
        colours[np.isin(strongest, joints)] = rng.uniform(0.05, 0.95, 3)
    rest = body.v_template
    eyes = rest[body.landmarks["left_eye"]]
    ears = rest[body.landmarks["left_ear"]]
    head = strongest == "head"
    crown = (rest[:, 1] > eyes[1] + 0.05) | ((rest[:, 2] < ears[2]) & (rest[:, 1] > ears[1] - 0.03))
    colours[head & crown] = rng.uniform(0.05, 0.5) * rng.uniform(0.5, 1.0, 3)
    return colours


def camera_around(middle: np.ndarray, height: float, rng: np.random.Generator) -> RigCamera:
    """A camera 2.5 to 5 m from a person, who fills 55 to 80 % of its picture."""
    around, up = rng.uniform(-np.pi, np.pi), rng.uniform(-0.1, 0.5)
    distance = rng.uniform(2.5, 5.0)
    away = np.array([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)])
    place = middle + distance * away
    right = np.cross(-away, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(-away, right), -away])
    focal = rng.uniform(0.55, 0.8) * SIZE * distance / height
    centre = SIZE / 2.0 + rng.uniform(-0.05, 0.05, 2) * SIZE
    return RigCamera(
        "camera", SIZE, SIZE, np.full(2, focal), centre, turn, -turn @ place, np.zeros(8)
    )


def picture(camera: RigCamera, vertices, faces, colours, rng: np.random.Generator) -> np.ndarray:
    """The person before a background, with a gain of its own and noise."""
    pixels = camera.project(vertices)
    depth = vertices @ camera.rotation[2] + camera.translation[2]
    scale = float(camera.focal[0] / depth.mean())
    flat = np.column_stack([pixels, -scale * (depth - depth.min())])
    drawn = draw_surface(flat, faces, colours, SIZE, SIZE).astype(float)
    ground = zoom(rng.uniform(40, 220, (5, 5, 3)), (SIZE / 5, SIZE / 5, 1), order=1)
    cover = drawn[..., 3:] / 255.0
    image = cover * drawn[..., :3] + (1.0 - cover) * ground
    image = rng.uniform(0.8, 1.2) * image + rng.normal(0.0, 3.0, image.shape)
    return image.clip(0, 255).astype(np.uint8)


def motions(captures: list[Path]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses (T, J, 3) and upright headings of the captures' fits."""
    found = []
    for path in captures:
        for fit in hb.mosh(path):
            turn = up_rotation(fit.up_axis)
            pose = fit.pose[:, :24].copy()
            pose[:, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[:, 0]))
            found.append(pose)
    return found


def main() -> None:
    """Render the pictures."""
    options = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    options.add_argument("folder", type=Path)
    options.add_argument("captures", nargs="+", type=Path)
    options.add_argument("--people", type=int, default=60)
    options.add_argument("--seed", type=int, default=1)
    asked = options.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    poses = motions(asked.captures)
    bodies = {name: hb.load_body(name).full for name in ("female", "male")}
    rows = []
    for person in range(asked.people):
        rng = np.random.default_rng([asked.seed, person])
        sex = str(rng.choice(list(bodies)))
        body = bodies[sex]
        betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
        assert body is not None
        colours = dressed(body, rng)
        for _ in range(VIEWS):
            motion = poses[rng.integers(len(poses))]
            pose = motion[rng.integers(len(motion))].copy()
            surface = body(betas, pose, np.zeros(3))
            vertices = np.asarray(surface.vertices)
            low, high = vertices.min(0), vertices.max(0)
            camera = camera_around(0.5 * (low + high), float((high - low).max()), rng)
            image = picture(camera, vertices, body.faces, colours, rng)
            Image.fromarray(image).save(asked.folder / f"{len(rows):05d}.png")
            rows.append((person, sex, betas, pose, camera))
    person, sex, betas, pose, cameras = zip(*rows, strict=True)
    np.savez_compressed(
        asked.folder / "people.npz",
        person=np.array(person),
        body=np.array(sex),
        betas=np.array(betas),
        pose=np.array(pose),
        focal=np.array([camera.focal for camera in cameras]),
        centre=np.array([camera.centre for camera in cameras]),
        rotation=np.array([camera.rotation for camera in cameras]),
        translation=np.array([camera.translation for camera in cameras]),
    )


if __name__ == "__main__":
    main()
