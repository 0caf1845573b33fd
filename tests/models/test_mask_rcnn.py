"""The network against torchvision's Mask R-CNN, its losses at the edges, and overfitting."""

import copy
import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torchvision.models.detection import MaskRCNN as TorchvisionMaskRCNN
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.rpn import RegionProposalNetwork
from torchvision.ops import box_iou

from cohdc_train.models import Detector, MaskRCNN, NetworkConfig, detect
from cohdc_train.models.inference import cut_by_quality
from cohdc_train.models.roi_losses import sample_proposals


def _target(boxes, size=(96, 128), ignore=()):
    masks = torch.zeros(len(boxes), *size, dtype=torch.uint8)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes, strict=True):
        mask[y0:y1, x0:x1] = 1
    return {
        "boxes": torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        "labels": torch.ones(len(boxes), dtype=torch.int64),
        "masks": masks,
        "ignore": torch.tensor(ignore, dtype=torch.float32).reshape(-1, 4),
    }


def _torchvisions(network):
    """Torchvision's detector around the very same modules."""
    config, backbone = network.config, network.backbone
    backbone.out_channels = config.fpn_channels
    heads = network.roi_heads
    return TorchvisionMaskRCNN(
        backbone,
        min_size=config.canvas[0],
        max_size=config.canvas[1],
        rpn_anchor_generator=network.rpn.anchor_generator,
        rpn_head=network.rpn.head,
        rpn_pre_nms_top_n_test=2 * config.proposals[1],
        rpn_post_nms_top_n_test=config.proposals[1],
        box_head=heads.box_head,
        box_predictor=heads.box_predictor,
        box_score_thresh=config.score_threshold,
        box_nms_thresh=config.nms_iou,
        box_detections_per_img=config.detections,
        mask_head=heads.mask_head,
        mask_predictor=heads.mask_predictor,
    ).eval()


def _assert_finds_what_torchvision_finds(network, image):
    with torch.inference_mode():
        expected = _torchvisions(network)([image / 255])[0]
        found = detect(network, [image])[0]
    assert len(found["scores"]) >= 3
    torch.testing.assert_close(found["boxes"], expected["boxes"], atol=1e-3, rtol=0)
    torch.testing.assert_close(found["scores"], expected["scores"], atol=1e-5, rtol=0)
    assert torch.equal(found["labels"] + 1, expected["labels"])


def test_padded_inference_equals_torchvision(opinionated):
    torch.manual_seed(1)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 12, 16), (96, 128))[0]
    image = (image * 255).to(torch.uint8)
    _assert_finds_what_torchvision_finds(opinionated, image)


@pytest.mark.parametrize("backbone", ["mobilenet_v1", "mobilenet_v2"])
def test_network_without_finest_level_learns_and_equals_torchvision(backbone, small_config):
    torch.manual_seed(0)
    changed = {
        "backbone": backbone,
        "rates": ((1,),) * 4,
        "finest_stride": 8,
        "anchor_scales": (32, 64, 128),
    } | {"score_threshold": 0.1}
    network = MaskRCNN(2, dataclasses.replace(small_config, **changed))
    losses = network.losses(torch.rand(1, 3, 96, 128), [_target([[10, 10, 60, 70]])])
    sum(losses.values()).backward()
    assert all(torch.isfinite(loss) for loss in losses.values())
    network.eval()
    with torch.no_grad():
        network.rpn.head.cls_logits.weight.mul_(3)
        network.rpn.head.bbox_pred.weight.mul_(10)
    image = (torch.nn.functional.interpolate(torch.rand(1, 3, 12, 16), (96, 128))[0] * 255).to(
        torch.uint8
    )
    _assert_finds_what_torchvision_finds(network, image)


def test_anchors_equal_torchvision(opinionated):
    generator = opinionated.rpn.anchor_generator
    grids = [(24, 32), (12, 16), (6, 8), (3, 4)]
    strides = [[torch.tensor(s), torch.tensor(s)] for s in (4, 8, 16, 32)]
    expected = generator.grid_anchors(grids, strides)
    for level, (height, width) in enumerate(grids):
        anchors = opinionated.rpn.anchors(level, torch.zeros(2, 3, height, width))
        torch.testing.assert_close(anchors, expected[level])


