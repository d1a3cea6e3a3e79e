"""A folder of a few short captures of two people, and hasty fits of them."""

from pathlib import Path

import numpy as np
import pytest
from planted import motion, person, plant

from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.jobs.archive.run import Archive, archive
from habitus.jobs.mosh import Mosh

NAMES = ("ann/one", "ann/two", "ann/three", "ann/four", "bob/walk")
HASTY = MoshSettings(annealing=(10.0,), frames=3)
OPTIONS = {"layout": "cmu-41", "soft_tissue": "none", "settings": HASTY}
RECIPE = Mosh(**OPTIONS)
FRAMES = 8


def write(folder: Path, name: str, seed: int, frames: int = FRAMES) -> Path:
    """A capture: ann's share her shape, bob has his own."""
    betas = (1.2, -0.8, 0.6, -1.0) if name.startswith("ann") else (-1.0, 0.5, -0.4, 0.8)
    planted = plant(betas=betas, seed=seed, states=motion(frames, seed, share=0.3))
    path = folder / f"{name}.c3d"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_c3d(
        Capture(path.stem, planted.layout.labels, np.array(planted.observed), 30.0, "+y"), path
    )
    return path


def write_all(folder: Path) -> Path:
    """All of them."""
    for seed, name in enumerate(NAMES):
        write(folder, name, seed)
    return folder


def made(folder: Path, out: Path, **more) -> Archive:
    """The archive of the folder, in this process, by fits of few betas that are quick and bad."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("habitus.jobs.archive.tasks.fitted_body", lambda *words: person())
        return archive(folder, out, **OPTIONS | {"workers": 1, "minimal": True} | more)


def arrays(out: Path) -> dict[str, np.ndarray]:
    """All that was found, by capture and name."""
    found = {}
    for path in sorted(out.rglob("body.npz")):
        with np.load(path) as file:
            found |= {f"{path.parent.relative_to(out)}: {name}": file[name] for name in file.files}
    return found
