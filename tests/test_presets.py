"""Shipped configurations are found by name from any folder."""

import pytest

from cohdc_train.errors import CohdcError
from cohdc_train.presets import config_path


def test_a_shipped_config_is_found_with_and_without_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert config_path("slam/freiburg1.yaml").is_file()
    assert config_path("configs/slam/freiburg1.yaml") == config_path("slam/freiburg1.yaml")


def test_an_existing_file_of_the_user_wins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slam").mkdir()
    (tmp_path / "slam" / "freiburg1.yaml").write_text("fx: 1")
    assert config_path("slam/freiburg1.yaml").read_text() == "fx: 1"


def test_an_unknown_name_is_one_line():
    with pytest.raises(CohdcError, match=r"nowhere\.yaml: no such file"):
        config_path("nowhere.yaml")