@pytest.mark.parametrize(
    "canvas", [(96, 128), (80, 120)]
)  # the second is padded for the network, not for its anchors
def test_proposals_and_their_losses_equal_torchvision(opinionated, canvas):
    torch.manual_seed(3)
    images, rpn = torch.rand(2, 3, *canvas), copy.deepcopy(opinionated.rpn).train()
    targets = [_target([[10, 10, 60, 70], [64, 20, 118, 80]], canvas), _target([], canvas)]
    with torch.no_grad():
        features = opinionated.features(images)
    theirs = RegionProposalNetwork.forward
    generator = torch.random.get_rng_state()
    proposals, objectness, boxes = rpn(
        canvas, list(features.values()), targets, opinionated.config.proposals[0]
    )
    torch.random.set_rng_state(generator)
    expected, losses = theirs(
        rpn, ImageList(torch.zeros(2, 3, 96, 128), [canvas] * 2), features, targets
    )
    torch.testing.assert_close(objectness, losses["loss_objectness"])
    torch.testing.assert_close(boxes, losses["loss_rpn_box_reg"])
    for found, wanted in zip(proposals, expected, strict=True):
        assert len(found) >= 10
        torch.testing.assert_close(found, wanted, atol=1e-3, rtol=0)


def test_padding_is_zero_and_scores_fall(opinionated):
    images = torch.zeros(2, 80, 60, 3, dtype=torch.uint8)
    images[1] = torch.randint(0, 255, (80, 60, 3))
    with torch.inference_mode():
        boxes, labels, scores, quality, masks, count = Detector(opinionated)(images)
    assert boxes.shape == (2, 10, 4)
    assert masks.shape == (2, 10, 28, 28)
    for i in range(2):
        n = int(count[i])
        assert torch.all(scores[i, :n] > opinionated.config.score_threshold)
        assert torch.all(scores[i].diff() <= 0)
        assert all(not tensor[i, n:].any() for tensor in (boxes, labels, scores, quality, masks))


@given(seed=st.integers(0, 2**32 - 1), sharpness=st.floats(1.0, 4.0))
def test_quality_cut_maximizes_expected_iou(seed, sharpness):
    """Try all cuts of one mask; expected IoU: expected intersection over expected union."""
    p = (
        sharpness * torch.randn(12, 12, generator=torch.Generator().manual_seed(seed)).double()
    ).sigmoid()
    best_first = p.flatten().sort(descending=True).values
    inside = best_first.cumsum(0)
    united = torch.arange(1, 145) + p.sum() - inside
    best = int((inside / united).argmax())
    cut = cut_by_quality(p[None], (inside / united)[best].reshape(1))[0] > 0.5
    assert torch.equal(cut, p > best_first[best + 1])


def test_perfect_mask_is_cut_at_half_and_none_below_a_fifth():
    p = torch.linspace(0, 1, 101).reshape(1, 1, -1)
    torch.testing.assert_close(cut_by_quality(p, torch.ones(1)), p)
    assert p[cut_by_quality(p, torch.zeros(1)) > 0.5].min().item() == pytest.approx(0.21)


