"""Measures of body models against registrations (S 5). Needs PyTorch."""

from habitus.errors import check_extra

check_extra("torch", "training body models and evaluating them")
