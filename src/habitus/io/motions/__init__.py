"""Motions of other people's skeletons: BVH and glTF."""