def test_quality_cut_changes_masks_only(opinionated):
    images = torch.randint(
        0, 255, (1, 80, 60, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
    )
    by_quality = MaskRCNN(2, dataclasses.replace(opinionated.config, mask_cut="quality")).eval()
    by_quality.load_state_dict(opinionated.state_dict())
    with torch.inference_mode():
        *found, masks, count = Detector(opinionated)(images)
        *others, moved, other_count = Detector(by_quality)(images)
    quality, n = found[-1], int(count[0])
    assert all(
        torch.equal(one, other)
        for one, other in zip([*found, count], [*others, other_count], strict=True)
    )
    torch.testing.assert_close(moved[0, :n], cut_by_quality(masks[0, :n], quality[0, :n]))
    assert not moved[0, n:].any()
    assert (moved[0, :n] - masks[0, :n]).max() > 0.01


def test_mask_and_cqe_heads_see_detections_only(opinionated):
    passed = {"mask": 0, "cqe": 0}
    heads = {"mask": opinionated.roi_heads.mask_head, "cqe": opinionated.cqe}
    hooks = [
        module.register_forward_pre_hook(
            lambda _, inputs, name=name: passed.update({name: len(inputs[0])})
        )
        for name, module in heads.items()
    ]
    black, noise = (
        torch.zeros(3, 80, 60, dtype=torch.uint8),
        torch.randint(0, 255, (3, 80, 60), dtype=torch.uint8),
    )
    with torch.inference_mode():
        found = detect(opinionated, [black, noise, noise.flip(2)])
    for hook in hooks:
        hook.remove()
    count = sum(len(one["scores"]) for one in found)
    assert 0 < count < 3 * opinionated.config.detections
    # the first row stands for itself even where it is empty, so that no head runs on nothing
    assert passed == dict.fromkeys(passed, count + (not len(found[0]["scores"])))


def test_boxes_stay_inside_an_image_of_any_shape(opinionated):
    with torch.inference_mode():
        for height, width in ((31, 200), (200, 31), (96, 128)):
            found = detect(
                opinionated, [torch.randint(0, 255, (3, height, width), dtype=torch.uint8)]
            )[0]
            limit = torch.tensor([width, height, width, height]) + 1e-3
            assert torch.all(found["boxes"] >= 0)
            assert torch.all(found["boxes"] <= limit)


@pytest.mark.parametrize("head_norm", ["none", "batch"])
def test_losses_of_images_without_objects_are_finite_and_reach_every_parameter(
    small_config, head_norm
):
    network = MaskRCNN(1, dataclasses.replace(small_config, head_norm=head_norm))
    losses = network.losses(torch.rand(2, 3, 96, 128), [_target([]), _target([])])
    sum(losses.values()).backward()
    assert all(torch.isfinite(loss) for loss in losses.values())
    assert losses["cqe"].item() == losses["mask"].item() == losses["box"].item() == 0.0
    assert all(p.grad is not None for name, p in network.cqe.named_parameters())
    assert all(torch.isfinite(value).all() for value in network.state_dict().values())


def test_head_norms_are_trained_with_a_frozen_backbone(small_config):
    network = MaskRCNN(1, dataclasses.replace(small_config, norm="frozen", head_norm="batch"))
    trained = [
        name for name, module in network.named_modules() if isinstance(module, nn.BatchNorm2d)
    ]
    assert {name.rpartition("_blocks")[0] for name in trained if "fpn" in name} == {
        "backbone.fpn.inner",
        "backbone.fpn.layer",
    }
    assert len([name for name in trained if name.startswith("roi_heads.mask_head")]) == 4
    assert not [name for name in trained if name.startswith("backbone.body")]


def test_canvas_that_is_no_multiple_of_32_is_padded(small_config):
    network = MaskRCNN(1, dataclasses.replace(small_config, canvas=(90, 100)))
    losses = network.losses(torch.rand(1, 3, 90, 100), [_target([[10, 10, 60, 70]], (90, 100))])
    assert all(torch.isfinite(loss) for loss in losses.values())
    assert len(detect(network.eval(), [torch.zeros(3, 50, 60, dtype=torch.uint8)])) == 1


def test_background_inside_a_crowd_is_no_negative(small_config):
    network = MaskRCNN(1, small_config)
    anchors = [torch.tensor([[0.0, 0, 20, 20], [64.0, 64, 96, 96], [10.0, 10, 40, 40]])]
    plain, crowded = (
        _target([[10, 10, 40, 40]]),
        _target([[10, 10, 40, 40]], ignore=[[60, 60, 100, 96]]),
    )
    labels = [
        network.rpn.assign_targets_to_anchors(anchors, [t])[0][0].tolist() for t in (plain, crowded)
    ]
    assert labels[0] == [0.0, 0.0, 1.0]
    assert labels[1] == [0.0, -1.0, 1.0]


def test_quality_target_changes_its_loss_only(small_config):
    losses = []
    for goal in ("iou", "ciou", "boundary_iou", "min"):
        torch.manual_seed(0)
        network = MaskRCNN(1, dataclasses.replace(small_config, cqe_target=goal))
        losses.append(network.losses(torch.rand(1, 3, 96, 128), [_target([[10, 10, 60, 70]])]))
    iou, ciou, boundary, smaller = (loss["cqe"].item() for loss in losses)
    assert len({iou, ciou, boundary}) == 3
    assert smaller in (iou, boundary)
    assert len({loss["mask"].item() for loss in losses}) == 1


def test_boxes_keep_their_pixels_in_mixed_precision(small_config):
    """In bfloat16 a box of one pixel at x = 901 has no width, and its regression no logarithm."""
    torch.manual_seed(0)
    network = MaskRCNN(1, dataclasses.replace(small_config, canvas=(96, 1024)))
    targets = [_target([[901, 60, 902, 61], [301, 10, 352, 51]], (96, 1024))]
    with torch.autocast("cpu", torch.bfloat16):
        losses = network.losses(torch.rand(1, 3, 96, 1024), targets)
        features = network.features(torch.rand(1, 3, 96, 1024))
        proposals, *_ = network.rpn((96, 1024), list(features.values()), targets, 100)
        sampled = sample_proposals(network.roi_heads, proposals, targets).boxes
    assert all(torch.isfinite(loss) for loss in losses.values())
    assert features["0"].dtype == torch.bfloat16
    assert sampled[0].dtype == network.rpn.anchors(0, features["0"]).dtype == torch.float32
    assert (sampled[0] == targets[0]["boxes"][0]).all(dim=1).any()


def test_masks_of_56_cells_train_and_infer(small_config):
    network = MaskRCNN(1, dataclasses.replace(small_config, mask_size=56, cqe="add"))
    sum(
        network.losses(torch.rand(1, 3, 96, 128), [_target([[10, 10, 60, 70]])]).values()
    ).backward()
    assert network.roi_heads.mask_predictor.conv6_mask.weight.grad.abs().sum() > 0
    found = detect(network.eval(), [torch.randint(0, 255, (3, 96, 128), dtype=torch.uint8)])[0]
    assert found["masks"].shape[1:] == (56, 56)


def test_mini_masks_give_equal_losses(small_config):
    corners = [[10, 10, 60, 70], [64, 20, 120, 90]]
    whole = _target(corners)
    mini = {**whole, "masks": torch.ones(2, 28, 28), "frames": whole["boxes"]}
    losses = []
    for target in (whole, mini):
        torch.manual_seed(0)
        network = MaskRCNN(1, small_config)
        losses.append(network.losses(torch.rand(1, 3, 96, 128), [target]))
    for name, loss in losses[0].items():
        assert loss.item() == pytest.approx(losses[1][name].item(), rel=0.02)


def test_network_without_cqe_has_quality_one(small_config):
    network = MaskRCNN(1, dataclasses.replace(small_config, cqe="off"))
    assert "cqe" not in network.losses(torch.rand(1, 3, 96, 128), [_target([[10, 10, 60, 70]])])
    found = detect(network.eval(), [torch.randint(0, 255, (3, 96, 128), dtype=torch.uint8)])[0]
    assert torch.all(found["quality"] == 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchor_scales": (8, 16, 32)}, "3 scales for 4 or 5 levels"),
        ({"finest_stride": 8, "anchor_scales": (8, 16, 32, 64, 128)}, "5 scales for 3 or 4 levels"),
        ({"frozen_stages": 6}, "frozen_stages 6"),
        ({"weights": "IMAGENET1K_V1", "width": 0.5}, "full width"),
        ({"mask_cut": "quality", "cqe": "off"}, "mask_cut quality"),
        ({"mask_cut": "quality", "cqe_target": "boundary_iou"}, "mask_cut quality"),
    ],
)
def test_config_that_cannot_be_built_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**change)


