"""How much of their pixels edge fragments cut off, as torch functions of the screen: what makes
moving edges count.
"""

from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from habitus.render.derivatives import fragment_weights_vjp
from habitus.render.edge_fragments import EdgeFragments
from habitus.render.reference import images as reference
from habitus.render.transforms import Operator, outside
from habitus.render.values import no_vmap


def fragment_weights(screen: Float[Tensor, "V 3"], fragments: EdgeFragments) -> Float[Tensor, " S"]:
    """The fragments' weights, with the derivative of the area that moving edges sweep: -(normal
    velocity) integrated.

    It is the derivative of the pixel's exact coverage (Reynolds' transport theorem).
    """
    if screen.device.type != "cpu":
        return reference.fragment_weights(screen, fragments)
    return _FragmentWeights.apply(screen, fragments)


class _FragmentWeights(Operator):
    @staticmethod
    def forward(screen: Tensor, fragments: EdgeFragments) -> Tensor:
        return fragments.weight.to(screen.dtype, copy=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(inputs[0])
        ctx.save_for_forward(inputs[0])
        ctx.fragments = inputs[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return outside(
            partial(fragment_weights_vjp, fragments=ctx.fragments), *ctx.saved_tensors, cotangent
        ), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: Any) -> Tensor:
        return reference.swept(ctx.saved_tensors[0], tangent, ctx.fragments)

    @staticmethod
    def vmap(*_: Any) -> Any:
        raise no_vmap()
