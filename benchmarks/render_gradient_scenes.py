"""The scenes whose derivative images are measured: a cube, a textured sphere, bodies that hide
parts of themselves.

A scene is a function of named parameters; `GradientScene.state` says what is drawn,
`GradientScene.draw` draws it with the renderer, `GradientScene.reference` by brute force
(`render_gradient_reference.py`). The two share vertices and brightness, no cameras.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from render_exact import exact_picture
from render_gradient_reference import ray_cast
from torch import Tensor

import habitus
from habitus.mesh.normals import vertex_normals
from habitus.mesh.shapes import cube, quadrilateral, sphere
from habitus.observe.camera import Camera, look_at
from habitus.observe.lighting import point_light, spherical_harmonics
from habitus.render.draw import draw
from habitus.render.frame import Frame
from habitus.render.textures import Texture
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec

BACKGROUND = 0.1
Parameters = dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class GradientScene:
    """A mesh, where it is seen from, and how its vertices and their brightness follow from the
    parameters.

    `size` is the picture's in pixels, `middle` where in it the camera looks at (a part of a picture
    has it elsewhere). `start` holds the parameters: camera `rotation` (3,), `translation` (3,) and
    `focal` (1,), a `light`, and `vertex` (3,), which is added to the vertices `moved` (one place,
    with its duplicates). `shade` takes vertices (V, 3) and the light to values (V, C).
    """

    name: str
    size: tuple[int, int]
    middle: tuple[float, float]
    vertices: Tensor
    faces: Tensor
    start: Parameters
    moved: Tensor
    shade: Callable[[Tensor, Tensor], Tensor]
    texture: Tensor | None = None
    uv: Tensor | None = None
    triangles: Triangles = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "triangles", Triangles.of(self.faces, positions=self.vertices))

    def state(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Vertices (V, 3) in the world and values (V, C)."""
        vertices = self.vertices.index_add(
            0, self.moved, parameters["vertex"].expand(len(self.moved), 3)
        )
        return vertices, self.shade(vertices, parameters["light"])

    def frame(self, parameters: Parameters, boundary: str) -> tuple[Frame, Tensor]:
        """What the renderer sees, and the values to colour it with."""
        vertices, values = self.state(parameters)
        pose = {name: parameters[name] for name in ("rotation", "translation")}
        camera = Camera.of(
            *self.size,
            focal_length=parameters["focal"].expand(2),
            principal_point=self.middle,
            **pose,
        )
        return draw(camera, vertices, self.triangles, boundary=boundary), values

    def draw(self, parameters: Parameters, boundary: str) -> Tensor:
        """The renderer's picture (H, W, C)."""
        frame, values = self.frame(parameters, boundary)
        if self.texture is None:
            return frame.image(values, background=BACKGROUND)
        texture = Texture.of(self.texture, mipmaps=False)
        return frame.textured(texture, self.uv, brightness=values, background=BACKGROUND)

    def reference(
        self, parameters: Parameters, samples: int, only: np.ndarray | None = None
    ) -> np.ndarray:
        """The picture (H, W, C) by `samples`² rays a pixel; `only` (H, W) some."""
        vertices, values = self.state(parameters)
        points = vertices @ matrix_from_rotvec(parameters["rotation"]).T + parameters["translation"]
        texture, uv = (None if x is None else x.numpy() for x in (self.texture, self.uv))
        arrays = (points.numpy(), np.asarray(self.faces), np.asarray(values))
        return ray_cast(
            self.size, float(parameters["focal"]), *arrays, BACKGROUND, texture, uv, samples, only
        )

    def exact(self, parameters: Parameters) -> np.ndarray:
        """The picture (H, W, C) by exact areas, without a texture."""
        values = np.asarray(self.state(parameters)[1])
        every = np.ones(self.size[::-1], bool)
        return exact_picture(
            self.screen(parameters), np.asarray(self.faces), values, BACKGROUND, every
        )

    def part(self, low: np.ndarray, high: np.ndarray) -> "GradientScene":
        """The same scene in a part of the picture alone: pixels (column, row) from low up to
        high.
        """
        (x, y), (width, height) = self.middle - low, high - low
        return replace(self, size=(int(width), int(height)), middle=(float(x), float(y)))

    def screen(self, parameters: Parameters) -> np.ndarray:
        """Where the vertices are in the picture, in pixels, and their depths: (V, 3)."""
        vertices, _ = self.state(parameters)
        points = vertices @ matrix_from_rotvec(parameters["rotation"]).T + parameters["translation"]
        flat = points[:, :2] / points[:, 2:] * parameters["focal"] + torch.tensor(self.middle)
        return torch.cat([flat, points[:, 2:]], 1).numpy()


