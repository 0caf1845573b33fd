"""How much a demo renders and trains."""

from dataclasses import dataclass, field

# One person walks up to the camera and fills its view, another walks behind, the walls are bare:
# what remains visible of the room is less than what moves (docs/results/demo.md).
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
    train_images=48,
    val_images=16,
    frames=180,
    minutes=0.75,
    expected_s={
        "render": 35.0,
        "shipped": 8.0,
        "train": 60.0,
        "export": 14.0,
        "slam": 25.0,
        "report": 6.0,
    },
)
DEFAULT = DemoPlan(
    train_images=120,
    val_images=32,
    frames=180,
    minutes=2.0,
    expected_s={
        "render": 50.0,
        "shipped": 12.0,
        "train": 140.0,
        "export": 14.0,
        "slam": 25.0,
        "report": 6.0,
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
        "train": 630.0,
        "export": 14.0,
        "slam": 25.0,
        "report": 6.0,
    },
)
