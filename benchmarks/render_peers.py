"""Do OpenGL and Mitsuba 3 draw the same picture as `habitus`, and does Mitsuba find the same
gradient?

    python benchmarks/render_peers.py [--samples 64] [--folder render_peers]

What `render_speed.py` races against, put to the test first: the torus of `render_scenes.py` by each
that is there, the largest and the mean difference, depth against OpenGL's, and Mitsuba's gradient
with respect to vertices (projective sampling: a mean over random samples, so the noise of single
vertices is told apart from the sum over all). Pictures and their differences, ten times enlarged,
go to the folder.

OpenGL needs `moderngl` and a system's EGL (Debian: libegl1, libgl1-mesa-dri); Mitsuba needs
`mitsuba` and LLVM 19 (Debian: libllvm19; older ones abort), which is looked for and named in
DRJIT_LIBLLVM_PATH. `pip install '.[bench]'` brings the Python packages.
"""

import os

from common import parser

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("LIBGL_ALWAYS_SOFTWARE", "1")

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from render_scenes import TorusScene, forward, moved, save_picture, torus_scene, vertex_gradient
from rich.console import Console
from rich.table import Table

from habitus.rotations import matrix_from_rotvec

NEAR = 0.1
FAR = 100.0
VERTEX_SHADER = """#version 330
uniform mat4 camera; in vec3 place; in vec3 colour; out vec3 shade;
void main() { gl_Position = camera * vec4(place, 1.0); shade = colour; }"""
FRAGMENT_SHADER = """#version 330
in vec3 shade; out vec4 pixel;
void main() { pixel = vec4(shade, 1.0); }"""


class Missing(Exception):
    """A peer that cannot run here, and why."""


class OpenGL:
    """The scene on the graphics driver's own memory, drawn without a window by whatever EGL finds
    (llvmpipe).

    Colours are 8 bits a channel, or floats as `habitus` gives them; rows come top first because the
    camera's y points down in both, which also turns round what OpenGL takes for the front. The mesh
    is sent once, which is to OpenGL's advantage. `cull`: leave out faces seen from behind.
    """

    def __init__(self, scene: TorusScene, floats: bool = False, cull: bool = False):
        try:
            import moderngl

            self.context = moderngl.create_standalone_context(backend="egl")
        except Exception as problem:  # moderngl raises bare Exception where there is no driver
            raise Missing(f"OpenGL: {_first_line(problem)}") from None
        self.renderer = str(self.context.info["GL_RENDERER"])
        data = torch.cat([scene.vertices, scene.colours], 1).detach().float().contiguous().numpy()
        faces = scene.triangles.faces.int().contiguous().numpy()
        program = self.context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
        program["camera"].write(
            np.ascontiguousarray(clip_from_world(scene).T, np.float32).tobytes()
        )
        layout = [(self.context.buffer(data.tobytes()), "3f 3f", "place", "colour")]
        self.mesh = self.context.vertex_array(program, layout, self.context.buffer(faces.tobytes()))
        self.kind, number = ("f4", np.float32) if floats else ("f1", np.uint8)
        self.channels = 3 if floats else 4
        """llvmpipe hands out packed words of four bytes fastest."""
        self.colour = np.empty((*scene.size[::-1], self.channels), number)
        self.depth = np.empty(scene.size[::-1], np.float32)
        buffers = (
            self.context.texture(scene.size, self.channels, dtype=self.kind),
            self.context.depth_texture(scene.size),
        )
        self.target = self.context.framebuffer([buffers[0]], buffers[1])
        self.context.enable(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if cull else 0))
        self.context.front_face = "cw"

    def draw(self) -> None:
        """Draw, and read colour and depth back into `colour` and `depth` (the driver's own, from 0
        to 1).
        """
        with self.context:
            self.target.use()
            self.target.clear()
            self.mesh.render()
            self.target.read_into(self.colour, components=self.channels, dtype=self.kind)
            self.target.read_into(self.depth, attachment=-1, components=1, dtype="f4")

    def picture(self) -> tuple[np.ndarray, np.ndarray]:
        """Colour (H, W, 3) from 0 to 1 and depth (H, W) in metres, infinite where there is
        nothing.
        """
        self.draw()
        whole = 255.0 if self.colour.dtype == np.uint8 else 1.0
        inverse = 1 / NEAR - self.depth.astype(float) * (1 / NEAR - 1 / FAR)
        return self.colour[..., :3] / whole, np.where(self.depth < 1, 1 / inverse, np.inf)


