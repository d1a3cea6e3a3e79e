"""After the warm-up no fit compiles anything: the seconds of a stage are those of its work."""

import sys

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from habitus.body.prior import shipped_prior
from habitus.errors import HabitusError
from habitus.fit.markers.recipe import Recording, fit_markers, warm_up
from habitus.fit.markers.settings import MoshSettings
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body


def compiled() -> set[tuple[str, str, str]]:
    """Every compiled form of every kernel of the project."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("habitus.")]
    kernels = {
        id(value): value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, Dispatcher)
    }
    return {
        (k.py_func.__module__, k.py_func.__name__, str(s))
        for k in kernels.values()
        for s in k.signatures
    }


@pytest.mark.parametrize("causal", [False, True])
def test_a_fit_finds_every_kernel_compiled(causal):
    try:
        body = load_body("default")
    except HabitusError as error:
        pytest.skip(f"the default body is not there: {error}")
    layout = load_layout("cmu-41")
    still = body.rest_vertices()[layout.vertices(body)]
    observed = np.repeat(still[None], 24, axis=0) + np.random.default_rng(0).normal(
        scale=0.001, size=(24, *still.shape)
    )
    assert warm_up(body) > 0
    before = compiled()
    settings = MoshSettings(annealing=(10.0,), frames=3, soft_tissue=not causal, causal=causal)
    for markers in (observed, np.asfortranarray(observed)):
        fit_markers(
            body, shipped_prior(), layout, [Recording("still", markers, 100.0, "+y")], settings
        )
    assert compiled() == before
