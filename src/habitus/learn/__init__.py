"""Training of body models (S 4, T 5). Needs PyTorch."""

from habitus.errors import check_extra

check_extra("torch", "training body models and evaluating them")
