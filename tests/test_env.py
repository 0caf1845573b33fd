"""`cohdc env` finds problems: shown by planted packages in a process of their own."""

import re
import tomllib
from pathlib import Path

import pytest

from cohdc_train import env as environment
from cohdc_train.env import BASE, TRAIN, Problem, env, find_problems
from cohdc_train.errors import CohdcError

HEALTHY: dict[str, str | None] = {**dict.fromkeys(BASE, "1.0"), **dict.fromkeys(TRAIN)}


def test_base_lists_all_required_packages() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert [re.split(r"[\[><=!]", needed)[0] for needed in project["dependencies"]] == list(BASE)


def plant(folder: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """Plant modules before the installed ones in the probes' processes, cv2 and onnxruntime too."""
    empty = {
        "cv2": "def setNumThreads(n): pass",
        "onnxruntime": "def get_available_providers(): return ['CPU']",
    }
    for name, code in {**empty, **modules}.items():
        (folder / f"{name}.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_healthy_base_install_has_no_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(tmp_path, monkeypatch)
    assert find_problems(HEALTHY) == (["onnxruntime providers: CPU"], [])


def test_mismatched_pair_is_found_with_its_fix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = (
        "class cuda:\n device_count = is_available = staticmethod(int)\nclass version: cuda = None"
    )
    plant(
        tmp_path,
        monkeypatch,
        torch=torch,
        torchvision="raise RuntimeError('operator torchvision::nms does not exist')",
    )
    lines, problems = find_problems({**HEALTHY, "torch": "2.14.0+cpu", "torchvision": "0.29.0"})
    assert "torch devices: 0 CUDA; CPU only, built for CPU" in lines
    (problem,) = problems
    assert "torch 2.14.0+cpu and torchvision 0.29.0 do not match" in problem.description
    assert "operator torchvision::nms does not exist" in problem.description
    assert problem.fix.startswith("pip install --force-reinstall torch torchvision")


def test_broken_torch_is_not_blamed_on_the_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(tmp_path, monkeypatch, torch="raise OSError('libc10.so: cannot open')")
    (problem,) = find_problems({**HEALTHY, "torch": "2.14.0", "torchvision": "0.29.0"})[1]
    assert problem.description == "torch does not load: OSError: libc10.so: cannot open"


def test_two_opencvs_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch)
    info = tmp_path / "opencv_python-4.10.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 4.10.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (problem,) = find_problems(HEALTHY)[1]
    assert "overwrite each other" in problem.description
    assert problem.fix.startswith("pip uninstall -y opencv-python opencv-python-headless")


@pytest.mark.parametrize("version", ["2.6.2", "2.6.3"])
def test_malicious_lightning_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    plant(tmp_path, monkeypatch)
    (problem,) = find_problems({**HEALTHY, "lightning": version})[1]
    assert problem.description == f"lightning {version} was a malicious release"


def test_absent_base_package_is_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch)
    (problem,) = find_problems({**HEALTHY, "scipy": None})[1]
    assert problem == Problem("scipy absent", "pip install scipy")


def test_absent_extra_is_mentioned_and_no_problem(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment, "_version", {**HEALTHY, "cohdc-train": "0.1.0"}.get)
    monkeypatch.setattr(environment, "find_problems", lambda versions: (["a line"], []))
    env()
    printed = capsys.readouterr().out
    assert "the train extra is absent" in printed
    assert "a line\nno problem found" in printed


def test_problem_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    problems = [
        Problem("first is broken", "reinstall it"),
        Problem("second is broken", "reinstall that"),
    ]
    monkeypatch.setattr(environment, "find_problems", lambda versions: ([], problems))
    with pytest.raises(CohdcError, match=r"^first is broken; fix: reinstall it \(and 1 more\)$"):
        env()
    assert "PROBLEM second is broken\n        fix: reinstall that" in capsys.readouterr().out
