"""A file is written whole or not at all."""

import json

import pytest

from cohdc_train import files


def test_content_arrives_and_nothing_else_is_left(tmp_path):
    files.write_json(tmp_path / "a.json", {"ü": [1, 2.5]})
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == {"ü": [1, 2.5]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_the_old_file_survives_content_that_cannot_be_written(tmp_path):
    files.write_text(tmp_path / "a.json", "old")
    with pytest.raises(TypeError):
        files.write_json(tmp_path / "a.json", {"x": object()})
    assert (tmp_path / "a.json").read_text() == "old"
