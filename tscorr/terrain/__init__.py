"""Surface normals and what hides what: `surface`, `normals`, `roof_planes`, `shadows`, `bitmask`.

Imports numba; callers import the modules they need when they compute.
"""
