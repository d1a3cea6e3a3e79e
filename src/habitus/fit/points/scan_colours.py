"""Surfaces of one person's registered scans moved along the skin until their colours agree, where
at least two scans have colours (the appearance term of Bogo, Romero, Loper, Black, *FAUST*, 2014).

    sum_pc w_p (grad T_c . u(b_p) - (T_c - tone_pc))^2 / s_c^2 + u^T Q u,    x = x_0 + u

x_0 is the surface that geometry found, u (V, 3) how far it slides from there along itself, Q a
Matern field's precision: slides are alike over a limb. Coarse to fine, the texture built anew each
time, first with pose and shape, then the surface alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import bsr_array, csc_array, csr_array, eye_array, kron
from scipy.spatial import KDTree

from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.offsets import factored, field_precision
from habitus.fit.points.correspondences import Topology, vertex_weights
from habitus.fit.points.free_surface import free_surface, new_cuts, uncut
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_colour_settings import ScanColourSettings
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_result import ScanColours, ScanFit
from habitus.fit.points.scan_states import at_rest
from habitus.fit.points.scans import Registrar, compared
from habitus.fit.points.settings import SCANS, ScanSettings
from habitus.fit.points.skin_colours import (
    ColourCloud,
    ColourMatch,
    Places,
    SharedSkin,
    SkinGrid,
    colour_matches,
    find_skin,
)
from habitus.fit.verdict import vertex_parts
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations


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
    fitter = registrar.fitter
    settings = fitter.settings.colours
    clouds = [_coloured(fit, scan, settings) for fit, scan in zip(fits, scans, strict=True)]
    poses = np.stack([fit.pose for fit in fits])
    trans = np.stack([fit.trans for fit in fits])
    state = BodyState(np.mean([fit.betas for fit in fits], axis=0), poses, trans)
    before = [fit.vertices for fit in fits]
    state, after = agreeing(fitter, state, [fit.cloud for fit in fits], before, clouds)
    grid = SkinGrid.of(fitter.topology.faces, fitter.settings.colours.pieces)
    skins = [shared_skin(fitter.topology, grid, surfaces, clouds) for surfaces in (before, after)]
    differences = [[colour_difference(skin, k) for k in range(len(fits))] for skin in skins]
    agreed = []
    for k, fit in enumerate(fits):
        colours = ScanColours(
            grid, np.exp(skins[1].tones), skins[1].apart(k), differences[0][k], differences[1][k]
        )
        if differences[1][k] < differences[0][k]:
            agreed.append(_moved(registrar, fit, state[k : k + 1], after[k], colours))
        else:
            note = (
                f"its colours differ from the other scans' by {differences[0][k]:.3f} and would by "
                f"{differences[1][k]:.3f}: not used"
            )
            agreed.append(
                replace(
                    fit, colours=replace(colours, after=differences[0][k]), notes=(*fit.notes, note)
                )
            )
    return agreed


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


def _coloured(fit: ScanFit, scan: Scan, settings: ScanColourSettings) -> ColourCloud:
    """Coloured points in the body's frame; normals are those of the fitted points beside them."""
    assert scan.colours is not None
    places = scan.points if scan.colour_places is None else scan.colour_places
    rows = np.flatnonzero(np.isfinite(places).all(1) & np.isfinite(scan.colours).all(1))
    rows = rows[np.random.default_rng(0).permutation(len(rows))[: settings.max_points]]
    points = places[rows] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    near = KDTree(fit.cloud.points).query(points)[1]
    return ColourCloud.of(points, fit.cloud.normals[near], scan.colours[rows], settings)


def _moved(
    registrar: Registrar,
    fit: ScanFit,
    state: BodyState,
    surface: Float[np.ndarray, "V 3"],
    colours: ScanColours,
) -> ScanFit:
    """The fit with another state and surface."""
    topology = registrar.fitter.topology
    cloud = fit.cloud
    model = registrar.fitter.vertices(state)
    return replace(
        fit,
        betas=state.betas,
        pose=state.pose[0],
        trans=state.trans[0],
        vertices=surface,
        model_vertices=model,
        rest_vertices=at_rest(fit.body, state, surface - model),
        weights=vertex_weights(topology, surface, cloud, registrar.fitter.settings.surface),
        **compared(registrar.fitter, cloud, surface, model),
        cuts=new_cuts(topology, model, surface, vertex_parts(fit.body)),
        colours=replace(colours, slid=float(np.linalg.norm(surface - fit.vertices, axis=1).mean())),
    )


