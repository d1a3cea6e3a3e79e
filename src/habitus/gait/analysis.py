"""A gait analysis: angles, events, strides, contacts with force plates, the residual of Newton's
equation and the moments and powers of the legs' joints.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from habitus.body.anatomical_angles import AngleTable, segment_rotations, world_rotations
from habitus.body.anatomy import SIDES, Anatomy
from habitus.body.motion import Moving
from habitus.body.segments import FROM_VOLUME, SegmentMasses
from habitus.body.skinning import descends
from habitus.errors import HabitusError
from habitus.gait.contacts import Contact, ForcePlate, find_contacts
from habitus.gait.cycles import Stride, strides
from habitus.gait.dynamics import (
    GRAVITY,
    MOTION_HZ,
    GroundForces,
    Loads,
    angular_velocity,
    ground_forces,
    joint_moment,
    loads,
    residual,
)
from habitus.gait.events import FootEvents, motion_events
from habitus.rotations import up_rotation

SOLE = ("heel", "hallux", "toe_tip", "mt1_head", "mt2_head", "mt5_head")
"""Landmarks of a sole; the first and the third give events."""
SAME_EVENT = 0.15
"""Seconds between an event of the motion and the same event of a plate or of the file."""
JOINTS = (
    ("hip", "thigh", "hip", ("extension", "abduction", "external_rotation")),
    ("knee", "shank", "hip", ("extension", "abduction", "external_rotation")),
    ("ankle", "foot", "knee", ("plantarflexion", "eversion", "external_rotation")),
)
"""Joint, segment below it, joint with which its centre moves, and how its moments are called about
Z, X and Y."""
EXTENDS = {"hip": -1.0, "knee": 1.0, "ankle": -1.0}
"""Sign of a turn of the lower segment about Z, to the right, that extends the joint."""
MAX_RESIDUAL = 0.05
"""Share of the body weight up to which the forces of plates and those that the motion needs agree
(mean over the frames all of whose contacts are on plates)."""
MAX_LACK, LACK_SHARE = 0.12, 0.25
"""Share of the body weight by which a plate lacks force, in more than this share of the frames in
which its foot bears the person alone, from which on a contact is partial."""
MIN_FRAMES = 3
MIN_WEIGHED = 1.0
"""Seconds with all contacts on plates, from which on they weigh a person of unknown mass,"""
MAX_VOLUME_ERROR = 0.15
"""up to this difference from the mass by volume."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """What moves: loads of the body's parts, rotations of joints from rest, and joints (m)."""

    loads: Loads
    turns: Float[np.ndarray, "T J 3 3"]
    joints: Float[np.ndarray, "T J 3"]