def cube_scene(height: int) -> GradientScene:
    """A cube whose faces have colours of their own, under a point light; one corner (three
    duplicates) is free.
    """
    shape = cube(hard=True)
    normals = vertex_normals(shape.vertices, shape.faces)
    palette = torch.tensor(
        [
            [0.9, 0.3, 0.2],
            [0.2, 0.8, 0.4],
            [0.3, 0.4, 0.9],
            [0.9, 0.8, 0.2],
            [0.7, 0.3, 0.8],
            [0.3, 0.8, 0.9],
        ]
    )
    side = (normals.abs().argmax(1) * 2 + (normals.sum(1) > 0)).long()
    albedo = palette.double()[side]

    def shade(vertices: Tensor, light: Tensor) -> Tensor:
        bright = point_light(
            vertices, vertex_normals(vertices, shape.faces), light, torch.ones(3).double()
        )
        return albedo * (0.25 + bright)

    start = _camera(height, 1.9, (-2.5, -0.41, 0.83), (0.06, -0.04, 4.2))
    start["light"] = torch.tensor([1.5, 2.2, 2.5]).double()
    return _scene("cube", height, shape.vertices, shape.faces, start, shade, corner=(0.5, 0.5, 0.5))


def sphere_scene(height: int) -> GradientScene:
    """A globe with a smooth texture and a seam, under a point light; one vertex on its outline is
    free.
    """
    shape = sphere(32, 64)
    assert shape.uv is not None

    def shade(vertices: Tensor, light: Tensor) -> Tensor:
        normals = torch.nn.functional.normalize(
            vertices, dim=-1
        )  # a ball's own, which are equal on both sides of the seam
        return 0.3 + point_light(vertices, normals, light, torch.ones(3).double())

    start = _camera(height, 1.55, (2.7, 0.5, 0.3), (0.1, 0.05, 4.2))
    start["light"] = torch.tensor([2.0, 3.0, 3.0]).double()
    return _scene(
        "sphere",
        height,
        shape.vertices,
        shape.faces,
        start,
        shade,
        None,
        smooth_texture(),
        shape.uv,
    )


def body_scene(height: int) -> GradientScene:
    """The default body with its arms before its trunk, seen from the hips up, under spherical
    harmonics.
    """
    body = habitus.load_body("default")
    pose = torch.zeros(body.num_joints, 3, dtype=torch.float64)
    joint = {name: index for index, name in enumerate(body.joint_names)}
    pose[joint["left_shoulder"]] = torch.tensor([0.2, -0.5, -0.9])
    pose[joint["right_shoulder"]] = torch.tensor([0.3, 0.7, 0.8])
    pose[joint["left_elbow"]] = torch.tensor([0.0, -1.6, -0.3])
    pose[joint["right_elbow"]] = torch.tensor([0.0, 1.5, 0.3])
    vertices = body(pose=pose).vertices
    start = _camera(height, 1.9, (3.05, 0.35, 0.05), (0.0, 0.27, 2.1))
    start["light"] = torch.tensor([1.6, 0.5, 0.4, 0.3, 0.1, -0.1, 0.1, 0.05, 0.1]).double()
    return _scene("body", height, vertices, body.faces, start, _painted(vertices, body.faces))


