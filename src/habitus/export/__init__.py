"""Write fits for other tools: AMASS-style .npz, skinned and animated .glb, .obj sequences."""

from habitus.export.glb import write_glb
from habitus.export.npz import write_amass, write_npz
from habitus.export.obj import write_obj_sequence

__all__ = ["write_amass", "write_glb", "write_npz", "write_obj_sequence"]
