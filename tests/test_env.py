"""`cohdc env` finds what cannot work, by planted packages in a process of their own."""

import re
import tomllib
from pathlib import Path

import pytest

from cohdc_train import env as environment
from cohdc_train.env import BASE, TRAIN, Fault, env, inspect
from cohdc_train.errors import CohdcError

HEALTHY: dict[str, str | None] = {**dict.fromkeys(BASE, "1.0"), **dict.fromkeys(TRAIN)}


def test_it_knows_of_every_package_that_is_needed() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert [re.split(r"[\[><=!]", needed)[0] for needed in project["dependencies"]] == list(BASE)


def plant(folder: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """Modules that come before the installed ones in the probes' processes; cv2 and onnxruntime are
    planted too.
    """
    empty = {
        "cv2": "def setNumThreads(n): pass",
        "onnxruntime": "def get_available_providers(): return ['CPU']",
    }
    for name, code in {**empty, **modules}.items():
        (folder / f"{name}.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_healthy_base_install_has_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch)
    assert inspect(HEALTHY) == (["onnxruntime providers: CPU"], [])


def test_mismatched_pair_is_found_and_mended(
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
    lines, faults = inspect({**HEALTHY, "torch": "2.14.0+cpu", "torchvision": "0.29.0"})
    assert "torch devices: 0 CUDA; CPU only, built for CPU" in lines
    (fault,) = faults
    assert "torch 2.14.0+cpu and torchvision 0.29.0 are no pair" in fault.what
    assert "operator torchvision::nms does not exist" in fault.what
    assert fault.mend.startswith("pip install --force-reinstall torch torchvision")


def test_broken_torch_is_not_blamed_on_the_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(tmp_path, monkeypatch, torch="raise OSError('libc10.so: cannot open')")
    (fault,) = inspect({**HEALTHY, "torch": "2.14.0", "torchvision": "0.29.0"})[1]
    assert fault.what == "torch does not load: OSError: libc10.so: cannot open"


def test_two_opencvs_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch)
    info = tmp_path / "opencv_python-4.10.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 4.10.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (fault,) = inspect(HEALTHY)[1]
    assert "overwrite each other" in fault.what
    assert fault.mend.startswith("pip uninstall -y opencv-python opencv-python-headless")


@pytest.mark.parametrize("version", ["2.6.2", "2.6.3"])
def test_malicious_lightning_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    plant(tmp_path, monkeypatch)
    (fault,) = inspect({**HEALTHY, "lightning": version})[1]
    assert fault.what == f"lightning {version} was a malicious release"


def test_absent_base_package_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch)
    (fault,) = inspect({**HEALTHY, "scipy": None})[1]
    assert fault == Fault("scipy absent", "pip install scipy")


def test_verb_tells_an_absent_extra_and_ends_well(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment, "_version", {**HEALTHY, "cohdc-train": "0.1.0"}.get)
    monkeypatch.setattr(environment, "inspect", lambda versions: (["a line"], []))
    env()
    printed = capsys.readouterr().out
    assert "the train extra is absent" in printed
    assert "a line\nno fault found" in printed


def test_verb_fails_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    faults = [Fault("first is broken", "mend it"), Fault("second is broken", "mend that")]
    monkeypatch.setattr(environment, "inspect", lambda versions: ([], faults))
    with pytest.raises(CohdcError, match=r"^first is broken; mend: mend it \(and 1 more\)$"):
        env()
    assert "FAULT second is broken\n      mend: mend that" in capsys.readouterr().out
