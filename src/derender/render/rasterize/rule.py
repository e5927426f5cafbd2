"""The constants by which every rasteriser decides what a pixel shows (see the package's docstring)."""

NEAR_Z = 1e-3
"""Triangles with a vertex at or before this depth are skipped."""

MIN_TWICE_AREA_PX2 = 1e-5
"""Triangles whose doubled screen area is not above this are skipped: edge-on, or a point."""

MAX_COORDINATE_PX = 1e9
"""Triangles with a vertex projected farther out are skipped (this also drops infinite ones)."""

EDGE_TOLERANCE = 1e-4
"""A barycentric weight may be this far below zero; in pixels, that part of a cell."""

TIE_TOLERANCE = 1e-6
"""Inverse depths this close (relative) count as equal; the triangle with the lowest index wins."""