@dataclass(frozen=True, eq=False)
class Curves:
    """Numbers over time: values (T, N) in columns ``names`` with their ``units``, NaN where there
    is none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "T N"]


@dataclass(frozen=True, eq=False)
class GaitAnalysis:
    """What a walk was. angles: by a convention; events of each foot; strides; contacts: loads on
    plates, refused ones with the reason; masses: of the body's parts; residual (T, 3): force (N) of
    the plates beyond what the motion needs, NaN in frames whose contacts are not all on plates;
    dynamics: moments (Nm/kg) and powers (W/kg) of the legs' joints, and ground forces (N/kg).
    centres_mm: of the hips from Harrington's regression. motion, plates: what was analysed.
    """

    name: str
    rate_hz: float
    angles: AngleTable
    events: Mapping[str, FootEvents]
    strides: tuple[Stride, ...]
    contacts: tuple[Contact, ...]
    masses: SegmentMasses
    residual: Float[np.ndarray, "T 3"]
    dynamics: Curves
    up: Float[np.ndarray, "3"]
    centres_mm: Mapping[str, float]
    motion: Moving
    plates: tuple[ForcePlate, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def weight(self) -> float:
        """Body weight (N)."""
        return GRAVITY * self.masses.total

    @property
    def residual_share(self) -> float | None:
        """Mean size of the residual as a share of the body weight; None without such frames."""
        known = self.residual[np.isfinite(self.residual).all(1)]
        return float(np.linalg.norm(known, axis=1).mean() / self.weight) if len(known) else None

    @property
    def vertical_bias(self) -> float | None:
        """Mean vertical residual as a share of the body weight: a mass, or a plate's zero, that is
        off; None without such frames.
        """
        known = self.residual[np.isfinite(self.residual).all(1)]
        return float((known @ self.up).mean() / self.weight) if len(known) else None


def analyse(
    moving: Moving,
    anatomy: Anatomy,
    angles: AngleTable,
    masses: SegmentMasses,
    plates: Sequence[ForcePlate] = (),
    file_events: Mapping[str, FootEvents] | None = None,
    notes: Sequence[str] = (),
) -> GaitAnalysis:
    """The analysis of a motion, with force plates and a file's events where there are such. Raises
    HabitusError for fewer frames than accelerations need.
    """
    if moving.num_frames < MIN_FRAMES:
        raise HabitusError(
            f"{moving.capture_name}: {moving.num_frames} frame(s); a gait analysis needs "
            f"{MIN_FRAMES} or more"
        )
    up = up_rotation(moving.up_axis).T @ np.array([0.0, 1.0, 0.0])
    rows = {side: [moving.body.landmarks[f"{side}_{name}"] for name in SOLE] for side in SIDES}
    feet = {side: moving.points(own) for side, own in rows.items()}
    contacts = tuple(find_contacts(plates, feet, moving.rate_hz))
    events = {
        side: _events(side, feet[side], moving.rate_hz, contacts, (file_events or {}).get(side))
        for side in SIDES
    }
    heels = {side: points[:, 0] for side, points in feet.items()}
    motion = _motion(moving, masses, up)
    dynamics, rest = _dynamics(moving, anatomy, masses, plates, contacts, events, motion, up)
    factor = _weighed(masses, motion.loads, rest, up, moving.rate_hz)
    if factor is not None:
        masses = masses.scaled(factor, "from the plates' vertical forces")
        motion = _motion(moving, masses, up)
        dynamics, rest = _dynamics(moving, anatomy, masses, plates, contacts, events, motion, up)
    checked = _lacking(contacts, rest @ up / (GRAVITY * masses.total), moving.rate_hz)
    if checked != contacts:
        contacts = checked
        dynamics, rest = _dynamics(moving, anatomy, masses, plates, contacts, events, motion, up)
    centres = {
        side: 1e3
        * float(np.linalg.norm(anatomy.harrington_hip(side) - anatomy.joints[f"{side}_hip"]))
        for side in SIDES
    }
    return GaitAnalysis(
        moving.capture_name,
        moving.rate_hz,
        angles,
        events,
        tuple(strides(events, heels, motion.joints[:, 0], moving.rate_hz, up)),
        contacts,
        masses,
        rest,
        dynamics,
        up,
        centres,
        moving,
        tuple(plates),
        tuple(notes),
    )


def _events(
    side: str,
    foot: Float[np.ndarray, "T P 3"],
    rate_hz: float,
    contacts: Sequence[Contact],
    filed: FootEvents | None,
) -> FootEvents:
    """A foot's events from its motion, replaced by those of plates and of the file nearby."""
    found = motion_events(foot[:, 0], foot[:, 2], rate_hz)
    own = _used(contacts, side)
    strikes = np.array([c.start for c in own if c.start is not None])
    offs = np.array([c.end for c in own if c.end is not None])
    sources = ["motion"] if len(found.strikes) + len(found.offs) else []
    sources += ["plates"] if len(strikes) + len(offs) else []
    found = FootEvents(_replaced(found.strikes, strikes), _replaced(found.offs, offs))
    if filed is not None:
        sources.append("file")
        found = FootEvents(
            _replaced(found.strikes, filed.strikes), _replaced(found.offs, filed.offs)
        )
    return FootEvents(found.strikes, found.offs, " and ".join(sources) or "none")