def test_network_learns_two_images_and_their_quality(small_config):
    """Overfit for a hundred steps: boxes are found, masks fit, and CQE is near the true IoU."""
    torch.manual_seed(0)
    network = MaskRCNN(
        1, dataclasses.replace(small_config, width=0.5, fpn_channels=32, fc=64, score_threshold=0.3)
    )
    images = torch.full((2, 3, 96, 128), 0.3)
    corners = [[20, 16, 60, 80], [70, 30, 116, 70]]
    for image, (x0, y0, x1, y1) in zip(images, corners, strict=True):
        image[:, y0:y1, x0:x1] = torch.tensor([0.9, 0.2, 0.1])[:, None, None]
    targets = [_target([corner]) for corner in corners]
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1.0, 0.1, total_iters=100
    )  # to end where it has settled
    for _ in range(100):
        optimizer.zero_grad()
        sum(network.losses(images, targets).values()).backward()
        optimizer.step()
        schedule.step()
    found = detect(network.eval(), list((images * 255).to(torch.uint8)))
    for result, target in zip(found, targets, strict=True):
        assert box_iou(result["boxes"][:1], target["boxes"]).item() > 0.8
        assert (result["masks"][0] > 0.5).float().mean() > 0.9
        assert result["quality"][0] > 0.6
