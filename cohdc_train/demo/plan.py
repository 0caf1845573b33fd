"""How much a demo renders and trains."""

from dataclasses import dataclass, field

# One person walks up to the camera and fills its view, another walks behind, the walls are bare:
# the people cover most of what could be tracked (docs/results/demo.md).
SCENE_SEED = 1


@dataclass(frozen=True)
class DemoPlan:
    """Amount of work of a demo.

    Args:
        train_images: rendered photographs to train on.
        val_images: rendered photographs of other rooms, for the scores.
        frames: length of the sequence, at 30 frames per second.
        minutes: duration of the fine-tuning.
        expected_s: step -> expected duration on two cores, s; for the time that is left.
    """

    train_images: int
    val_images: int
    frames: int
    minutes: float
    expected_s: dict[str, float] = field(default_factory=dict)


QUICK = DemoPlan(
    train_images=40,
    val_images=12,
    frames=180,
    minutes=0.6,
    expected_s={
        "render": 45.0,
        "shipped": 7.0,
        "train": 55.0,
        "export": 15.0,
        "slam": 30.0,
        "report": 3.0,
    },
)
DEFAULT = DemoPlan(
    train_images=96,
    val_images=24,
    frames=180,
    minutes=1.75,
    expected_s={
        "render": 50.0,
        "shipped": 9.0,
        "train": 130.0,
        "export": 15.0,
        "slam": 30.0,
        "report": 3.0,
    },
)
FULL = DemoPlan(
    train_images=400,
    val_images=60,
    frames=180,
    minutes=10.0,
    expected_s={
        "render": 110.0,
        "shipped": 20.0,
        "train": 640.0,
        "export": 15.0,
        "slam": 30.0,
        "report": 3.0,
    },
)
