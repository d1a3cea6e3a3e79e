"""A scan of somebody else, or one that is stretched, among the scans of a person: the others are
what they are without it.
"""

import numpy as np

from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.fit.points.scans import Registrar
from habitus.io.models.bodies import load_body
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.scans import Scanner, scanned

SCANNER = Scanner(3000, holes=0.0)


def test_a_scan_unlike_the_persons_others_is_registered_by_itself():
    body = coarse_body(load_body("default"), 500)
    rng = np.random.default_rng(4)
    betas = np.where(np.arange(body.num_betas) < 6, rng.normal(size=body.num_betas), 0.0)
    pose = 0.08 * rng.normal(size=(3, body.num_joints, 3))
    truth = [np.asarray(body(betas, one).vertices) for one in pose]
    truth[2] = truth[2] * np.array([1.3, 1.0, 1.3])
    scans = [scanned(one, body.faces, SCANNER, rng, str(k)) for k, one in enumerate(truth)]
    start = BodyState(np.zeros(body.num_betas), pose, np.zeros((3, 3)))
    registrar = Registrar.of(body, prior_of(load_body("default")))
    alone = registrar.register(scans[:2], up="+y", unit="m", previous=start)
    fits = registrar.register(scans, up="+y", unit="m", previous=start)
    for before, after in zip(alone, fits, strict=False):
        np.testing.assert_allclose(after.betas, before.betas, atol=1e-3)
        np.testing.assert_allclose(after.vertices, before.vertices, atol=1e-4)
        assert not after.unlike
    assert fits[2].unlike > 0.02 and "unlike" in fits[2].verdict.keys
    assert np.abs(fits[2].betas - fits[0].betas).max() > 1.0
    assert [fit.scan_name for fit in fits] == ["0", "1", "2"]
