"""The CQE head and its loss: known answers."""

import pytest
import torch

from cohdc_train.models.cqe_head import CQEHead, cqe_loss


def test_loss_is_half_the_squared_error_over_positive_targets():
    quality = torch.tensor([[0.2, 0.9], [0.5, 0.4], [0.0, 0.0]])
    loss = cqe_loss(quality, torch.tensor([1, 0, 0]), torch.tensor([0.7, 0.9, 0.0]))
    assert loss.item() == pytest.approx(0.5 * (0.2**2 + 0.4**2) / 2)


def test_without_a_positive_the_loss_is_zero_and_reaches_every_parameter():
    head = CQEHead(8, 2, channels=8, fc=16)
    loss = cqe_loss(
        head(torch.rand(0, 8, 14, 14), torch.rand(0, 28, 28)),
        torch.zeros(0, dtype=torch.long),
        torch.zeros(0),
    )
    loss.backward()
    assert loss.item() == 0.0
    assert all(p.grad is not None for p in head.parameters())


@pytest.mark.parametrize("fusion", ["concat", "multiply", "add"])
def test_head_learns_from_its_mask(fusion):
    torch.manual_seed(0)
    head = CQEHead(4, 1, channels=8, fc=16, fusion=fusion)
    features, masks = torch.rand(2, 4, 14, 14), torch.rand(2, 28, 28, requires_grad=True)
    quality = head(features, masks)
    quality.sum().backward()
    assert quality.shape == (2, 1)
    assert masks.grad is not None
    assert masks.grad.abs().sum() > 0


def test_fusions_join_feature_and_mask():
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


@pytest.mark.parametrize("fusion", ["concat", "multiply", "add"])
def test_mask_of_56_cells_is_fused_like_one_of_28(fusion):
    torch.manual_seed(0)
    head = CQEHead(3, 2, channels=8, fc=16, fusion=fusion)
    features, mask = torch.rand(2, 3, 14, 14), torch.rand(2, 28, 28)
    finer = mask.repeat_interleave(2, 1).repeat_interleave(2, 2)
    torch.testing.assert_close(head(features, mask), head(features, finer))
