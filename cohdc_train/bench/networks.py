"""`cohdc bench networks`: the paper's Table 4, all networks trained and timed alike."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cohdc_train.errors import CohdcError


@dataclass(frozen=True)
class NetworkBenchOptions:
    """Options of `cohdc bench networks`.

    Attributes:
        fit_config: configuration file of `cohdc fit` for all rows; each row's network replaces the
            one in it.
        weights: ImageNet weights of each row, by torchvision's name or as a file. Other rows start
            from random weights.
        options: further arguments of `cohdc fit` for all rows, such as
            '["--data.canvas=[240,320]"]'.
        epochs: length of each training. Give this or train_minutes.
        train_minutes: length of each training in minutes; the learning rate schedule fits it.
        seeds: seeds of the trainings of each row; [0] when not given.
        threads: number of threads for training, torch and onnxruntime.
        images: number of validation images that are timed.
        int8: quantize each exported network too.
    """

    fit_config: Path | None = None
    weights: dict[str, str] | None = None
    options: list[str] | None = None
    epochs: int | None = None
    train_minutes: float | None = None
    seeds: list[int] | None = None
    threads: int = 1
    images: int = 20
    int8: bool = True

    def __post_init__(self) -> None:
        """Check the ranges."""
        if min(self.threads, self.images) < 1:
            raise CohdcError(
                f"threads is {self.threads} and images is {self.images}; both are at least 1"
            )

    def fit_arguments(self) -> tuple[str, ...]:
        """Build the arguments of `cohdc fit` that all rows share.

        Raises:
            CohdcError: neither epochs nor train_minutes is given, or both are.
        """
        from cohdc_train.bench.training import budget_arguments

        if (self.epochs is None) == (self.train_minutes is None):
            given = "neither" if self.epochs is None else "both"
            raise CohdcError(f"give --epochs or --train-minutes, not {given}")
        config = () if self.fit_config is None else (f"--config={self.fit_config}",)
        budget = budget_arguments(self.epochs, self.train_minutes)
        return (*config, *(self.options or ()), *budget)


def bench_networks(
    data: Path,
    *,
    out: Path,
    rows: list[str] | None = None,
    models: list[Path] | None = None,
    **options: Any,
) -> list[dict[str, Any]]:
    """Train, export, score and time the networks of Table 4, and any finished model with them.

    Each row is trained on the same folder with the same budget and seeds, exported, quantized, and
    scored on the validation split by its ONNX file. All rows take turns on the same images when
    they are timed, from uint8 image to full-size masks. Finished steps in OUT/ROW_seedN are not
    repeated. Writes table4.json, table4.csv, table4.txt and table4.png.

    Args:
        data: COCO-format folder.
        out: folder for all results.
        rows: names among HDC-Net, ResNet50, ResNet101 and MobileNetV1, and YAML files of other
            networks, such as the shipped networks/hdc_net_n.yaml; the four names when not given.
            An empty list trains none.
        models: checkpoints of `cohdc fit` and ONNX files, also of other exporters, as further rows.
        **options: fields of `NetworkBenchOptions`.

    Returns:
        The rows of table4.json.

    Raises:
        CohdcError: a row or the budget is wrong, or a step failed; the message names its log.
    """
    settings = NetworkBenchOptions(**options)
    if rows != []:
        settings.fit_arguments()  # refuse a wrong budget before anything is loaded
    from cohdc_train.bench.comparison import compare_networks

    return compare_networks(data, out, rows, models or [], settings)