def clip_from_world(scene: TorusScene) -> np.ndarray:
    """OpenGL's matrix (4, 4): a point of the world to clip space, y down as in the image."""
    (width, height), (fx, fy), (cx, cy) = (
        scene.size,
        scene.focal_length.tolist(),
        scene.principal_point.tolist(),
    )
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 * fx / width, 2 * cx / width - 1
    projection[1, [1, 2]] = 2 * fy / height, 2 * cy / height - 1
    projection[2, 2:] = (FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    projection[3, 2] = 1
    return projection @ camera_from_world(scene)


def camera_from_world(scene: TorusScene) -> np.ndarray:
    """The camera's pose (4, 4), in OpenCV's axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        matrix_from_rotvec(scene.rotation.double()).numpy(),
        scene.translation.double().numpy(),
    )
    return pose


class Mitsuba:
    """The scene in Mitsuba 3 (variant llvm_ad_rgb): the mesh shines in its lit colours, and paths
    end where they hit.

    That is `habitus`' image and leaves Mitsuba the least work: one ray a sample, no lights to look
    for, no indirect edges (`sppi=0`; with them it searches for minutes). Box filter.
    """

    def __init__(self, scene: TorusScene, colours: torch.Tensor, target: np.ndarray):
        self.mi, self.dr = _mitsuba()
        mi = self.mi
        faces = scene.triangles.faces
        properties = mi.Properties()
        shine = {"type": "mesh_attribute", "name": "vertex_color"}
        properties["light"] = mi.load_dict({"type": "area", "radiance": shine})
        properties["surface"] = mi.load_dict(
            {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        )
        mesh = mi.Mesh("torus", len(scene.vertices), len(faces), props=properties)
        mesh.add_attribute("vertex_color", 3, colours.float().numpy().ravel())
        content = mi.traverse(mesh)
        content["vertex_positions"] = scene.vertices.float().numpy().ravel()
        content["faces"] = faces.numpy().astype(np.uint32).ravel()
        content.update()
        self.torus_scene = mi.load_dict(
            {"type": "scene", "mesh": mesh, "sensor": self._sensor(scene)}
        )
        self.parameters = mi.traverse(self.torus_scene)
        self.start = mi.Float(self.parameters["mesh.vertex_positions"])
        self.target = mi.TensorXf(np.ascontiguousarray(target, np.float32))
        self.integrator = mi.load_dict({"type": "prb_projective", "max_depth": 1, "sppi": 0})

    def _sensor(self, scene: TorusScene) -> dict[str, Any]:
        """A camera that looks along z with x to the left and y up, as Mitsuba's do."""
        pose = np.linalg.inv(camera_from_world(scene)) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        film = {
            "type": "hdrfilm",
            "width": scene.size[0],
            "height": scene.size[1],
            "rfilter": {"type": "box"},
        }
        return {
            "type": "perspective",
            "fov": float(
                2 * np.degrees(np.arctan(scene.size[0] / 2 / float(scene.focal_length[0])))
            ),
            "fov_axis": "x",
            "near_clip": NEAR,
            "far_clip": FAR,
            "to_world": self.mi.ScalarTransform4f(pose),
            "film": {
                **film,
                "pixel_format": "rgb",
                "component_format": "float32",
                "sample_border": True,
            },
            "sampler": {"type": "independent"},
        }

    def gradient(self, samples: int, seed: int = 0) -> np.ndarray:
        """Derivatives (V, 3) of the mean squared difference to the target with respect to vertices.

        As in a step of a fit: the vertices are new, so the tree of boxes that rays are traced in is
        built again.
        """
        dr = self.dr
        places = self.mi.Float(self.start)
        dr.enable_grad(places)
        self.parameters["mesh.vertex_positions"] = places
        self.parameters.update()
        image = self.mi.render(
            self.torus_scene, self.parameters, integrator=self.integrator, spp=samples, seed=seed
        )
        dr.backward(dr.mean(dr.square(image - self.target), axis=None))
        return np.array(dr.grad(places)).reshape(-1, 3)

    def picture(self, samples: int) -> np.ndarray:
        """Colour (H, W, 3)."""
        return np.array(self.mi.render(self.torus_scene, integrator=self.integrator, spp=samples))


def _mitsuba() -> tuple[Any, Any]:
    """The modules mitsuba and drjit; Missing where they or LLVM 19 are not there."""
    if importlib.util.find_spec("mitsuba") is None:
        raise Missing("Mitsuba: no module named mitsuba")
    if "DRJIT_LIBLLVM_PATH" not in os.environ and sys.platform == "linux":
        found = sorted(Path("/usr/lib").glob("**/libLLVM*.so.19*"))
        if not found:
            raise Missing("Mitsuba: no LLVM 19 (Debian: libllvm19); name one in DRJIT_LIBLLVM_PATH")
        os.environ["DRJIT_LIBLLVM_PATH"] = str(found[0])
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba, drjit


def _first_line(problem: BaseException) -> str:
    return (str(problem).splitlines() or [type(problem).__name__])[0]


def compare_opengl(scene: TorusScene, colour: np.ndarray, depth: np.ndarray, folder: Path) -> dict:
    """OpenGL's picture against point-sampled `habitus`: colours, depths, and pixels that only one
    of them covers.
    """
    peer = OpenGL(scene, floats=True)
    theirs, metres = peer.picture()
    both = np.isfinite(depth) & np.isfinite(metres)
    _save(folder, "opengl", theirs, colour)
    return {
        "renderer": peer.renderer,
        "pixels_in_one_only": int((np.isfinite(depth) != np.isfinite(metres)).sum()),
        "largest_colour_difference": float(np.abs(theirs[both] - colour[both]).max()),
        "mean_colour_difference": float(np.abs(theirs[both] - colour[both]).mean()),
        "largest_depth_difference_m": float(np.abs(metres[both] - depth[both]).max()),
    }


def compare_mitsuba(
    scene: TorusScene, colours: torch.Tensor, colour: np.ndarray, samples: int, folder: Path
) -> dict:
    """Mitsuba's picture and gradient against antialiased `habitus`."""
    target = forward(moved(scene), colours)[0]
    peer = Mitsuba(scene, colours, target.numpy())
    theirs = peer.picture(samples)
    _save(folder, "mitsuba", theirs, colour)
    ours = vertex_gradient(scene, colours, target)
    halves = [peer.gradient(samples, seed) for seed in (1, 2)]
    mean = (halves[0] + halves[1]) / 2
    pulls = [g.sum(0) for g in (ours, *halves)]
    return {
        "samples": samples,
        "largest_colour_difference": float(np.abs(theirs - colour).max()),
        "mean_colour_difference": float(np.abs(theirs - colour).mean()),
        "cosine_of_vertex_gradients": _cosine(ours, mean),
        "cosine_of_mitsuba_with_itself": _cosine(*halves),
        "gradient_summed": pulls[0].tolist(),
        "gradient_summed_mitsuba": [pull.tolist() for pull in pulls[1:]],
    }


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).sum() / np.linalg.norm(a) / np.linalg.norm(b))