def _replaced(
    times: Float[np.ndarray, " n"], better: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    if not len(better):
        return times
    far = np.abs(times[:, None] - better).min(1) > SAME_EVENT
    return np.sort(np.concatenate([times[far], better]))


def _motion(moving: Moving, masses: SegmentMasses, up: Float[np.ndarray, "3"]) -> _Motion:
    """The mechanics before soft tissue was let go: it takes over some of the bones' motion."""
    pose, trans = (np.asarray(part, np.float64) for part in moving.pose_stage)
    turns = world_rotations(moving.body.parents, pose)
    rest = np.asarray(moving.body.rest_joints(np.asarray(moving.betas, np.float64)))
    joints = np.empty(pose.shape)
    for k, parent in enumerate(moving.body.parents):
        if parent < 0:
            joints[:, k] = rest[k] + trans
        else:
            joints[:, k] = joints[:, parent] + turns[:, parent] @ (rest[k] - rest[parent])
    centres = joints + np.einsum("tjab,jb->tja", turns, masses.centre - rest)
    return _Motion(
        loads(masses.mass, masses.inertia, centres, turns, moving.rate_hz, up), turns, joints
    )


def _weighed(
    masses: SegmentMasses,
    own: Loads,
    rest: Float[np.ndarray, "T 3"],
    up: Float[np.ndarray, "3"],
    rate_hz: float,
) -> float | None:
    """What a mass from the volume must be multiplied by to agree with the plates; None where the
    mass is known, where plates bear the person for too short a time, or where they differ by more
    than a volume is off.
    """
    known = np.isfinite(rest).all(1)
    if masses.source != FROM_VOLUME or known.sum() < MIN_WEIGHED * rate_hz:
        return None
    needed = own.needed[known] @ up
    factor = float(1.0 + (rest[known] @ up).sum() / needed.sum())
    return factor if abs(factor - 1.0) < MAX_VOLUME_ERROR else None


def _lacking(
    contacts: tuple[Contact, ...], share: Float[np.ndarray, " T"], rate_hz: float
) -> tuple[Contact, ...]:
    """Contacts whose plate lacks force that the motion needs are refused: part of the foot, or
    something else that bears the person, is beside the plate. share: vertical residual over the
    body weight, NaN where not all contacts are on plates.
    """
    at = np.arange(len(share)) / rate_hz
    used = [contact for side in SIDES for contact in _used(contacts, side)]
    standing = np.zeros(len(share), int)
    for contact in used:
        standing += _during(contact, at)
    out = []
    for contact in contacts:
        alone = share[_during(contact, at) & (standing == 1) & np.isfinite(share)]
        if contact in used and len(alone) >= MIN_FRAMES:
            short = alone < -MAX_LACK
            if short.mean() > LACK_SHARE:
                lack = -100.0 * float(alone[short].mean())
                why = f"the plate lacks {lack:.0f} % of the body weight that the motion needs"
                contact = replace(contact, refused=why)
        out.append(contact)
    return tuple(out)


def _during(contact: Contact, at: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Which of some times (s) lie in a contact."""
    start, end = contact.span
    return (at >= start) & (at <= end)


def _dynamics(
    moving: Moving,
    anatomy: Anatomy,
    masses: SegmentMasses,
    plates: Sequence[ForcePlate],
    contacts: Sequence[Contact],
    events: Mapping[str, FootEvents],
    motion: _Motion,
    up: Float[np.ndarray, "3"],
) -> tuple[Curves, Float[np.ndarray, "T 3"]]:
    """Moments, powers and ground forces where they are known, and the residual."""
    frames, rate = len(motion.joints), moving.rate_hz
    at = np.arange(frames) / rate
    by_number = {plate.number: plate for plate in plates}
    segments = segment_rotations(moving, anatomy, "pig", np.asarray(moving.pose_stage[0]))
    spin = angular_velocity(motion.turns, rate)
    columns: dict[tuple[str, str], Float[np.ndarray, " T"]] = {}
    slow: list[GroundForces] = []
    known: dict[str, Bool[np.ndarray, " T"]] = {}
    for side in SIDES:
        used = _used(contacts, side)
        given = [(by_number[contact.plate], *contact.span) for contact in used]
        ground = [ground_forces(*each, frames, rate) for each in given]
        slow += [ground_forces(*each, frames, rate, MOTION_HZ) for each in given]
        known[side] = np.zeros(frames, bool)
        for contact in used:
            known[side] |= _during(contact, at)
        if len(plates):
            known[side] |= _swing(events[side], at)
        total = sum((g.force for g in ground), np.zeros((frames, 3))) @ up
        own = {(f"{side}_ground_force_up", "N/kg"): total}
        own |= _leg(side, moving, anatomy, motion, ground, segments, spin)
        for key, values in own.items():
            columns[key] = np.where(known[side], values / masses.total, np.nan)
    covered = known["left"] & known["right"]
    covered &= sum((np.linalg.norm(g.force, axis=1) for g in slow), np.zeros(frames)) > 0.0
    rest = np.where(covered[:, None], residual(motion.loads, slow), np.nan)
    names, units = zip(*columns, strict=True)
    return Curves(names, units, np.column_stack(list(columns.values()))), rest


def _used(contacts: Sequence[Contact], side: str) -> list[Contact]:
    """A foot's contacts that are not refused."""
    return [contact for contact in contacts if contact.side == side and not contact.refused]


def _leg(
    side: str,
    moving: Moving,
    anatomy: Anatomy,
    motion: _Motion,
    ground: Sequence[GroundForces],
    segments: Mapping[str, Rotation],
    spin: Float[np.ndarray, "T J 3"],
) -> dict[tuple[str, str], Float[np.ndarray, " T"]]:
    """Moments (Nm) and powers (W) of a leg's joints, by their names and their units per kg."""
    body, parents = moving.body.joint_names, moving.body.parents
    below = descends(tuple(parents)) > 0.0
    mirror = 1.0 if side == "right" else -1.0
    out: dict[tuple[str, str], Float[np.ndarray, " T"]] = {}
    for joint, lower, carrier, parts in JOINTS:
        hub, top = (body.index(f"{side}_{name}") for name in (carrier, joint))
        offset = anatomy.centre(f"{side}_{joint}") - anatomy.joints[body[hub]]
        centre = motion.joints[:, hub] + motion.turns[:, hub] @ offset
        moment = joint_moment(motion.loads, below[top], centre, ground)
        local = segments[f"{side}_{lower}"].inv().apply(moment)
        signs = np.array([EXTENDS[joint], -mirror, -mirror])
        for part, values in zip(parts, (signs * local[:, [2, 0, 1]]).T, strict=True):
            out[f"{side}_{joint}_{part}_moment", "Nm/kg"] = values
        turning = spin[:, top] - spin[:, parents[top]]
        out[f"{side}_{joint}_power", "W/kg"] = (moment * turning).sum(1)
    return out


def _swing(events: FootEvents, at: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Times (s) at which a foot is in the air: from an off to the next strike, and up to a strike
    that comes first.
    """
    out = np.zeros(len(at), bool)
    if len(events.strikes) and (not len(events.offs) or events.strikes[0] < events.offs[0]):
        out |= at < events.strikes[0]
    for off in events.offs:
        later = events.strikes[events.strikes > off]
        out |= (at > off) & (at < (later[0] if len(later) else np.inf))
    return out
