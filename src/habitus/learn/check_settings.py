"""Settings of the checks before training (`habitus.learn.checks`, `habitus.learn.findings`).

Edges and extents are shares of the template's. Chosen by hand on planted faults, so that sound
registrations pass.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckSettings:
    """From where on something is wrong with a template, or with registrations of it."""

    max_pieces: float = 0.1
    """Connected pieces beyond one a part, as a share of the vertices: no segmentation of a body has
    as many."""
    min_stray: int = 3
    """Vertices of a part among parts far from it that are worth a warning."""
    kin: int = 2
    """Bones between joints whose parts may touch."""
    max_holes: float = 0.5
    """Share of a registration's vertices."""
    min_size: float = 1e-6
    """Edge and extent below which vertices lie in a point or on a line."""
    edge: tuple[float, float] = (0.22, 2.2)
    """Mean edge beyond which, with a small strain, the unit is another than metres: people differ
    by less than a factor of two from a template."""
    unit_ratio: float = 1.6
    """Factor from the size of a known unit within which that unit is named."""
    max_strain: float = 0.4
    """Mean change of edges against the template's, of any pose and person."""
    max_short: float = 0.05
    """Share of edges that are collapsed."""
    max_long: float = 0.01
    """Share of edges over 5 times as long."""
    edge_over_extent: float = 2.0
    """Mean edge over extent from which on vertices are in another order."""
    max_mirrored: float = 0.6
    """Share of parts that fit better as mirror images."""
    aligned: float = 0.7
    """Length of the mean direction of up and front from which on registrations stand alike,"""
    axis_deg: float = 20.0
    """and degrees from an axis within which they stand along it."""
    min_poses: int = 5
    """Registrations of the pose set that bend a joint, at least,"""
    bent_deg: float = 15.0
    """by so many degrees from their mean."""
    same: float = 2e-5
    """Of edges' lengths: copies in single precision that stand metres apart differ by less."""
    spread_quantile: float = 0.75
    """Of the differences of builds (logarithms of edges) within subjects: their spread is this,"""
    spread_factor: float = 1.5
    """times this,"""
    min_spread: float = 0.002
    """and at least this: of rounding and skinning."""
    max_spreads: float = 10.0
    """Spreads that one length counts for, at most: a swollen part says nothing of the person."""
    far: float = 1.8
    """Distance from the own subject's build over the median one, from which on a registration may
    be mislabelled,"""
    near: float = 0.6
    """if its distance to another subject's build is this share of it, or less."""
    many_rows: int = 20
    """Registrations of a subject beyond which a single one does not move its median."""


CHECKS = CheckSettings()
