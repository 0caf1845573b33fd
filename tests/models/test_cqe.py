"""CQE targets and loss: known answers."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.models.cqe import CQEHead, cqe_loss, cqe_targets


def _scene(rows=slice(20, 60), columns=slice(10, 50)):
    truth = torch.zeros(1, 100, 100, dtype=torch.uint8)
    truth[0, rows, columns] = 1
    return truth


def test_a_perfect_mask_in_a_tight_box_has_quality_one():
    box = torch.tensor([[10.0, 20.0, 50.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _scene(), torch.tensor([0]))
    assert target.item() == pytest.approx(1.0, abs=1e-5)


def test_truth_outside_the_box_counts():
    """The box holds half of the object and the mask fills it: IoU 1/2 with the whole, though 1 inside the box."""
    box = torch.tensor([[10.0, 20.0, 30.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _scene(), torch.tensor([0]))
    assert target.item() == pytest.approx(0.5, abs=0.01)


def test_a_mask_larger_than_the_object_is_punished():
    box = torch.tensor([[10.0, 20.0, 90.0, 60.0]])
    target = cqe_targets(torch.ones(1, 28, 28), box, _scene(), torch.tensor([0]))
    assert target.item() == pytest.approx(0.5, abs=0.02)


def test_an_empty_mask_has_quality_zero():
    box = torch.tensor([[10.0, 20.0, 50.0, 60.0]])
    assert cqe_targets(torch.zeros(1, 28, 28), box, _scene(), torch.tensor([0])).item() == 0.0


def test_each_box_is_held_against_its_own_object():
    truth = torch.cat([_scene(), _scene(slice(60, 100), slice(60, 100))])
    boxes = torch.tensor([[60.0, 60.0, 100.0, 100.0], [10.0, 20.0, 50.0, 60.0]])
    target = cqe_targets(torch.ones(2, 28, 28), boxes, truth, torch.tensor([1, 0]))
    torch.testing.assert_close(target, torch.ones(2), atol=1e-5, rtol=0)


def _ciou_target(box, mask=None):
    mask = torch.ones(1, 28, 28) if mask is None else mask
    return cqe_targets(mask, torch.tensor([box]), _scene(), torch.tensor([0]), "ciou").item()


def test_ciou_of_a_perfect_mask_is_one():
    assert _ciou_target([10.0, 20.0, 50.0, 60.0]) == pytest.approx(1.0, abs=1e-5)


def test_ciou_of_a_shifted_mask():
    # 40 x 40 against 40 x 40, 10 px to the right: IoU 30 / 50, rho^2 = 100, c^2 = 50^2 + 40^2, same aspect
    assert _ciou_target([20.0, 20.0, 60.0, 60.0]) == pytest.approx(0.5 * (1 + 0.6 - 100 / 4100), abs=1e-5)


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
    iou, both = (cqe_targets(mask, box, _scene(), torch.tensor([0]), kind).item() for kind in ("iou", "ciou"))
    assert 0 <= both <= 0.5 * (1 + iou) + 1e-6
    assert (both > 0) == (iou > 0)


def test_loss_is_half_the_squared_error_over_positive_targets():
    quality = torch.tensor([[0.2, 0.9], [0.5, 0.4], [0.0, 0.0]])
    loss = cqe_loss(quality, torch.tensor([1, 0, 0]), torch.tensor([0.7, 0.9, 0.0]))
    assert loss.item() == pytest.approx(0.5 * (0.2**2 + 0.4**2) / 2)


def test_without_a_positive_the_loss_is_zero_and_reaches_every_parameter():
    head = CQEHead(8, 2, channels=8, fc=16)
    loss = cqe_loss(
        head(torch.rand(0, 8, 14, 14), torch.rand(0, 28, 28)), torch.zeros(0, dtype=torch.long), torch.zeros(0)
    )
    loss.backward()
    assert loss.item() == 0.0
    assert all(p.grad is not None for p in head.parameters())


@pytest.mark.parametrize("fusion", ["concat", "multiply", "add"])
def test_the_head_learns_from_the_mask_it_is_shown(fusion):
    torch.manual_seed(0)
    head = CQEHead(4, 1, channels=8, fc=16, fusion=fusion)
    features, masks = torch.rand(2, 4, 14, 14), torch.rand(2, 28, 28, requires_grad=True)
    quality = head(features, masks)
    quality.sum().backward()
    assert quality.shape == (2, 1)
    assert masks.grad is not None
    assert masks.grad.abs().sum() > 0


def test_the_fusions_join_feature_and_mask_as_they_say():
    feature, mask = torch.full((1, 2, 14, 14), 3.0), torch.zeros(1, 28, 28)
    mask[0, 0, 1] = 0.5  # the upper left cell's largest
    concat, multiply, add = (
        CQEHead(2, 1, 8, 8, fusion=f).fuse(feature, mask)[0] for f in ("concat", "multiply", "add")
    )
    assert concat.shape == (3, 14, 14)
    assert concat[:, 0, 0].tolist() == [3, 3, 0.5]
    assert concat[:, 0, 1].tolist() == [3, 3, 0]
    assert multiply.shape == (2, 14, 14)
    assert multiply[:, 0, 0].tolist() == [1.5, 1.5]
    assert multiply[:, 5:].abs().sum() == 0
    assert add.shape == (2, 28, 28)
    assert add[:, 0, 1].tolist() == [3.5, 3.5]
    assert torch.all(add[:, 1:] == 3)
