"""Who looks on while a run goes: called after every frame, outside the measured times."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.io.results import FrameRecord
from cohdc_train.slam.io.sources import View
from cohdc_train.slam.tracking.tracker import Tracker


class Watcher(Protocol):
    """Sees every frame of a run: the recorder of a cloud, a viewer, a robot's own publisher."""

    def __call__(self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker) -> None:
        """After a frame. mask: [H, W] bool, True = dynamic: what was masked, at rest or not, and what depth found to
        move; None where there was neither. record.pose.T_wc: its pose; when record.pose.keyframe, the map's keyframe of
        the time view.t is this frame."""
        ...
