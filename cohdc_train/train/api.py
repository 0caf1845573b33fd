"""Training from Python: `cohdc_train.fit`."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from cohdc_train.train.cli import fit as run_command


def fit(
    data: Path | str | Sequence[Path | str],
    out: Path | str = Path("runs/fit"),
    *,
    config: Path | str | Sequence[Path | str] = (),
    minutes: float | None = None,
    epochs: int | None = None,
    overrides: Mapping[str, object] | None = None,
) -> Path:
    """Train a segmenter on COCO-format data, as `cohdc fit` does.

    Args:
        data: COCO-format folder, or several; the first one is validated on.
        out: folder for checkpoints, logs and figures.
        config: YAML files that add up, shipped ones such as "networks/hdc_net_s.yaml" too; HDC-Net
            n without one.
        minutes: length of the training.
        epochs: length of the training; whichever comes first ends it.
        overrides: options of `cohdc fit` by name, such as {"data.batch_size": 4, "pretrained":
            "imagenet"}.

    Returns:
        The path of best.ckpt.

    Raises:
        CohdcError: in one line, for whatever the user can fix.
        SystemExit: an override is no option of `cohdc fit`, or of another type; the message is on
            stderr.
    """
    roots = [data] if isinstance(data, Path | str) else list(data)
    configs = [config] if isinstance(config, Path | str) else list(config)
    arguments = [str(root) for root in roots]
    arguments += [f"--config={path}" for path in configs]
    arguments.append(f"--out={out}")
    arguments += [] if minutes is None else [f"--minutes={minutes}"]
    arguments += [] if epochs is None else [f"--epochs={epochs}"]
    for name, value in (overrides or {}).items():
        text = value if isinstance(value, str) else json.dumps(value, default=str)
        arguments.append(f"--{name}={text}")
    run_command(arguments)
    return Path(out) / "best.ckpt"
