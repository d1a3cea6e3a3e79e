"""Constants of the agreement of scans' colours."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ScanColourSettings:
    """Agreement of the colours of several scans; chosen by benchmarks/register_textures.py. Metres,
    linear light.
    """

    dark: float = 0.004
    """Light below which all is black."""
    noise: float = 0.008
    """Sd of a camera's pixels."""
    certain: float = 0.1
    """Noise of a tone (logarithm of colour) at which its weight is a half."""
    scale: float = 0.006
    """Geman-McClure's, of coloured points from the surface."""
    min_cosine: float = 0.4
    smoothings: int = 3
    """Times that the texture is averaged over neighbouring nodes."""
    noise_weight: float = 0.1
    """Weight of a coloured point from which on it counts for the noise of tones."""
    outlier_spreads: float = 3.0
    """Noises of tones off the texture at which a point weighs a quarter."""
    light_rounds: int = 3
    """Alternations of light and texture."""
    light_ridge: float = 0.01
    """Weight of no light at all against that of all points."""
    gain_pieces: int = 2
    """Pieces an edge of the grid for the gain (shadows, light from skin beside), which no harmonic
    explains."""
    gain_smoothings: int = 20
    """Times that the gain is averaged over neighbouring nodes."""
    passes: int = 2
    """Passes of Barnes' scheme (1964): the first takes means around a node, each further one adds
    means of what the ones before left."""
    min_points: float = 0.1
    """Coloured points a node from which on its tone counts."""
    min_share: float = 0.6
    """Coloured points a node, as a share of other scans', from which on its tone counts."""
    compared: float = 0.5
    """Confidence of a tone, 0..1, from which on it is compared with another scan's."""
    grain: float = 22.0
    """Pieces of the grid that share one independent tone after ``smoothings``; closer rows share
    its weight."""
    max_points: int = 200_000
    pieces: int = 4
    """Pieces an edge of the texture that is returned."""
    slide_sd: float = 0.001
    """Metres (sd) by which a surface slides along the skin beside the model's motion."""
    slide_range: float = 0.12
    """Metres at which the correlation of two such slides is 0.14."""
    skin_slide_sd: float = 0.002
    """Metres (sd) by which the model's skin slides on the person's, whatever its pose."""
    effective_points: float = 1500.0
    """All coloured points of a scan count as so many for the model."""
    model_points: int = 15_000
    surface_points: int = 60_000
    coarse: tuple[int, ...] = (2, 4)
    """Pieces an edge of the grids for pose and shape, pass by pass."""
    fine: tuple[int, ...] = (4, 4)
    """Pieces an edge of the grids for surfaces, pass by pass."""


SCAN_COLOURS = ScanColourSettings()
