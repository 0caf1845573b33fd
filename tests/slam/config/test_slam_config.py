"""SlamConfig: reading, overriding, and range checks."""

from dataclasses import asdict, fields, is_dataclass
from pathlib import Path

import pytest
import yaml

from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig


def test_override_changes_one_option_and_keeps_the_rest() -> None:
    config = SlamConfig().override({"loops.enabled": False, "seed": 3, "motion.max_gap_s": 1})
    assert not config.loops.enabled
    assert config.seed == 3
    assert config.motion.max_gap_s == 1.0
    assert config.loops.candidates == SlamConfig().loops.candidates
    assert (
        config.override({"loops.enabled": True, "seed": 0, "motion.max_gap_s": 0.2}) == SlamConfig()
    )


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("loops.enabeld", False, "SlamConfig: no option loops.enabeld; did you mean enabled?"),
        ("loop.enabled", False, "SlamConfig: no option loop; did you mean loops?"),
        ("loops", False, "SlamConfig: loops is False, not a mapping of options"),
        ("loops.enabled", "no", "SlamConfig: loops.enabled is 'no', not bool"),
        ("features.max_keypoints", 1.5, "SlamConfig: features.max_keypoints is 1.5, not int"),
        ("features.max_keypoints", 0, "features.max_keypoints is 0; allowed: 1 or more"),
        ("masks.min_score", 1.5, "masks.min_score is 1.5; allowed: 0 to 1"),
        (
            "masks.quality_dilation",
            float("nan"),
            "masks.quality_dilation is nan; allowed: 0 or more",
        ),
        ("motion.acceleration_sigma", (1, 0), "motion.acceleration_sigma is 0; allowed: above 0"),
        ("motion.acceleration_sigma", (1,), "motion.acceleration_sigma has 1 numbers, not 2"),
        ("seed", -1, "settings.seed is -1; allowed: 0 or more"),
    ],
)
def test_wrong_option_is_named_with_value_and_range(
    option: str, value: object, message: str
) -> None:
    with pytest.raises(DataError) as error:
        SlamConfig().override({option: value})
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_yaml_round_trip_keeps_every_option(tmp_path: Path) -> None:
    config = SlamConfig().override(
        {"masks.dynamic_classes": ["person"], "features.fast_thresholds": [30, 9], "seed": 7}
    )
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(plain(config)))
    assert SlamConfig.from_yaml(tmp_path / "settings.yaml") == config
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"out": "x", "settings": plain(config)}))
    assert SlamConfig.from_yaml(tmp_path / "config.yaml") == config


def plain(config: SlamConfig) -> object:
    """Return the config as YAML holds it, without tuples."""

    def as_yaml(value: object) -> object:
        if isinstance(value, dict):
            return {name: as_yaml(inner) for name, inner in value.items()}
        return list(value) if isinstance(value, tuple) else value

    return as_yaml(asdict(config))


@pytest.mark.parametrize("text", ["loops: {enabled: 3}", "loops: 3", "[1, 2]", "a: [", "x: 1"])
def test_unusable_yaml_is_refused_in_one_line_that_names_the_file(
    tmp_path: Path, text: str
) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        SlamConfig.from_yaml(path)
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value).splitlines()) == 1


def test_missing_yaml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.yaml: cannot be read"):
        SlamConfig.from_yaml(tmp_path / "none.yaml")


def test_every_option_is_described_in_the_docstring_of_its_section() -> None:
    for section in fields(SlamConfig):
        assert f"        {section.name}: " in str(SlamConfig.__doc__)
        config = getattr(SlamConfig(), section.name)
        if is_dataclass(config):
            for option in fields(config):
                assert f"        {option.name}: " in str(config.__doc__)
