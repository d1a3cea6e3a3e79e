"""Builds `the files of src/habitus/assets/bodies/` from CC0 geometry and a public anthropometric
survey.
"""
