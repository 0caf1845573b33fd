"""Steps of a demo: progress with the time that is left, and results that a second call keeps."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cohdc_train.errors import CohdcError
from cohdc_train.files import check_folder, files_below, list_files, remove_listed, write_json

VERB = "demo"
STATE = "demo.json"  # written first, so that a later call knows the folder as its own
FOLDERS = ("data", "sequence", "train", "slam")
FILES = (
    STATE,
    "model.onnx",
    "model.onnx.json",
    "result.png",
    "demo.webp",
    "report.html",
    "summary.json",
)

Result = dict[str, Any]


class DemoSteps:
    """Runs named steps in order, prints the time that is left, and skips those that are done."""

    def __init__(self, out: Path, request: Mapping[str, Any], expected_s: dict[str, float]) -> None:
        """Claim the output folder.

        Args:
            out: new or empty folder, or one of a former demo. Steps of the same request are kept;
                files of another request are removed.
            request: what decides the results: plan, seed, version.
            expected_s: step -> expected duration, s, in the order of the steps.
        """
        self._out = out
        self._request = dict(request)
        self._expected_s = expected_s
        self._pace = 1.0  # measured over expected duration of the steps that ran
        self._done: dict[str, Result] = {}
        self.seconds: dict[str, float] = {}
        self._claim()

    def run(self, name: str, title: str, work: Callable[[], Result]) -> Result:
        """Run a step, or return the result of the former call that finished it.

        Args:
            name: key of the step in `expected_s`.
            title: what the user reads.
            work: does the step; its result can be written as JSON.
        """
        names = list(self._expected_s)
        label = f"[{names.index(name) + 1}/{len(names)}] {title}"
        if name in self._done:
            print(f"{label}: done before, {self.seconds[name]:.0f} s", flush=True)
            return self._done[name]

        print(f"{label} (about {_duration(self._left_s())} left)", flush=True)
        started = time.monotonic()
        try:
            result = work()
        finally:
            list_files(self._out, VERB, _own_files(self._out))
        self.seconds[name] = round(time.monotonic() - started, 1)
        self._done[name] = result
        self._update_pace()
        self._save()
        return result

    def _left_s(self) -> float:
        expected = sum(s for name, s in self._expected_s.items() if name not in self._done)
        return self._pace * expected

    def _update_pace(self) -> None:
        """Compare steps that ran with their expected duration; the training's is fixed."""
        ran = [name for name in self.seconds if name != "train"]
        expected = sum(self._expected_s[name] for name in ran)
        if expected:
            self._pace = max(0.5, sum(self.seconds[name] for name in ran) / expected)

    def _claim(self) -> None:
        if self._out.exists() and not self._out.is_dir():
            raise CohdcError(f"{self._out}: is a file; --out names a folder")
        state = self._out / STATE
        if self._out.is_dir() and any(self._out.iterdir()) and not state.is_file():
            raise CohdcError(
                f"{self._out}: not empty and not from a former demo; give another --out"
            )
        check_folder(self._out, VERB, _own_files(self._out))
        former = _read_state(state)
        if former.get("request") == json.loads(json.dumps(self._request)):
            self._done = former["results"]
            self.seconds = former["seconds"]
            return
        remove_listed(self._out, VERB)
        list_files(self._out, VERB, FILES)
        self._save()

    def _save(self) -> None:
        content = {"request": self._request, "results": self._done, "seconds": self.seconds}
        write_json(self._out / STATE, content)


def _read_state(path: Path) -> dict[str, Any]:
    """Return the content of demo.json; empty where it is missing or of another version."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    complete = isinstance(content, dict) and {"request", "results", "seconds"} <= set(content)
    return content if complete else {}


def _own_files(out: Path) -> list[str]:
    """Return the names of the files that lie where a demo writes, relative to its folder."""
    files = [name for name in FILES if (out / name).exists()]
    return files + [f"{name}/{file}" for name in FOLDERS for file in files_below(out / name)]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
