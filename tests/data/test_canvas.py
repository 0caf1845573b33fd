"""Canvas size chosen from image sizes."""

from hypothesis import given
from hypothesis import strategies as st

from cohdc_train.data.canvas import GRID_PX, MAX_AREA_PX, choose_canvas

sides = st.integers(1, 6000)


def test_canvas_follows_median_size() -> None:
    assert choose_canvas([(416, 416)] * 3) == (416, 416)
    assert choose_canvas([(480, 640)] * 3) == (480, 640)
    assert choose_canvas([(1080, 1920)]) == (416, 736)
    assert choose_canvas([(640, 480), (640, 480), (480, 640)]) == (640, 480)


@given(st.lists(st.tuples(sides, sides), min_size=1, max_size=20))
def test_canvas_is_on_the_grid_and_not_larger_than_allowed(sizes: list[tuple[int, int]]) -> None:
    height, width = choose_canvas(sizes)
    assert height % GRID_PX == width % GRID_PX == 0
    assert (height - GRID_PX) * (width - GRID_PX) <= MAX_AREA_PX
