"""Scores gathered from several processes."""

from typing import Any

import pytest
import torch

from cohdc_train.metrics import coco_metrics as metrics


def test_images_seen_by_two_processes_count_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def gather(parts: list[Any], mine: Any) -> None:
        parts[:] = [mine, {2: [{"image_id": 2}], 3: []}]

    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    monkeypatch.setattr(torch.distributed, "all_gather_object", gather)
    assert metrics._gather({1: [], 2: [{"image_id": 2}]}) == {1: [], 2: [{"image_id": 2}], 3: []}
