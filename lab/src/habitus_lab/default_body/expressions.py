"""Expression: ten components of MakeHuman's expression units, the jaw's own turn taken out first.

There are 34 units for each of three ethnicities, nearly alike, so they are averaged. `mouth-open`
turns the jaw, which is a joint here: the turn that explains it best is subtracted. Components are
principal directions of random mixes of units about the neutral face; one unit of a coefficient is
one standard deviation of such mixes. Units come in left and right pairs, so each component is
symmetric or antisymmetric.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from .sliders import RACES
from .sources import Source, read_target

COMPONENTS = 10
MIX = 12**-0.5  # standard deviation of a unit's weight, drawn evenly from 0..1
JAW_UNIT = "mouth-open"
WIDEST = 0.6  # rad


def expression_units(source: Source, base: np.ndarray) -> dict[str, np.ndarray]:
    """Unit -> offsets (V, 3) in metres at full strength, averaged over ethnicities, over the
    vertices `base` (V,).
    """
    folder = source.folder / "targets" / "expression" / "units"
    names = sorted(
        path.name.removesuffix(".target.gz") for path in (folder / RACES[0]).glob("*.target.gz")
    )
    count = len(source.vertices)
    return {
        name: np.mean(
            [read_target(folder / race / f"{name}.target.gz", count)[base] for race in RACES],
            axis=0,
        )
        for name in names
    }


def without_jaw(
    units: dict[str, np.ndarray], vertices: np.ndarray, pivot: np.ndarray, jaw: np.ndarray
) -> tuple[dict[str, np.ndarray], float]:
    """Units with the jaw's turn taken out of `mouth-open`, and that turn (rad, downward).

    vertices (V,3) at rest, pivot (3,) the jaw's joint, jaw (V,) its skinning weights.
    """

    def turned(angle: float) -> np.ndarray:
        c = np.cos(angle)
        s = np.sin(angle)
        arm = vertices - pivot
        moved = np.stack(
            [arm[:, 0], c * arm[:, 1] - s * arm[:, 2], s * arm[:, 1] + c * arm[:, 2]], 1
        )
        return jaw[:, None] * (moved - arm)

    wide = units[JAW_UNIT]
    best = minimize_scalar(
        lambda a: float(((wide - turned(a)) ** 2).sum()), bounds=(0, WIDEST), method="bounded"
    )
    return units | {JAW_UNIT: wide - turned(best.x)}, float(best.x)


def expression_components(
    units: dict[str, np.ndarray], mirror: np.ndarray
) -> tuple[np.ndarray, float]:
    """Components (V, 3, 10) and their share of the variance of random mixes."""
    table = np.stack(list(units.values())) * MIX
    twins = table[:, mirror] * [-1.0, 1.0, 1.0]
    both = np.concatenate([table, twins]).reshape(2 * len(table), -1) * 2**-0.5
    values, sides = np.linalg.eigh(both @ both.T)
    values = values[::-1]
    sides = sides[:, ::-1][:, :COMPONENTS]
    dirs = (sides.T @ both).reshape(COMPONENTS, len(mirror), 3)
    dirs = _pure(dirs, mirror)
    largest = np.abs(dirs.reshape(COMPONENTS, -1)).argmax(1)
    sign = np.sign(dirs.reshape(COMPONENTS, -1)[np.arange(COMPONENTS), largest])
    return (dirs * sign[:, None, None]).transpose(1, 2, 0), float(
        values[:COMPONENTS].sum() / values.sum()
    )


def _pure(dirs: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Components (K,V,3) freed from rounding: each exactly symmetric or exactly antisymmetric."""
    twins = dirs[:, mirror] * [-1.0, 1.0, 1.0]
    sign = np.sign((dirs * twins).sum((1, 2)))
    return 0.5 * (dirs + sign[:, None, None] * twins)
