"""Pages in a real browser: nothing overflows, figures open large, dark is dark."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from browser import CHROMIUM, Browser, browser_on
from report_runs import write_slam_run, write_training, write_truth

from cohdc_train.report import report

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium here: apt-get install chromium"
)

LONG = "a_class_whose_name_has_no_place_to_break_" * 3
PAGES = ("slam.html", "comparison.html", "training.html")
WIDTHS = (400, 1200, 2000)
MEASURE = """
for (const width of WIDTHS) {
  frame.style.width = `${width}px`;
  await new Promise((done) => setTimeout(done, 100));
  const scale = (matrix) => Math.hypot(matrix.a, matrix.b);
  const right = (item) => item.getBoundingClientRect().right;
  const all = [...page.document.querySelectorAll("body *")];
  const inside = (item) => item.closest(".scroll, dialog, svg") || right(item) <= width + 1;
  const outside = all.filter((item) => !inside(item));
  const texts = [...page.document.querySelectorAll("main svg text")].filter((item) =>
    item.getClientRects().length);
  answer[width] = {
    width: page.innerWidth,
    content: page.document.documentElement.scrollWidth,
    outside: outside.map((item) => item.outerHTML.slice(0, 120)),
    letters: texts.map((item) => parseFloat(item.style.fontSize) * scale(item.getScreenCTM())),
  };
}
""".replace("WIDTHS", str(list(WIDTHS)))
OPEN_LARGE = """
const media = [...page.document.querySelectorAll(".media")].at(-1);
const dialog = page.document.querySelector("dialog");
const width = (item) => item.querySelector("svg, img").getBoundingClientRect().width;
answer.before = dialog.open;
media.click();
answer.after = dialog.open;
answer.small = width(media);
answer.large = width(dialog);
dialog.querySelector("button").click();
answer.closed = !dialog.open;
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Open a browser on the pages of a run, a comparison, and a training."""
    folder = tmp_path_factory.mktemp("pages")
    write_truth(folder / "sequence")
    lost = range(20, 35)
    runs = [
        write_slam_run(folder / "plain", 0.1, lost, folder / "sequence", worst=(20, 50)),
        write_slam_run(folder / f"with_{LONG}", 0.001, (), folder / "sequence"),
    ]
    report(runs[:1], out=folder / PAGES[0])
    report(runs, out=folder / PAGES[1])
    training = write_training(folder / "training", ("car", LONG))
    report([training], out=folder / PAGES[2])
    with browser_on(folder) as opened:
        yield opened


@pytest.mark.parametrize("page", PAGES)
def test_page_fits_into_its_window(browser: Browser, page: str) -> None:
    for width, found in browser.run(page, WIDTHS[-1], MEASURE).items():
        assert found["width"] == int(width)
        assert found["content"] <= int(width)
        assert found["outside"] == []
        assert len(found["letters"]) > 20
        assert min(found["letters"]) >= 9, f"px of a plot's letters in a window of {width} px"


def test_click_opens_a_figure_large(browser: Browser) -> None:
    found = browser.run(PAGES[0], 1200, OPEN_LARGE)
    assert not found["before"]
    assert found["after"]
    assert found["large"] > 1.5 * found["small"]
    assert found["closed"]


def test_page_follows_the_color_scheme(browser: Browser, tmp_path: Path) -> None:
    levels = {}
    for dark in (False, True):
        file = tmp_path / f"{dark}.png"
        browser.screenshot(PAGES[0], 1200, 900, file, dark)
        levels[dark] = float(cv2.imread(str(file)).mean())
    assert levels[False] > 200
    assert levels[True] < 70
