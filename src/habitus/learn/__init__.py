"""Learns a body model from registrations: meshes of people in one topology, in many poses and shapes (S 4, T 5.4)."""
