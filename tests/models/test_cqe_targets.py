"""CQE targets: known answers, Boundary IoU against faster-coco-eval, and mini-masks."""

import math

import numpy as np
import pytest
import torch
from faster_coco_eval.core import mask as oracle
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from cohdc_train.models.cqe_targets import boundary_band_px, boundary_iou, cqe_targets
from cohdc_train.models.gt_masks import GroundTruthMasks


def _true(masks):
    return GroundTruthMasks.from_target({"masks": masks}, torch.arange(len(masks)))


def _scene(rows=slice(20, 60), columns=slice(10, 50)):
    truth = torch.zeros(1, 100, 100, dtype=torch.uint8)
    truth[0, rows, columns] = 1
    return truth


def test_perfect_mask_in_a_tight_box_has_quality_one():
    box = torch.tensor([[10.0, 20.0, 50.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _true(_scene()), torch.tensor([0]))
    assert target.item() == pytest.approx(1.0, abs=1e-5)


def test_truth_outside_the_box_counts():
    """Check a box on half of the object, filled by the mask: IoU 1/2 with the whole object."""
    box = torch.tensor([[10.0, 20.0, 30.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _true(_scene()), torch.tensor([0]))
    assert target.item() == pytest.approx(0.5, abs=0.01)


def test_mask_larger_than_the_object_is_punished():
    box = torch.tensor([[10.0, 20.0, 90.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _true(_scene()), torch.tensor([0]))
    assert target.item() == pytest.approx(0.5, abs=0.02)


def test_empty_mask_has_quality_zero():
    box = torch.tensor([[10.0, 20.0, 50.0, 60.0]])
    assert (
        cqe_targets(torch.zeros(1, 28, 28), box, _true(_scene()), torch.tensor([0])).item() == 0.0
    )


def test_each_box_is_compared_with_its_object():
    truth = torch.cat([_scene(), _scene(slice(60, 100), slice(60, 100))])
    boxes = torch.tensor([[60.0, 60.0, 100.0, 100.0], [10.0, 20.0, 50.0, 60.0]])
    target = cqe_targets(torch.ones(2, 28, 28), boxes, _true(truth), torch.tensor([1, 0]))
    torch.testing.assert_close(target, torch.ones(2), atol=1e-5, rtol=0)


def _ciou_target(box, mask=None):
    mask = torch.ones(1, 28, 28) if mask is None else mask
    return cqe_targets(mask, torch.tensor([box]), _true(_scene()), torch.tensor([0]), "ciou").item()


def test_ciou_of_a_perfect_mask_is_one():
    assert _ciou_target([10.0, 20.0, 50.0, 60.0]) == pytest.approx(1.0, abs=1e-5)


def test_ciou_of_a_shifted_mask():
    # 40 x 40 against 40 x 40, 10 px to the right: IoU 30 / 50, rho^2 = 100, c^2 = 50^2 + 40^2, same
    # aspect
    assert _ciou_target([20.0, 20.0, 60.0, 60.0]) == pytest.approx(
        0.5 * (1 + 0.6 - 100 / 4100), abs=1e-5
    )


def test_ciou_of_a_mask_of_another_aspect():
    # the upper half: IoU 1 / 2, rho^2 = 100, c^2 = 2 * 40^2
    v = 4 / math.pi**2 * (math.atan(2) - math.atan(1)) ** 2
    expected = 0.5 - 100 / 3200 - v * v / (0.5 + v)
    assert _ciou_target([10.0, 20.0, 50.0, 40.0]) == pytest.approx(0.5 * (1 + expected), abs=1e-5)


def test_ciou_counts_the_predicted_mask_and_not_its_box():
    mask = torch.zeros(1, 28, 28)
    mask[0, :, :14] = 1  # the left half of a box twice as wide as the object
    assert _ciou_target([10.0, 20.0, 90.0, 60.0], mask) == pytest.approx(1.0, abs=1e-5)


def test_ciou_target_of_masks_that_do_not_meet_is_zero():
    assert _ciou_target([60.0, 70.0, 90.0, 90.0]) == 0.0
    assert _ciou_target([10.0, 20.0, 50.0, 60.0], torch.zeros(1, 28, 28)) == 0.0


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(0, 60)] * 2), st.tuples(*[st.floats(5, 40)] * 2), st.integers(0, 99))
def test_ciou_never_exceeds_iou(corner, extent, seed):
    box = torch.tensor([[*corner, corner[0] + extent[0], corner[1] + extent[1]]])
    mask = torch.rand((1, 28, 28), generator=torch.Generator().manual_seed(seed))
    iou, both = (
        cqe_targets(mask, box, _true(_scene()), torch.tensor([0]), kind).item()
        for kind in ("iou", "ciou")
    )
    assert 0 <= both <= 0.5 * (1 + iou) + 1e-6
    assert (both > 0) == (iou > 0)


blobs = st.lists(
    st.tuples(st.integers(0, 44), st.integers(0, 56), st.integers(1, 40), st.integers(1, 40)),
    max_size=3,
)


def _drawn(rectangles, size=(48, 64)):
    mask = torch.zeros(*size, dtype=torch.bool)
    for top, left, height, width in rectangles:
        mask[top : top + height, left : left + width] = True
    return mask


@settings(max_examples=60, deadline=None)
@given(blobs, blobs)
def test_boundary_iou_equals_faster_coco_eval(one, other):
    a, b = _drawn(one), _drawn(other)
    bands = [
        oracle.rleToBoundary(oracle.encode(np.asfortranarray(m.numpy(), dtype=np.uint8)))
        for m in (a, b)
    ]
    expected = float(oracle.iou([bands[0]], [bands[1]], [0])[0, 0]) if a.any() or b.any() else 0.0
    assert boundary_iou(a, b, boundary_band_px(48, 64)).item() == pytest.approx(expected, abs=1e-6)


def test_image_edge_is_contour():
    half = _drawn([(0, 0, 48, 32)])
    inner = _drawn([(2, 2, 44, 28)])
    assert boundary_iou(half, half & ~inner, 2).item() == 1.0


def _laid_over(mask, box, size):
    """cohdc_train.masks.paste_roi_mask, exactly."""
    y, x = (np.arange(n) + 0.5 for n in size)
    u, v = (
        (at - low) / (high - low) * 28 - 0.5
        for at, low, high in ((x, box[0], box[2]), (y, box[1], box[3]))
    )
    sampled = map_coordinates(mask, np.meshgrid(v, u, indexing="ij"), order=1, mode="nearest")
    inside = ((y >= box[1]) & (y < box[3]))[:, None] & (x >= box[0]) & (x < box[2])
    return torch.from_numpy((sampled > 0.5) & inside)


@settings(max_examples=40, deadline=None)
@given(
    blobs.filter(bool),
    st.tuples(*[st.floats(-4, 30)] * 2),
    st.tuples(*[st.floats(4, 34)] * 2),
    st.integers(0, 99),
)
@example(rectangles=[(17, 1, 31, 2)], corner=(0.0, 18.0), extent=(4.0, 31.0), seed=2)
def test_canvas_targets_equal_those_of_pasted_masks(rectangles, corner, extent, seed):
    """Compare the targets with the masks that `encode_detections` pastes and Boundary AP scores.

    The box leaves the canvas.

    Held against the paste's rule in double precision: OpenCV's own takes coordinates to a 32nd of a
    cell.
    """
    truth = _drawn(rectangles)
    box = torch.tensor([corner[0], corner[1], corner[0] + extent[0], corner[1] + extent[1]])
    mask = torch.nn.functional.interpolate(
        torch.rand((1, 1, 4, 4), generator=torch.Generator().manual_seed(seed)),
        (28, 28),
        mode="bilinear",
    )[0]
    pasted = _laid_over(mask[0].numpy().astype(float), (box + 10).numpy().astype(float), (68, 84))
    whole = torch.zeros(68, 84, dtype=torch.bool)
    whole[10:58, 10:74] = truth
    iou = ((pasted & whole).sum() / (pasted | whole).sum().clamp(min=1)).item()
    boundary = boundary_iou(pasted, whole, 2).item()
    true, matched = _true(truth[None].to(torch.uint8)), torch.tensor([0])
    # a pixel whose value lies on .5 to the last bit may fall to either side
    assert cqe_targets(mask, box[None], true, matched, "boundary_iou", [2]).item() == pytest.approx(
        boundary, abs=0.02
    )
    assert cqe_targets(mask, box[None], true, matched, "min", [2]).item() == pytest.approx(
        min(iou, boundary), abs=0.02
    )


def _mini(mask, side=56):
    rows, columns = (torch.nonzero(mask.any(dim=d))[:, 0] for d in (1, 0))
    frame = torch.tensor(
        [[columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]], dtype=torch.float32
    )
    whole = GroundTruthMasks(mask[None], torch.tensor([[0.0, 0.0, mask.shape[1], mask.shape[0]]]))
    rasters = whole.coverage(frame, torch.tensor([0]), (side, side)).half()
    return GroundTruthMasks.from_target({"masks": rasters, "frames": frame}, torch.tensor([0]))


def test_mini_mask_replaces_the_whole_one():
    y, x = torch.meshgrid(torch.arange(200), torch.arange(240), indexing="ij")
    disc = ((x - 100) ** 2 + (y - 90) ** 2 < 70**2) | ((x - 170).abs() + (y - 140).abs() < 40)
    box, matched = torch.tensor([[20.0, 30.0, 190.0, 170.0]]), torch.tensor([0])
    whole, mini = _true(disc[None].to(torch.uint8)), _mini(disc)
    assert mini.areas().item() == pytest.approx(whole.areas().item(), rel=2e-3)
    exact, projected = (t.coverage(box, matched, (28, 28)) for t in (whole, mini))
    assert (exact - projected).abs().mean() < 0.01
    mask = (exact > 0.3).float()
    for kind in ("iou", "ciou", "boundary_iou", "min"):
        one, other = (cqe_targets(mask, box, t, matched, kind, [5]).item() for t in (whole, mini))
        assert other == pytest.approx(one, abs=0.02)


def test_projection_of_a_mini_mask_known_answer():
    """Check a 2 x 2 mini-mask over 20 x 20 px whose left half is full."""
    target = {
        "masks": torch.tensor([[[1.0, 0.0], [1.0, 0.0]]]),
        "frames": torch.tensor([[10.0, 10.0, 30.0, 30.0]]),
    }
    mini = GroundTruthMasks.from_target(target, torch.tensor([0]))
    assert mini.areas().tolist() == [200.0]
    assert (
        mini.coverage(torch.tensor([[10.0, 10.0, 30.0, 30.0]]), torch.tensor([0]), (1, 1)).item()
        == 0.5
    )
    assert (
        mini.coverage(torch.tensor([[40.0, 10.0, 60.0, 30.0]]), torch.tensor([0]), (1, 1)).item()
        == 0.0
    )


def test_frames_must_fit_the_rasters():
    with pytest.raises(ValueError, match="do not agree"):
        GroundTruthMasks(torch.zeros(2, 28, 28), torch.zeros(1, 4))
