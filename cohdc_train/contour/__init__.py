"""Polygons of masks: exact outlines with parts and holes, and outlines of few vertices.

Points are (x, y) in px with the origin at the corner of the first pixel, as COCO has them. Pixel
(i, j) is the square from (j, i) to (j + 1, i + 1). It belongs to a polygon when its center does
(even-odd rule over all rings).
"""

from cohdc_train.contour.beetle_parameters import BeetleSearch
from cohdc_train.contour.polygons import (
    Polygon,
    count_vertices,
    join_polygons,
    pixel_borders,
    rasterize,
    trace,
)
from cohdc_train.contour.simplification import METHODS, ContourMethod, simplify

__all__ = [
    "METHODS",
    "BeetleSearch",
    "ContourMethod",
    "Polygon",
    "join_polygons",
    "pixel_borders",
    "rasterize",
    "simplify",
    "trace",
    "count_vertices",
]
