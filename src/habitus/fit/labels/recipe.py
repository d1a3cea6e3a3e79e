"""Names for points that have none: tracklets, single frames registered, the person's shape, and votes in time."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.labels.clouds import Clouds, telling_frames, tracklets
from habitus.fit.labels.registration import Registered, at_height, plain_poses, refine, register
from habitus.fit.labels.votes import assign, averaged, distances, settled
from habitus.fit.mosh.settings import MoshSettings, sequence_settings
from habitus.fit.mosh.shape import Placement, place, shape_stage
from habitus.fit.mosh.suspects import marker_noise
from habitus.fit.mosh.windows import fit_long, start_long
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import attach, default_markers

HEIGHTS = (1.25, 1.45, 1.6, 1.75, 1.9)
SIZING_FRAMES = 8
SEEDS = 24
SHAPE_SEEDS = 8


@dataclass(frozen=True)
class Labelled:
    label: Int[np.ndarray, " P"]
    tracklet: Int[np.ndarray, " P"]
    confidence: Float[np.ndarray, " P"]
    seeds: Registered
    rig: MarkedBody
    predicted: Float[np.ndarray, "T M 3"]
    trail: dict


def default_rig(body: BodyModel, placement: Placement, betas: np.ndarray) -> MarkedBody:
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    return marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))


def label_points(body, prior, layout, clouds, settings=None, log=lambda *a: None):
    import time
    settings = settings or MoshSettings()
    prior = prior.for_joints(body.joint_names)
    trail = {}
    began = [time.process_time()]
    def tick(name):
        now = time.process_time(); trail[name] = trail.get(name, 0) + now - began[0]; began[0] = now
    with threadpool_limits(1, user_api="blas"):
        placement = place(layout, body)
        tracklet = tracklets(clouds)
        tick("tracklets")
        frames = telling_frames(clouds, SEEDS)
        bank = plain_poses(body.joint_names)
        few = frames[:: max(1, len(frames) // SIZING_FRAMES)]
        tries = [register(default_rig(body, placement, at_height(body, h)), prior, clouds, few, bank) for h in HEIGHTS]
        typical = [np.sort(found.cost)[: max(1, len(few) // 2)].mean() for found in tries]
        height = HEIGHTS[int(np.argmin(typical))]
        trail["typical"] = np.round(typical)
        tick("size")
        betas = at_height(body, height)
        rig = default_rig(body, placement, betas)
        seeds = register(rig, prior, clouds, frames, bank)
        tick("seeds")
        trail["seeds0"] = seeds
        rig, shape = shaped(body, prior, placement, clouds, seeds, settings)
        tick("shape")
        bank = np.concatenate([bank, shape.pose])
        seeds = register(rig, prior, clouds, frames, bank)
        tick("seeds")
        trail["seeds1"] = seeds
        label = seed_votes(clouds, seeds, tracklet, len(layout))
        trail["label0"] = label
        known = shape.pose
        for step, gate in enumerate((0.2, 0.2, 0.15)):
            observed = clouds.labelled(label, len(layout))
            if step == 2:
                rig, known = reshaped(body, prior, placement, observed, result, settings)
                tick("shape")
            pose, trans = start_long(rig, known, ("root", *prior.joint_names), observed, settings.longest)
            if step:
                pose, trans = result.pose, result.trans
            lam = sequence_settings(settings, warm=step > 0)
            scale = np.full(len(layout), 0.10)
            result = fit_long(rig, observed, None, scale, prior, pose, trans, lam, longest=settings.longest)
            tick("fit")
            predicted = predict(rig, result.pose, result.trans)
            squared = distances(clouds, predicted)
            costs = averaged(squared, tracklet)
            label = assign(costs, clouds, np.full(len(costs), gate**2))
            trail[f"label{step + 1}"] = label
            tick("votes")
        noise = marker_noise(np.linalg.norm(clouds.labelled(label, len(layout)) - predicted, axis=2))
        trail["noise"] = noise
        own = np.where(label >= 0, np.sqrt(squared[np.arange(len(label)), label]), np.inf)
        label = np.where(own < np.clip(8 * noise[label], 0.08, 0.15), label, -1)
        tick("votes")
    return Labelled(label, tracklet, np.ones(len(label)), seeds, rig, predicted, trail)


def shaped(body, prior, placement, clouds, seeds, settings):
    order = np.argsort(seeds.cost)[:SHAPE_SEEDS]
    best = seeds.of(order)
    shape = shape_stage(body, placement, best.observed(clouds), prior, best.pose, best.trans, settings)
    return marked_body(body, shape.betas, shape.attachment), shape


def reshaped(body, prior, placement, observed, result, settings):
    from habitus.fit.mosh.frames import spread_frames
    chosen = spread_frames(observed, settings.frames, settings.seed)
    shape = shape_stage(body, placement, observed[chosen], prior, result.pose[chosen], result.trans[chosen], settings)
    return marked_body(body, shape.betas, shape.attachment), shape.pose


def seed_votes(clouds, seeds, tracklet, count):
    """Labels of the tracklets that good seeds agree on."""
    votes = np.zeros((int(tracklet.max()) + 1, count))
    weight = np.exp(-(seeds.cost - seeds.cost.min()) / (0.5 * seeds.cost.min() + 50))
    for _ in range(4):
        votes[:] = 0
        for s in range(len(seeds.frames)):
            found = np.flatnonzero(seeds.match[s] >= 0)
            votes[tracklet[seeds.match[s, found]], found] += weight[s]
        winner = votes.argmax(1)
        known = votes.max(1) > 0
        for s in range(len(seeds.frames)):
            found = np.flatnonzero(seeds.match[s] >= 0)
            k = tracklet[seeds.match[s, found]]
            others = votes[k].sum(1) - weight[s] > 1e-9
            agree = (winner[k] == found)[others]
            share = agree.mean() if len(agree) else 1.0
            weight[s] = np.exp(-(seeds.cost[s] - seeds.cost.min()) / (0.5 * seeds.cost.min() + 50)) * share**4
    clear = votes.max(1) > 0.6 * votes.sum(1)
    label = np.where(known & clear, winner, -1)[tracklet]
    # no label twice in a frame: the stronger tracklet keeps it
    strength = votes.max(1)[tracklet]
    order = np.lexsort((-strength, label, clouds.frame))
    same = (np.diff(clouds.frame[order], prepend=-1) == 0) & (np.diff(label[order], prepend=-2) == 0)
    label[order[same]] = -1
    return label
