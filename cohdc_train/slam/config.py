"""The parts of the method that can be switched off, so that each one's worth can be measured."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """Which parts of the method run.

    Args:
        loops: a place seen before is recognised, checked and closed by a pose graph (paper 2.3, eqs. 10-12).
        refinement: matched corners move to where their points' patches fit best (paper eqs. 8 and 9), and count for the
            fraction of a pixel to which they are then known.
        geometry: what stands where a keyframe looked through moves, whatever its class; nothing is taken from there. A
            masked thing that has stood still for two seconds is of use until it moves.
        static_weights: groups of points that do not move with the rest are left out, and count less from then on.
        global_adjustment: when the sequence is over, all keyframes are bundle-adjusted at once.
        every_frame: in that adjustment what frames between keyframes saw counts as well.
        smoothing: when the sequence is over, frames' poses are made to agree with how a hand moves, by what each saw.
        keyframe_culling: a keyframe leaves the map when three others see nine in ten of its points as well.
        flow: in real time optical flow says where a frame is, and every third is matched to the map after that.
    """

    loops: bool = True
    refinement: bool = True
    geometry: bool = True
    static_weights: bool = True
    global_adjustment: bool = True
    every_frame: bool = True
    smoothing: bool = True
    keyframe_culling: bool = True
    flow: bool = True
