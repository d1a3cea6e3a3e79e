"""Bodies, results, motions and scans in the browser: for ``habitus view``."""

import logging
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.up import UP_AXES, up_rotation
from habitus.errors import HabitusError, require_extra
from habitus.fit.registration.scan import Scan
from habitus.io.archives import open_archive
from habitus.io.fits import load_fit
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.io.models.levels import has_levels
from habitus.io.motions import load_motion
from habitus.io.scans import ENDINGS, read_scan
from habitus.report.live.viewer import HOST
from habitus.report.view.panels import BodyPanel, MeshPanel, MotionPanel, play, studio
from habitus.types import PathLike

APART = 1.2  # metres between what is shown side by side
LARGEST = 5.0  # metres: a scan of more is in centimetres, or in millimetres


class View:
    """A page that is being served; ``address`` is where, ``panels`` are what it shows, in the order
    of the sources.
    """

    def __init__(self, server: Any, panels: list[Any]):
        self._server = server
        self.panels = panels
        self._stop = threading.Event()
        self.address = f"http://{HOST}:{server.get_port()}"
        threading.Thread(target=play, args=(panels, self._stop), daemon=True).start()

    def wait(self) -> None:
        """Serve until somebody stops this process or closes the view."""
        self._stop.wait()

    def close(self) -> None:
        """Serve no more."""
        self._stop.set()
        self._server.stop()


def view(
    sources: Sequence[PathLike], *, body: PathLike | None = None, up: str = "+y", port: int = 8080
) -> View:
    """Show body models, results, motions and meshes side by side on a page of this machine.

    sources: "default", "female" or another model that comes along, a model's file, a fit's
    body.npz, a motion (npz), a mesh or a cloud of points. body: what motions are shown on that do
    not name theirs. up: the axis of meshes and clouds that points up. Raises HabitusError for bad
    input, and where viser is not installed.
    """
    if up not in UP_AXES:
        raise HabitusError(f"up is {up!r}; expected one of {', '.join(UP_AXES)}")
    if not sources:
        raise HabitusError("nothing to view; expected a body, a result, a motion or a scan")
    viser = require_extra("viser", "views", "view")
    kinds = [(source, _kind(str(source))) for source in sources]
    loaded = [(kind, Path(source).stem, _LOAD[kind](source, body, up)) for source, kind in kinds]
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a browser that leaves is no error
    server = viser.ViserServer(HOST, port, label="habitus view", verbose=False)
    studio(server)
    return View(
        server,
        [
            _panel(server, kind, name, what, k, len(loaded))
            for k, (kind, name, what) in enumerate(loaded)
        ],
    )


def _kind(source: str) -> str:
    """body, fit, motion or mesh, by name, ending and names inside."""
    if source in SHIPPED or source == "default" or source.endswith(".pkl"):
        return "body"
    if Path(source).suffix.lower() in ENDINGS:
        return "mesh"
    try:
        with open_archive(Path(source)) as archive:
            names = set(archive.names)
    except OSError as error:
        raise HabitusError(
            f"{source}: {error.strerror or error}; expected a body, a result, a motion or a scan"
        ) from error
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    if {"poses", "latent_markers"} <= names:
        return "fit"
    return "motion" if "poses" in names else "body"


def _load_body(source: PathLike, body: PathLike | None, up: str) -> Any:
    return (
        load_body(str(source), detail="full") if has_levels(str(source)) else load_body(str(source))
    )


def _upright(scan: Scan, up: str) -> Scan:
    """A scan in metres, y up."""
    extent = float(np.ptp(scan.points, axis=0).max())
    scale = next((unit for unit in (1.0, 0.01, 0.001) if extent * unit < LARGEST), 0.001)
    return replace(scan, points=scale * scan.points @ up_rotation(up).T)


_LOAD = {
    "body": _load_body,
    "fit": lambda source, body, up: load_fit(source, body),
    "motion": lambda source, body, up: load_motion(source, body),
    "mesh": lambda source, body, up: _upright(read_scan(source), up),
}


def _panel(server: Any, kind: str, name: str, what: Any, k: int, count: int) -> Any:
    node = f"/{k}"
    server.scene.add_frame(
        node, show_axes=False, position=(APART * (k - (count - 1) / 2.0), _floor(kind, what), 0.0)
    )
    if kind == "body":
        return BodyPanel(server, what, node)
    if kind == "mesh":
        return MeshPanel(server, name, what.points, what.faces, node)
    return MotionPanel(server, what, node, what.observed_markers if kind == "fit" else None)


def _floor(kind: str, what: Any) -> float:
    """What lifts a body at rest, or a scan, onto the floor; motions have one of their own."""
    if kind == "body":
        return -float(what().vertices[:, 1].min())
    return -float(np.min(what.points[:, 1])) if kind == "mesh" else 0.0
