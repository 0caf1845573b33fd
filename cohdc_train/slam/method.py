"""The parts of the method that can be switched off, so that each one's worth can be measured."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """Which parts of the method run.

    Args:
        loops: a place seen before is recognised, checked and closed by a pose graph (paper 2.3, eqs. 10-12).
        refinement: a new measurement's pixel is moved to where the point's patch fits best (paper eqs. 8 and 9).
        geometry: what moves against the map is found by depth alone, whatever its class.
        static_weights: a point that keeps contradicting its place in the map counts less, until it is dropped.
    """

    loops: bool = True
    refinement: bool = True
    geometry: bool = True
    static_weights: bool = True
