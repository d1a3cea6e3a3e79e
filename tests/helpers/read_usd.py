"""What UsdSkel, USD's own code, makes of a file that habitus wrote."""

from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel, Vt


def skinned(stage: Any, frame: int) -> np.ndarray:
    """The surface at a time code, as UsdSkel deforms it."""
    cache = UsdSkel.Cache()
    mesh = UsdGeom.Mesh.Get(stage, "/person/body")
    cache.Populate(UsdSkel.Root.Get(stage, "/person"), Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton.Get(stage, "/person/skeleton"))
    skin = cache.GetSkinningQuery(mesh.GetPrim())
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(mesh.GetPrim()))
    points = Vt.Vec3fArray(mesh.GetPointsAttr().Get())
    if skin.HasBlendShapes():
        weights = skeleton.GetAnimQuery().ComputeBlendShapeWeights(frame)
        mapped = skin.GetBlendShapeMapper().Remap(weights, Vt.FloatArray())
        sub = shapes.ComputeSubShapeWeights(mapped)
        index = shapes.ComputeBlendShapePointIndices()
        offsets = shapes.ComputeSubShapePointOffsets()
        assert shapes.ComputeDeformedPoints(*sub, index, offsets, points)
    assert skin.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
    return np.array(points)
