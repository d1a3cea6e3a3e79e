"""Registered scans train a body, and the body registers the same scans again (T 5.4)."""

from dataclasses import replace

import numpy as np
import pytest

from habitus import Trainer, load_body
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.correspondences import Topology, vertex_weights
from habitus.fit.points.free_surface import free_surface
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.scans import Registrar
from habitus.jobs.coregister import coregistered
from habitus.mesh.normals import vertex_normals
from habitus.mesh.registrations import Registrations
from habitus.residuals.points import PointSolver
from habitus_lab.population.coarse_bodies import coarse_body

PEOPLE = 2
POSES = 2
STEPS = (ScanStage(4, points=2000, scale=0.05, noise=0.0025),)


def fitter_of(body: BodyModel) -> ScanFitter:
    size = 3 * (body.num_joints - 1)
    prior = PosePrior(body.joint_names[1:], np.zeros(size), 0.04 * np.eye(size))
    return ScanFitter(PointSolver.of(body), Topology.of(body.faces, body.num_vertices), prior)


def test_a_body_trained_on_registered_scans_knows_these_people_better():
    body = coarse_body(load_body("default"), 400)
    rng = np.random.default_rng(0)
    swell = (
        0.008
        * np.sin(body.v_template @ (7.0, 5.0, 6.0))[:, None]
        * vertex_normals(body.v_template, body.faces)
    )
    other = replace(
        body, v_template=body.v_template + swell
    )  # a people whom the body does not know
    states = []
    truths = []
    clouds = []
    for _ in range(PEOPLE):
        pose = 0.2 * rng.normal(size=(POSES, body.num_joints, 3))
        trans = np.zeros((POSES, 3))
        states.append(BodyState(0.5 * rng.normal(size=body.num_betas), pose, trans))
        truths.append([np.asarray(other(states[-1].betas, one).vertices) for one in pose])
        clouds.append([scanned(one, body.faces, rng) for one in truths[-1]])
    first = fitter_of(body)
    before = [
        first.fit_with_offsets(state, each, STEPS)
        for state, each in zip(states, clouds, strict=True)
    ]
    surfaces = np.array(
        [
            free_surface(first.topology, first.vertices(fit.state, k), clouds[p][k], start=start)
            for p, fit in enumerate(before)
            for k, start in enumerate(fit.surfaces)
        ]
    )
    every = [cloud for each in clouds for cloud in each]
    weights = [vertex_weights(first.topology, *each) for each in zip(surfaces, every, strict=True)]
    count = len(every)
    who = tuple(f"p{k // POSES}" for k in range(PEOPLE * POSES))
    names = tuple(map(str, range(count)))
    data = Registrations(
        surfaces, body.faces, who, ("",) * count, ("pose",) * count, names, np.array(weights)
    )
    held = ("skinning_weights", "posedirs", "joint_regressor")
    trained = (
        Trainer(start="body", fixed=held, num_betas=1, rounds=3)
        .fit(data, template=body, workers=1)
        .body
    )
    second = fitter_of(trained)
    begin = [
        BodyState(np.zeros(trained.num_betas), fit.state.pose, fit.state.trans) for fit in before
    ]
    after = [
        second.fit_with_offsets(state, each, STEPS)
        for state, each in zip(begin, clouds, strict=True)
    ]

    def wrong(
        fitter: ScanFitter, found: list
    ) -> float:  # of all models, from where each vertex truly is
        pairs = [
            (fitter.vertices(fit.state, k), truths[p][k])
            for p, fit in enumerate(found)
            for k in range(POSES)
        ]
        return float(np.mean([np.linalg.norm(model - true, axis=1) for model, true in pairs]))

    def off(fitter: ScanFitter, found: list) -> float:  # what the model leaves to the offset
        pairs = [
            (fitter.vertices(fit.state, k), fit.surfaces[k]) for fit in found for k in range(POSES)
        ]
        return float(np.mean([np.linalg.norm(model - surface, axis=1) for model, surface in pairs]))

    error, away = (
        np.array([each(*run) for run in ((first, before), (second, after))])
        for each in (wrong, off)
    )
    assert away[1] < 0.9 * away[0] and error[1] < error[0]


def scanned(surface: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> Cloud:
    face = rng.integers(0, len(faces), 2000)
    share = rng.dirichlet((1.0, 1.0, 1.0), 2000)
    places, normals = (
        np.einsum("pk,pkc->pc", share, x[faces[face]])
        for x in (surface, vertex_normals(surface, faces))
    )
    return Cloud(places, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def test_scans_of_people_are_registered_again_with_the_body_that_they_train():
    body = coarse_body(load_body("default"), 400)
    rng = np.random.default_rng(1)
    swell = 0.012 * np.sin(body.v_template @ (7.0, 5.0, 6.0))[:, None]
    other = replace(
        body, v_template=body.v_template + swell * vertex_normals(body.v_template, body.faces)
    )
    people, truth, begin = {}, {}, {}
    for person in ("anna", "ben"):
        betas = np.where(np.arange(body.num_betas) < 5, rng.normal(size=body.num_betas), 0.0)
        pose = 0.08 * rng.normal(size=(POSES, body.num_joints, 3))
        truth[person] = [np.asarray(other(betas, one).vertices) for one in pose]
        begin[person] = BodyState(np.zeros(body.num_betas), 0.5 * pose, np.zeros((POSES, 3)))
        people[person] = [
            Scan(f"{person} {k}", scanned(one, body.faces, rng).points)
            for k, one in enumerate(truth[person])
        ]
    registrar = Registrar.of(body, prior_of(load_body("default")))
    asked = {"up": "+y", "unit": "m"}
    done = coregistered(registrar, people, asked, lambda stage, share: None, begin)

    def off_model(fits):
        found = []
        for name, each in fits.items():
            for fit, true in zip(each, truth[name], strict=True):
                true = true @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
                found.append(np.linalg.norm(fit.model_vertices - true, axis=1).mean())
        return float(np.mean(found))

    assert off_model(done.fits) < 0.97 * off_model(done.before)
    assert all(fit.body is done.body for each in done.fits.values() for fit in each)
    np.testing.assert_array_equal(done.body.skinning_weights, body.skinning_weights)
    with pytest.raises(HabitusError, match="1 person; expected two people or more"):
        coregistered(registrar, {"anna": people["anna"]}, asked, lambda stage, share: None)
