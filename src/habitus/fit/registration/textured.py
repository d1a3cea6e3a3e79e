"""Registered scans of one person made to agree in their colours, where at least two scans have
colours.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from habitus.errors import HabitusError
from habitus.fit.registration.colour_stage import agreeing, colour_difference, shared_skin
from habitus.fit.registration.judge import lost_share
from habitus.fit.registration.model_stage import ModelState
from habitus.fit.registration.nearest import nearest
from habitus.fit.registration.recipe import MATCHED, Registrar
from habitus.fit.registration.result import ScanColours, ScanFit
from habitus.fit.registration.scan import Scan
from habitus.fit.registration.skin_colours import ColourCloud
from habitus.fit.registration.skin_grid import SkinGrid
from habitus.fit.registration.uncut import new_cuts
from habitus.fit.registration.weights import at_rest, vertex_weights

MOST = 200_000
"""Coloured points of a scan that are used."""
PIECES = 4
"""Pieces an edge that the texture is handed out with."""


def with_colours(
    registrar: Registrar, fits: Sequence[ScanFit], scans: Sequence[Scan]
) -> list[ScanFit]:
    """The fits of one person's scans, slid along the skin until colours agree.

    A scan whose colours then differ no less from the others' stays as it was, and says so; so does
    what is no person. Raises HabitusError for fewer than two scans, and for scans without colours.
    """
    check_colours(scans)
    people = [k for k, fit in enumerate(fits) if fit.person]
    if len(people) < 2:
        return list(fits)
    agreed = dict(
        zip(
            people,
            _agreed(registrar, [fits[k] for k in people], [scans[k] for k in people]),
            strict=True,
        )
    )
    return [agreed.get(k, fit) for k, fit in enumerate(fits)]


def _agreed(registrar: Registrar, fits: Sequence[ScanFit], scans: Sequence[Scan]) -> list[ScanFit]:
    """The fits of two scans of people or more."""
    clouds = [_coloured(fit, scan) for fit, scan in zip(fits, scans, strict=True)]
    fitter = registrar.fitter
    poses = np.stack([fit.pose for fit in fits])
    trans = np.stack([fit.trans for fit in fits])
    state = ModelState(np.mean([fit.betas for fit in fits], axis=0), poses, trans)
    before = [fit.vertices for fit in fits]
    state, after = agreeing(fitter, state, [fit.cloud for fit in fits], before, clouds)
    grid = SkinGrid.of(fitter.topology.faces, PIECES)
    skins = [shared_skin(fitter.topology, grid, surfaces, clouds) for surfaces in (before, after)]
    told = [[colour_difference(skin, k) for k in range(len(fits))] for skin in skins]
    found = []
    for k, fit in enumerate(fits):
        colours = ScanColours(
            grid, np.exp(skins[1].tones), skins[1].apart(k), told[0][k], told[1][k]
        )
        if told[1][k] < told[0][k]:
            found.append(_moved(registrar, fit, state.one(k), after[k], colours))
        else:
            said = (
                f"its colours differ from the other scans' by {told[0][k]:.3f} and would by "
                f"{told[1][k]:.3f}: not used"
            )
            found.append(
                replace(fit, colours=replace(colours, after=told[0][k]), notes=(*fit.notes, said))
            )
    return found


def check_colours(scans: Sequence[Scan]) -> None:
    """Raises HabitusError where colours cannot tell anything: one scan, or scans without them."""
    if len(scans) < 2:
        raise HabitusError(
            f"texture was asked for with {len(scans)} scan; expected two of one person or more to "
            "compare"
        )
    plain = [scan.name for scan in scans if scan.colours is None]
    if plain:
        raise HabitusError(
            f"{', '.join(plain)}: no colours; expected colours of vertices or a picture on the "
            "mesh; leave texture out"
        )


def _coloured(fit: ScanFit, scan: Scan) -> ColourCloud:
    """Coloured points in the body's frame; normals are those of the fitted points beside them."""
    assert scan.colours is not None
    places = scan.points if scan.colour_places is None else scan.colour_places
    rows = np.flatnonzero(np.isfinite(places).all(1) & np.isfinite(scan.colours).all(1))
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:MOST]]
    points = places[rows] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    near = cKDTree(fit.cloud.points).query(points)[1]
    return ColourCloud.of(points, fit.cloud.normals[near], scan.colours[rows])


def _moved(
    registrar: Registrar,
    fit: ScanFit,
    state: ModelState,
    surface: Float[np.ndarray, "V 3"],
    colours: ScanColours,
) -> ScanFit:
    """The fit with another state and surface."""
    topology = registrar.fitter.topology
    cloud = fit.cloud
    model = registrar.fitter.vertices(state)
    there, near = (
        nearest(topology, each, cloud.points, cloud.normals) for each in (surface, model)
    )
    to_surface, to_model = (
        np.linalg.norm(cloud.points - each.place, axis=1) for each in (there, near)
    )
    counted = (to_surface < MATCHED) & (np.abs(there.cosine) > 0.3)
    return replace(
        fit,
        betas=state.betas,
        pose=state.pose[0],
        trans=state.trans[0],
        vertices=surface,
        model_vertices=model,
        rest_vertices=at_rest(fit.body, state, surface - model),
        weights=vertex_weights(topology, surface, cloud),
        to_surface=to_surface[counted],
        to_model=to_model[counted],
        far_from_surface=to_surface,
        matched=float(((to_model < MATCHED) & (near.cosine > 0.3)).mean()),
        lost=lost_share(cloud.points, to_surface),
        cuts=new_cuts(topology, model, surface),
        colours=replace(colours, slid=float(np.linalg.norm(surface - fit.vertices, axis=1).mean())),
    )
