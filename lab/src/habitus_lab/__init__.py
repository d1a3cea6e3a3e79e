"""Simulated people, sensors and flesh, and how the default body is made: what habitus is judged and
made with, not what it needs.
"""