def _save(folder: Path, name: str, theirs: np.ndarray, ours: np.ndarray) -> None:
    save_picture(theirs, folder / f"{name}.png")
    save_picture(10 * np.abs(theirs - ours), folder / f"{name}-difference.png")


def main() -> None:
    """Compare with whoever is there, print a table, write pictures and JSON."""
    from common import in_words, machine, write_json

    arguments = parser(__doc__)
    arguments.add_argument("--samples", type=int, default=64, help="rays a pixel of Mitsuba's")
    arguments.add_argument("--folder", type=Path, default=Path("render_peers"))
    options = arguments.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    where = machine()
    scene = torus_scene()
    colours = scene.colours
    plain, depth = (image.numpy() for image in forward(scene, colours, "none"))
    smooth = forward(scene, colours)[0].numpy()
    save_picture(smooth, options.folder / "habitus.png")
    content: dict[str, Any] = {"machine": where}
    for name, compare in (
        ("opengl", lambda: compare_opengl(scene, plain, depth, options.folder)),
        (
            "mitsuba",
            lambda: compare_mitsuba(scene, colours, smooth, options.samples, options.folder),
        ),
    ):
        try:
            content[name] = compare()
        except Missing as missing:
            content[name] = {"missing": str(missing)}
        table = Table("", "", title=f"{name} against habitus: {in_words(where)}")
        for key, value in content[name].items():
            table.add_row(
                key.replace("_", " "), f"{value:.3g}" if isinstance(value, float) else str(value)
            )
        Console(width=120).print(table)
    write_json(options.folder / "render_peers.json", content)


if __name__ == "__main__":
    main()
