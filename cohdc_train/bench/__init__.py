"""`cohdc bench`: the paper's Table 4, one row per network, all under the same data, budget, seeds
and threads.
"""

from pathlib import Path
from typing import Any


def bench(
    data: Path,
    *,
    out: Path,
    rows: list[str] | None = None,
    models: list[Path] | None = None,
    fit_config: Path | None = None,
    weights: dict[str, str] | None = None,
    options: list[str] | None = None,
    epochs: int | None = None,
    train_minutes: float | None = None,
    seeds: list[int] | None = None,
    threads: int = 1,
    images: int = 20,
    int8: bool = True,
) -> list[dict[str, Any]]:
    """Train, export, score and time the rows of Table 4, and any finished model beside them.

    Every row is trained on the same folder with the same budget and seeds, exported, quantised,
    scored on the validation split by its ONNX file, and timed picture by picture in turn with the
    others, from uint8 image to masks of the image. What is finished lies in OUT/ROW_seedN and is
    not done again. Writes table4.json, table4.csv, table4.txt and table4.png.

    Args:
        data: COCO-format folder.
        out: folder for everything that is written.
        rows: names among HDC-Net, ResNet50, ResNet101 and MobileNetV1, and YAML files of other
            networks, shipped ones such as networks/hdc_net_n.yaml too; the four names when left
            out. An empty list trains none.
        models: checkpoints of `cohdc fit` and ONNX files, foreign ones too, as further rows.
        fit_config: configuration file of `cohdc fit` for all rows; a row's own network is put over
            it.
        weights: row -> ImageNet weights, by torchvision's name or as a file. Rows without start
            from random weights.
        options: further arguments of `cohdc fit` for all rows, such as
            '["--data.canvas=[240,320]"]'.
        epochs: budget of each training.
        train_minutes: the budget as time instead; the learning rate falls with it.
        seeds: one training of every row for each; [0] when left out.
        threads: of training, torch and onnxruntime.
        images: validation pictures that are timed.
        int8: quantise as well.

    Returns:
        The rows of table4.json.

    Raises:
        CohdcError: there is no such row, no budget or two, or a step failed; its log is named.
    """
    from cohdc_train.bench.table import run

    return run(
        data,
        out,
        rows=rows,
        models=models or [],
        options=()
        if rows == []
        else _fit_options(fit_config, options or [], epochs, train_minutes),
        weights=weights or {},
        seeds=seeds or [0],
        threads=threads,
        images=images,
        int8=int8,
    )


def _fit_options(
    config: Path | None, options: list[str], epochs: int | None, train_minutes: float | None
) -> tuple[str, ...]:
    from cohdc_train.bench.training import budget
    from cohdc_train.errors import CohdcError

    if (epochs is None) == (train_minutes is None):
        raise CohdcError(
            f"a budget is needed: --epochs or --train-minutes, not {'none' if epochs is None else 'both'}"
        )
    given = (f"--config={config}",) if config is not None else ()
    return (*given, *options, *budget(epochs, train_minutes))