def agreeing(
    fitter: ScanFitter,
    state: BodyState,
    clouds: Sequence[Cloud],
    surfaces: Sequence[Float[np.ndarray, "V 3"]],
    coloured: Sequence[ColourCloud],
) -> tuple[BodyState, list[Float[np.ndarray, "V 3"]]]:
    """Pose and shape, then surfaces (m), of two scans or more whose colours agree, from where
    geometry has them.
    """
    now = list(surfaces)
    settings = fitter.settings.colours
    topology = fitter.topology
    places = Places.of(now[0], topology.faces, settings.surface_points)
    some = Places.of(now[0], topology.faces, settings.model_points)
    for n in settings.coarse:
        skin = shared_skin(topology, SkinGrid.of(topology.faces, n), now, coloured, settings)
        models = [fitter.vertices(state, k) for k in range(len(clouds))]
        matches = [_for_model(skin, k, some, models[k]) for k in range(len(clouds))]
        fit = fitter.fit_with_offsets(state, clouds, fitter.settings.all_offset_stages[1:], matches)
        state = fit.state
        now = list(fit.surfaces)
    base = [
        free_surface(
            topology,
            fitter.vertices(state, k),
            clouds[k].first(fitter.settings.surface.points),
            fitter.settings.surface,
            start=now[k],
        )
        for k in range(len(clouds))
    ]
    now = base
    for n in settings.fine:
        skin = shared_skin(topology, SkinGrid.of(topology.faces, n), now, coloured, settings)
        matches = [
            colour_matches(skin, k, places, now[k], settings.skin_slide_sd)
            for k in range(len(clouds))
        ]
        now = [
            slid(topology, base[k], clouds[k], matches[k], fitter.settings)
            for k in range(len(clouds))
        ]
    return state, [
        uncut(topology, fitter.vertices(state, k), surface) for k, surface in enumerate(now)
    ]


def colour_difference(skin: SharedSkin, k: int) -> float:
    """What the tones of scan k typically differ by from the others' where both are seen."""
    differences = skin.apart(k)
    return (
        float(1.4826 * np.median(differences[differences > 0.0]))
        if (differences > 0.0).any()
        else 0.0
    )


def shared_skin(
    topology: Topology,
    grid: SkinGrid,
    surfaces: Sequence[Float[np.ndarray, "V 3"]],
    coloured: Sequence[ColourCloud],
    settings: ScanColourSettings = SCANS.colours,
) -> SharedSkin:
    """The texture of all scans where their surfaces are now."""
    matches = [
        ColourMatch.of(topology, *each, settings) for each in zip(surfaces, coloured, strict=True)
    ]
    return find_skin(grid, coloured, matches, settings)


def _for_model(skin: SharedSkin, k: int, places: Places, model: np.ndarray) -> PointObservations:
    matches = colour_matches(skin, k, places, model, skin.settings.skin_slide_sd)
    share = np.sqrt(min(1.0, skin.settings.effective_points / len(places.face)))
    return PointObservations(
        matches.face, matches.barycentric, matches.target, share * matches.directions
    )


def slid(
    topology: Topology,
    base: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    along: PointObservations,
    settings: ScanSettings = SCANS,
) -> Float[np.ndarray, "V 3"]:
    """A surface slid along itself to where colours would have it, then put on the scan again along
    its normals.

    ``base`` is where geometry had it. Slides have no part across the skin: what a scan says of its
    own place must not be made good by sliding.
    """
    across = _across(topology, base)
    colours = settings.colours
    spread = np.full(len(base), colours.slide_sd)
    field = field_precision(topology.faces, base, spread, colours.slide_range)
    rows, residuals = _rows(topology, along, base)
    rows = csr_array(rows @ across)
    matrix = rows.T @ rows + across.T @ kron(field, eye_array(3), format="csc") @ across
    moved = base + (across @ factored(csc_array(matrix)).solve(rows.T @ residuals)).reshape(-1, 3)
    surface = settings.surface
    return free_surface(topology, moved, cloud.first(surface.points), surface, surface.stages[-1:])


def _across(topology: Topology, base: np.ndarray) -> csr_array:
    """From two numbers a vertex to its slide (3 V, 2 V): two unit directions on the skin."""
    normal = vertex_normals(base, topology.faces)
    one = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12)
    blocks = np.stack([one, np.cross(normal, one)], 2)
    numbers = np.arange(len(base) + 1)
    return csr_array(
        bsr_array((blocks, numbers[:-1], numbers), shape=(3 * len(base), 2 * len(base)))
    )


def _rows(
    topology: Topology, matches: PointObservations, base: np.ndarray
) -> tuple[csr_array, Float[np.ndarray, " R"]]:
    """Rows (P D, 3 V) of directions by vertices, and what they should be beyond the base's."""
    count, directions = matches.directions.shape[:2]
    blocks = matches.barycentric[:, None, :, None] * matches.directions[:, :, None, :]
    corners = topology.faces[matches.face]
    ends = np.arange(0, 3 * count * directions + 1, 3)
    table = (blocks.reshape(-1, 1, 3), np.repeat(corners, directions, axis=0).ravel(), ends)
    rows = csr_array(bsr_array(table, shape=(count * directions, 3 * len(base))))
    place = np.einsum("pk,pkc->pc", matches.barycentric, base[corners])
    return rows, np.einsum("pdc,pc->pd", matches.directions, matches.target - place).ravel()
