"""Weights, stages and limits of the fit to depth views, with where each number comes from."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """Some Gauss-Newton steps: what moves ("place", "pose" or "all"), how pixels find the surface,
    how fine.

    matching: "nearest" (the surface point nearest in space) or "pixel" (the one at the same pixel).
    stride: of pixels in both directions. reach: metres at which a pixel counts a quarter
    (Geman-McClure's scale), at the first step and the last: the robust norm of T eq. 4.5, whose
    loss ends below the absolute value.
    """

    moves: str
    matching: str
    steps: int
    stride: int
    reach: tuple[float, float]


STAGES = (
    Stage("place", "nearest", 3, 4, (0.15, 0.15)),
    Stage("pose", "nearest", 4, 4, (0.15, 0.10)),
    Stage("all", "nearest", 2, 4, (0.10, 0.08)),
    Stage("all", "pixel", 3, 4, (0.08, 0.06)),
    Stage("all", "pixel", 6, 2, (0.06, 0.03)),
)
"""Nearest points forgive a start that is off but shrink girths under noise; the same pixel is
unbiased near it.
"""

STIFF = (
    "knee",
    "spine1",
    "spine2",
    "spine3",
    "collar",
    "wrist",
    "foot",
    "ankle",
    "hand",
    "head",
    "neck",
)


FOLDED = (70.0, 95.0, 50.0)
"""Forearms before the belly."""


@dataclass(frozen=True)
class RgbdSettings:
    """What the fit weighs (T 4.6.1). Metres and radians.

    depth: E_D's share of each full-size pixel's certainty, as neighbouring pixels err alike. shape,
    pose: of E_S (a beta of 1) and E_P, whose spreads are ``pose_sd`` and, of joints that hardly
    bend when people stand, ``stiff_sd``. outline: of pixels of the model before background that was
    seen. colour: E_C's share of each full-size pixel's certainty; rim: times that, where the
    surface turns away; colour_levels: full-size pixels along the side of one of the pyramid's, for
    each step with colour. floor, floor_sd: E_F. slide: share of point to point while the nearest
    point is sought. noise: sd of depth over its square, where the views do not tell it; model_sd:
    what no body of the model explains. skin: spread of the skin's offset from the model, in
    `registration.offset_stage`'s; skin_reach: metres from where on it is alike no more;
    skin_places: how many values tell it; skin_depth: E_D's share once the offset explains what
    neighbours have in common; skin_steps: by depth, before those with colour. clothes, hair: metres
    that tight clothes and flat hair under a cap lie on the skin, which are taken off. arms, turns:
    tried at the start: how arms are held, in degrees (below the level, bent at the elbow, turned
    inwards about the upper arm), and how far the person is turned from facing the camera.
    """

    stages: tuple[Stage, ...] = STAGES
    depth: float = 0.02
    shape: float = 1.0
    pose: float = 2.0
    pose_sd: float = 0.2
    stiff_sd: float = 0.1
    outline: float = 0.2
    outline_sd: float = 0.01
    colour: float = 0.02
    rim: float = 3.0
    colour_levels: tuple[int, ...] = (4, 4, 2, 2)
    floor: float = 2.0
    floor_sd: float = 0.01
    slide: float = 0.1
    noise: float = 1.5e-3
    model_sd: float = 0.003
    arms: tuple[tuple[float, float, float], ...] = (
        (10.0, 0.0, 0.0),
        (45.0, 0.0, 0.0),
        (72.0, 0.0, 0.0),
        FOLDED,
    )
    skin: float = 0.75
    skin_reach: float = 0.19
    skin_places: int = 120
    skin_depth: float = 0.1
    skin_steps: int = 4
    clothes: float = 0.001
    hair: float = 0.003
    turns: tuple[float, ...] = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)


STANDARD = RgbdSettings()
