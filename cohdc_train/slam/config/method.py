"""The parts of the method that can be switched off, so that each one's worth can be measured."""

from dataclasses import dataclass

import numpy as np

from cohdc_train.errors import DataError

MAX_KEYPOINTS = 1500  # per frame
ACCELERATION = np.repeat([1.0, 4.0], 3)  # m/s^2 and rad/s^2, one standard deviation
LONGEST = 0.2  # s, longest gap between two frames over which the velocity is used
SHORTEST = 1e-3  # s, shortest step between two frames from which a velocity is taken
FEW = 150  # points of a frame, below which the motion prior counts


@dataclass(frozen=True)
class Method:
    """Which parts of the method run.

    Args:
        loops: a place seen before is recognised, checked and closed by a pose graph (paper 2.3,
            eqs. 10-12).
        refinement: matched corners move to where their points' patches fit best (paper eqs. 8 and
            9), and count for the fraction of a pixel to which they are then known.
        geometry: what stands where a keyframe looked through moves, whatever its class; nothing is
            taken from there. A masked thing that has stood still for two seconds is of use until it
            moves.
        static_weights: groups of points that do not move with the rest are left out, and count less
            from then on.
        global_adjustment: when the sequence is over, all keyframes are bundle-adjusted at once.
        every_frame: in that adjustment what frames between keyframes saw counts as well.
        smoothing: when the sequence is over, frames' poses are made to agree with how a hand moves,
            by what each saw.
        keyframe_culling: a keyframe leaves the map when three others see nine in ten of its points
            as well.
        flow: in real time optical flow says where a frame is, and every third is matched to the map
            after that.
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


@dataclass(frozen=True)
class Culling:
    """How a frame's mask is made of what a segmenter or a folder gives.

    Args:
        dynamic_classes: names of the classes that may move; all classes of the model when not
            given.
        score: detections below this class score are ignored.
        quality: detections below this CQE quality are ignored; the paper's filter is 0.9. A contour
            left out is a person left in: by default none is.
        dilate: px by which a mask grows; a detection of CQE quality q grows by dilate * (1 + doubt
            * (1 - q)).
        doubt: how much more a contour grows that CQE trusts not at all; at 0 all grow alike. When
            not given, 1, or 0 for a network whose masks are cut by quality: a doubtful contour has
            its doubtful rim already.
    """

    dynamic_classes: list[str] | None = None
    score: float = 0.5
    quality: float = 0.0
    dilate: int = 10
    doubt: float | None = None

    def __post_init__(self) -> None:
        if self.dilate < 0:
            raise DataError(f"dilate is {self.dilate}; it cannot be below 0")
        if self.doubt is not None and not 0 <= self.doubt < float("inf"):
            raise DataError(f"doubt is {self.doubt:g}; it cannot be below 0 or infinite")
        for name in ("score", "quality"):
            if not 0 <= getattr(self, name) <= 1:
                raise DataError(f"{name} is {getattr(self, name):g}; it must lie within 0..1")
