"""Reads what SAM 3D Body says of the frames of a video: a capture of points on the skin.

Each .npz holds one person of one picture: ``pred_vertices`` (18439, 3) of MHR's mesh in the
camera's frame (m; x right, y down, z away), without its place ``pred_cam_t``. Some vertices of our
body lie on triangles of that mesh (assets/mhr_points.npz, of MHR, Apache-2.0): they are the markers
of the capture, and `habitus.Mosh` does the rest.

Every picture is a guess of its own: sizes drift, and the depth trembles. Points are scaled to the
size that the person has in most frames, by the distances within their bones, and depth is smoothed.
"""

from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.io.archives import open_archive
from habitus.io.captures.read import Capture
from habitus.io.limits import check_count
from habitus.io.names import numeric_order, plain_name
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.types import PathLike

MAX_FRAMES = 100_000
DEPTH_SECONDS = 0.25
"""Over which depth is smoothed (sd)."""
SPREAD = 0.005
"""Metres (sd) that a point of the mesh lies off its place on our skin."""
NOTE = (
    "From single pictures: the distance from the camera, and turns towards it, are the network's "
    "guesses."
)


class MeshPoints(NamedTuple):
    """Vertices of our body, and where they lie on a mesh: corners and barycentric coordinates."""

    vertices: Int[np.ndarray, " M"]
    corners: Int[np.ndarray, "M 3"]
    barycentric: Float[np.ndarray, "M 3"]
    mesh_vertices: int

    def on(self, mesh: Float[np.ndarray, "T V 3"]) -> Float[np.ndarray, "T M 3"]:
        """The points of meshes."""
        return np.einsum("tmkc,mk->tmc", mesh[:, self.corners], self.barycentric)


@cache
def mhr_points() -> MeshPoints:
    """Those of MHR's mesh (Apache-2.0)."""
    with (
        (files("habitus.assets") / "mhr_points.npz").open("rb") as stream,
        np.load(stream, allow_pickle=False) as file,
    ):
        return MeshPoints(
            file["vertices"].astype(np.int64),
            file["corners"].astype(np.int64),
            file["barycentric"].astype(float),
            int(file["mesh_vertices"]),
        )


def skin_layout(points: MeshPoints, body: BodyModel) -> MarkerLayout:
    """The points as markers on the skin of our body."""
    markers = tuple(
        Marker(f"p{vertex}", vertex=int(vertex), distance=0.0, distance_spread=SPREAD,
               place_spread=SPREAD)
        for vertex in points.vertices
    )  # fmt: skip
    return MarkerLayout(
        "mhr", markers, title="Points of MHR's mesh", num_vertices=body.num_vertices
    )


def read_sam3d(
    folder: PathLike, rate_hz: float, body: BodyModel, scale: float = 1.0
) -> tuple[Capture, MarkerLayout]:
    """The frames of a folder as a capture (y up; m), and the layout of its points.

    body: whose skin they lie on, of the bundled bodies' topology. scale: of all lengths.
    Raises HabitusError with the file named.
    """
    path = Path(folder)
    if not 0.0 < rate_hz < 1e5:
        raise HabitusError(f"the frame rate is {rate_hz!r}; expected frames a second (--fps)")
    paths = sorted(path.glob("*.npz"), key=lambda p: numeric_order(p.name))
    if not paths:
        raise HabitusError(f"{path}: holds no .npz; expected SAM 3D Body's output, a file a frame")
    check_count(len(paths), MAX_FRAMES, f"{path}: frames")
    points = mhr_points()
    if int(points.vertices.max()) >= body.num_vertices:
        raise HabitusError(f"{body.name} has another topology; expected one of the bundled bodies")
    read = [_frame(one, points) for one in paths]
    at = np.stack([points_here for points_here, _ in read])
    place = np.stack([place_here for _, place_here in read])
    at, drift = same_size(at, body.strongest_joint[points.vertices])
    place = place * drift[:, None]
    place[:, 2] = gaussian_filter1d(place[:, 2], DEPTH_SECONDS * rate_hz, mode="nearest")
    markers = scale * (at + place[:, None]) * [1.0, -1.0, -1.0]
    layout = skin_layout(points, body)
    notes = []
    if (spread := float(np.ptp(drift))) > 0.02:
        notes.append(f"sizes of the person differ by {100 * spread:.0f} % between frames")
    name = plain_name(path.resolve().name)
    capture = Capture(
        name, layout.labels, markers, rate_hz, "+y", warnings=tuple(notes), doubts=(NOTE,)
    )
    return capture, layout


def _frame(path: Path, points: MeshPoints) -> tuple[np.ndarray, np.ndarray]:
    """Points of one picture, and the person's place in the camera's frame."""
    try:
        with open_archive(path) as archive:
            mesh = np.asarray(archive.read("pred_vertices"), float)
            place = np.asarray(archive.read("pred_cam_t"), float)
    except (OSError, KeyError, HabitusError) as error:
        raise HabitusError(
            f"{path}: {shown(error, 120)}; expected pred_vertices and pred_cam_t of SAM 3D Body"
        ) from error
    if mesh.shape != (points.mesh_vertices, 3) or place.shape != (3,):
        raise HabitusError(
            f"{path}: pred_vertices {mesh.shape}, pred_cam_t {place.shape}; expected "
            f"({points.mesh_vertices}, 3) and (3,): one person a file"
        )
    if not (np.isfinite(mesh).all() and np.isfinite(place).all()) or np.abs(mesh).max() > 1e3:
        raise HabitusError(f"{path}: numbers that are none; expected metres")
    return points.on(mesh[None])[0], place


def same_size(
    points: Float[np.ndarray, "T M 3"], bone: Int[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, " T"]]:
    """Points scaled to the size of the median frame, and the factors: by the spread of the points
    of each bone, which poses hardly change.
    """
    size = np.zeros(len(points))
    for joint in np.unique(bone):
        own = points[:, bone == joint]
        if own.shape[1] > 2:
            size += np.sqrt(((own - own.mean(1, keepdims=True)) ** 2).sum((1, 2)))
    factor = np.median(size) / np.maximum(size, 1e-9)
    return points * factor[:, None, None], factor
