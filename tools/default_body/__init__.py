"""Builds `src/habitus/assets/default_body.npz` from CC0 geometry and a public anthropometric survey."""
