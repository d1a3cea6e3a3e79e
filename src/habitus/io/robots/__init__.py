"""Descriptions of robots: MJCF and URDF, and which of a robot's links is which part of a body."""
