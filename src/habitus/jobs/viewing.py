"""Bodies, results, motions and scans in the browser: for ``habitus view``."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError, check_extra
from habitus.fit.markers.result import MarkerFit
from habitus.fit.points.scan import Scan
from habitus.io.models.bodies import load_body
from habitus.io.models.levels import has_levels
from habitus.io.motions.open import is_rig_motion
from habitus.io.people import BodyShape, Mesh, open_person
from habitus.io.scans import ENDINGS, read_scan
from habitus.report.page_server import PageServer, new_token
from habitus.report.panels import BodyPanel, MeshPanel, MotionPanel, play, studio
from habitus.rotations import UP_AXES, up_rotation
from habitus.types import PathLike

SPACING = 1.2  # metres between neighbours on the page
MAX_EXTENT = 5.0  # metres; a larger scan is in centimetres or millimetres


class View:
    """A page that is being served; ``address`` is where, with the token that the page asks for,
    ``panels`` are what it shows, in the order of the sources.
    """

    def __init__(self, server: PageServer, panels: list[Any]):
        self._server = server
        self.panels = panels
        self._stop = threading.Event()
        self.address = server.address
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
    """Show body models, results, motions and meshes side by side on a page of this machine, for
    browsers on this machine that have its whole address.

    sources: "default", "female" or another model that comes along, a model's file, a fit's
    body.npz, a motion (npz), a mesh or a cloud of points. body: what motions are shown on that do
    not name theirs. up: the axis of meshes and clouds that points up. Raises HabitusError for bad
    input, and where viser is not installed.
    """
    if up not in UP_AXES:
        raise HabitusError(f"up is {up!r}; expected one of {', '.join(UP_AXES)}")
    if not sources:
        raise HabitusError("nothing to view; expected a body, a result, a motion or a scan")
    check_extra("viser", "views", "view")
    loaded = [_Shown(Path(source).stem, _opened(source, body, up)) for source in sources]
    server = PageServer(port, "habitus view", new_token())
    studio(server.viser)
    panels = [_panel(server.viser, item, k, len(loaded)) for k, item in enumerate(loaded)]
    return View(server, panels)


@dataclass(frozen=True)
class _Shown:
    """One thing on the page: a body, a motion, a fit or a scan, and its name."""

    name: str
    content: BodyModel | BodyMotion | MarkerFit | Scan

    @property
    def floor(self) -> float:
        """The height (m) that puts a body at rest or a scan on the floor; 0 for motions."""
        content = self.content
        if isinstance(content, BodyModel):
            return -float(np.asarray(content().vertices)[:, 1].min())
        return -float(np.min(content.points[:, 1])) if isinstance(content, Scan) else 0.0


def _opened(
    source: PathLike, body: PathLike | None, up: str
) -> BodyModel | BodyMotion | MarkerFit | Scan:
    path = Path(source)
    if path.suffix.lower() in ENDINGS and not is_rig_motion(path):
        return _upright(read_scan(source), up)
    person = open_person(source, body)
    assert not isinstance(person, Mesh)  # its endings are among those of scans
    if isinstance(person, BodyModel) and has_levels(str(source)):
        return load_body(str(source), detail="full")
    return person.standing() if isinstance(person, BodyShape) else person


def _upright(scan: Scan, up: str) -> Scan:
    """A scan in metres, y up."""
    extent = float(np.ptp(scan.points, axis=0).max())
    scale = next((unit for unit in (1.0, 0.01, 0.001) if extent * unit < MAX_EXTENT), 0.001)
    return replace(scan, points=scale * scan.points @ up_rotation(up).T)


def _panel(server: Any, item: _Shown, k: int, count: int) -> Any:
    node = f"/{k}"
    content = item.content
    server.scene.add_frame(
        node, show_axes=False, position=(SPACING * (k - (count - 1) / 2.0), item.floor, 0.0)
    )
    if isinstance(content, BodyModel):
        return BodyPanel(server, content, node)
    if isinstance(content, Scan):
        return MeshPanel(server, item.name, content.points, content.faces, node)
    markers = content.observed_markers if isinstance(content, MarkerFit) else None
    return MotionPanel(server, content, node, markers)