def side_scene(height: int) -> GradientScene:
    """The whole default body from the side, an arm before its trunk: triangles of two to four
    square pixels.
    """
    body = habitus.load_body("default")
    pose = torch.zeros(body.num_joints, 3, dtype=torch.float64)
    joint = {name: index for index, name in enumerate(body.joint_names)}
    pose[joint["left_shoulder"]] = torch.tensor([0.2, -0.5, -1.2])
    pose[joint["right_shoulder"]] = torch.tensor([0.3, 0.5, 1.2])
    vertices = body(pose=pose).vertices
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    rotation, translation = look_at(middle + torch.tensor([2.6, 0.3, 0.9]).double(), middle)
    start = _camera(height, 1.35, tuple(rotation.tolist()), tuple(translation.tolist()))
    start["light"] = torch.tensor([1.6, 0.5, 0.4, 0.3, 0.1, -0.1, 0.1, 0.05, 0.1]).double()
    return _scene("side", height, vertices, body.faces, start, _painted(vertices, body.faces))


def _painted(vertices: Tensor, faces: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """Shading by spherical harmonics of a surface with coloured waves of some 10 cm and more."""
    wave = torch.sin(
        vertices @ torch.tensor([[9.0, 4.0, 3.0], [3.0, 11.0, 5.0], [6.0, 2.0, 7.0]]).double()
    )
    albedo = 0.6 + 0.3 * wave
    return lambda points, light: albedo * spherical_harmonics(vertex_normals(points, faces), light)


def quadrilateral_scene(height: int) -> GradientScene:
    """A bright square that stands a little aslant: the thesis' Fig 4-7 turns it in the plane."""
    shape = quadrilateral()
    start = _camera(height, 1.0, (0.0, 0.0, 0.3), (0.0, 0.0, 1.9))
    start["light"] = torch.ones(3).double()

    def shade(vertices: Tensor, light: Tensor) -> Tensor:
        return 0.9 * light.expand(len(vertices), 3)

    scene = _scene("quadrilateral", height, shape.vertices, shape.faces, start, shade)
    return replace(scene, size=(height, height), middle=(height / 2, height / 2))


def smooth_texture(height: int = 256) -> Tensor:
    """Waves of some 20 to 40 degrees on a globe, that close around it: (h, 2 h, 3)."""
    v, u = torch.meshgrid(
        *((torch.arange(n).double() + 0.5) / n for n in (height, 2 * height)), indexing="ij"
    )
    u = 2 * torch.pi * u
    v = torch.pi * v
    waves = torch.stack(
        [torch.sin(9 * u) * v.sin(), torch.sin(4 * u + 6 * v) * v.sin(), torch.cos(9 * v)], -1
    )
    return 0.55 + 0.4 * waves


def _camera(height: int, focal: float, rotation: tuple, translation: tuple) -> Parameters:
    return {
        "translation": torch.tensor(translation).double(),
        "rotation": torch.tensor(rotation).double(),
        "focal": torch.tensor([focal * height]).double(),
    }


def _scene(
    name, height, vertices, faces, start, shade, corner=None, texture=None, uv=None
) -> GradientScene:
    """A scene whose free vertex is the one at `corner`, or the one drawn farthest to the right."""
    start["vertex"] = torch.zeros(3).double()
    if corner is None:
        points = vertices @ matrix_from_rotvec(start["rotation"]).T + start["translation"]
        corner = vertices[(points[:, 0] / points[:, 2]).argmax()]
    moved = ((vertices - torch.as_tensor(corner)).abs().amax(1) < 1e-9).nonzero()[:, 0]
    size = (height * 4 // 3, height)
    middle = (height * 4 // 3 / 2, height / 2)
    return GradientScene(name, size, middle, vertices, faces, start, moved, shade, texture, uv)


SCENES = {"cube": cube_scene, "sphere": sphere_scene, "body": body_scene, "side": side_scene}
