"""habitus: the state of the human body (shape, pose, soft tissue), estimated by inverting forward models."""

__version__ = "0.1.0"
