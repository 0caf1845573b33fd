"""The whole real sequence freiburg1_xyz, once per seed."""

from pathlib import Path

import pytest

from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.run import slam

SEQUENCE = Path(__file__).parents[3] / "shared" / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"


@pytest.mark.slow
@pytest.mark.skipif(not SEQUENCE.is_dir(), reason="freiburg1_xyz is not in ../shared/data/tum")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_freiburg1_xyz(seed: int, tmp_path: Path) -> None:
    metrics = slam(SEQUENCE, out=tmp_path / "run", settings=SlamConfig(seed=seed))
    assert metrics["frames"] == 792
    assert metrics["without_depth"] == 6
    assert metrics["coverage"] == 1.0
    assert metrics["ate_m"]["rmse"] <= 0.0095
