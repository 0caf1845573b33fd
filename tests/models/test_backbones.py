"""Backbones against torchvision's: equal tensors and strides, other dilations, no holes."""

import pytest
import torch
from torchvision.models import mobilenet_v2, resnet18, resnet50
from torchvision.models.feature_extraction import create_feature_extractor
from torchvision.ops import FrozenBatchNorm2d

from cohdc_train.models.frozen_norm import FrozenNorm
from cohdc_train.models.mobilenet_v1 import MobileNetV1
from cohdc_train.models.mobilenet_v2 import MobileNetV2
from cohdc_train.models.resnet import HDCResNet

PLAIN = ((1,),) * 4


@pytest.mark.parametrize(("depth", "build"), [(18, resnet18), (50, resnet50)])
def test_undilated_resnet_equals_torchvision(tmp_path, depth, build):
    torch.manual_seed(0)
    reference = build(weights=None).eval()
    torch.save(reference.state_dict(), tmp_path / "weights.pth")
    backbone = HDCResNet(depth, rates=PLAIN).eval()
    backbone.load(str(tmp_path / "weights.pth"))
    image = torch.rand(1, 3, 64, 96)
    stages = create_feature_extractor(reference, {f"layer{i + 1}": str(i) for i in range(4)})(image)
    features = backbone(image)
    for name in "0123":
        torch.testing.assert_close(features[name], stages[name])


@pytest.mark.parametrize("depth", [18, 34, 50, 101])
def test_dilation_keeps_strides_and_channels(depth):
    backbone = HDCResNet(depth, width=0.25).eval()
    features = backbone(torch.zeros(1, 3, 64, 128))
    sides = [tuple(f.shape[1:]) for f in features.values()]
    assert sides == [
        (c, 64 // s, 128 // s) for c, s in zip(backbone.out_channels, (4, 8, 16, 32), strict=True)
    ]


def test_strided_convolution_keeps_rate_one_and_pattern_follows():
    backbone = HDCResNet(50)
    rates = [block.conv2.dilation[0] for block in backbone.layer3]
    assert rates == [1, 1, 2, 3, 1, 2]
    assert [block.conv2.dilation[0] for block in backbone.layer1] == [1, 2, 3]


def test_backbone_refuses_pattern_with_holes():
    with pytest.raises(ValueError, match="leave holes"):
        HDCResNet(18, rates=((2,), (1,), (1,), (1,)))


def test_three_patterns_are_refused():
    with pytest.raises(ValueError, match="3 patterns for 4 stages"):
        HDCResNet(18, rates=((1,),) * 3)


def test_frozen_stages_keep_weights_and_statistics():
    backbone = HDCResNet(18, width=0.25, frozen_stages=2).train()
    before = {name: value.clone() for name, value in backbone.state_dict().items()}
    optimizer = torch.optim.SGD([p for p in backbone.parameters() if p.requires_grad], lr=1.0)
    backbone(torch.rand(2, 3, 64, 64))["3"].sum().backward()
    optimizer.step()
    changed = {
        name.split(".")[0]
        for name, value in backbone.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"layer2", "layer3", "layer4"}


def test_weights_of_another_depth_are_refused_by_name(tmp_path):
    torch.save(resnet50(weights=None).state_dict(), tmp_path / "r50.pth")
    with pytest.raises(ValueError, match=r"r50\.pth: layer1\.0\.conv1\.weight is \[64, 64, 1, 1\]"):
        HDCResNet(18).load(str(tmp_path / "r50.pth"))


def test_missing_file_lists_the_published_names(tmp_path):
    with pytest.raises(FileNotFoundError, match="IMAGENET1K_V1"):
        HDCResNet(18).load(str(tmp_path / "nothing.pth"))


def test_mobilenets_strides_channels_and_pattern():
    backbone = MobileNetV1(width=0.25, rates=((1, 2, 3),) * 4, frozen_stages=1).eval()
    features = backbone(torch.zeros(1, 3, 64, 128))
    assert [tuple(f.shape[1:]) for f in features.values()] == [
        (32, 16, 32),
        (64, 8, 16),
        (128, 4, 8),
        (256, 2, 4),
    ]
    # behind each strided convolution the pattern begins; the first stage has one before its stride
    assert backbone.rates() == [(1, 1, 2), (1, 1), (1, 1, 2, 3, 1, 2), (1, 1)]
    assert not any(p.requires_grad for p in backbone.stem_block.parameters())


def test_mobilenet_v2_equals_torchvision(tmp_path):
    torch.manual_seed(0)
    reference = mobilenet_v2(weights=None).eval()
    torch.save(reference.state_dict(), tmp_path / "v2.pth")
    backbone = MobileNetV2().eval()
    backbone.load(str(tmp_path / "v2.pth"))
    image = torch.rand(1, 3, 64, 96)
    names = {"features.3": "0", "features.6": "1", "features.13": "2", "features.17": "3"}
    stages = create_feature_extractor(reference, names)(image)
    features = backbone(image)
    assert [f.shape[1] for f in features.values()] == backbone.out_channels == [24, 32, 96, 320]
    for name in "0123":
        torch.testing.assert_close(features[name], stages[name])
    with pytest.raises(FileNotFoundError, match="IMAGENET1K_V2"):
        backbone.load("nothing")


@pytest.mark.parametrize("rates", [((1,),) * 4, ((1,), (1,), (1, 2), (1, 2, 3))])
def test_mobilenet_v2_strides_and_receptive_field_match_gradient(rates):
    body = MobileNetV2(width=0.25, rates=rates).eval()
    image = torch.rand(1, 3, 1536, 32, requires_grad=True)
    features = body(image)
    assert [f.shape[2] for f in features.values()] == [384, 192, 96, 48]
    features["3"][0, :, 24, 0].sum().backward()
    rows = image.grad.abs().sum(dim=(0, 1, 3)).nonzero()[:, 0]
    side = body.receptive_field()
    assert side - 4 <= int(rows.max() - rows.min()) + 1 <= side


def test_mobilenet_v1_receptive_field_matches_gradient():
    body = MobileNetV1(width=0.25).eval()
    image = torch.rand(1, 3, 1024, 64, requires_grad=True)
    body(image)["3"][0, :, 16, 1].sum().backward()
    rows = image.grad.abs().sum(dim=(0, 1, 3)).nonzero()[:, 0]
    assert int(rows.max() - rows.min()) + 1 == body.receptive_field() == 315


def test_mobilenet_sees_pixels_from_minus_one_to_one_padded_below_and_right():
    """Use a stem that copies its kernel's last corner: the pixel below and to the right."""
    body = MobileNetV1().eval()
    with torch.no_grad():
        body.stem_block.conv.weight.zero_()
        body.stem_block.conv.weight[:, 1, 1, 1] = (
            1.0  # green, the kernel's center: pixels 1, 3, 5 ...
        )
    green = torch.arange(64.0).repeat(64, 1) / 63
    image = torch.stack([torch.zeros(64, 64), green, torch.zeros(64, 64)])
    mean, std = (
        torch.tensor([0.485, 0.456, 0.406])[:, None, None],
        torch.tensor([0.229, 0.224, 0.225])[:, None, None],
    )
    seen = body.stem(((image - mean) / std)[None])[0, 0, 0]
    expected = (2 * green[0, 1::2] - 1).clamp(0, 6) / (1 + 1e-3) ** 0.5
    torch.testing.assert_close(seen, expected, atol=1e-5, rtol=0)


def test_mobilenets_weights_load_by_path_only(tmp_path):
    source = MobileNetV1()
    state = {
        name.replace("stem_block.", "stem."): value for name, value in source.state_dict().items()
    }
    torch.save(state | {"fc.weight": torch.zeros(1)}, tmp_path / "m.pth")
    target = MobileNetV1(norm="frozen")
    target.load(str(tmp_path / "m.pth"))
    assert torch.equal(target.blocks[12].pw.conv.weight, source.blocks[12].pw.conv.weight)
    with pytest.raises(FileNotFoundError, match="torchvision publishes none"):
        MobileNetV1().load("IMAGENET1K_V1")
    torch.save({"fc.weight": torch.zeros(1)}, tmp_path / "empty.pth")
    with pytest.raises(
        ValueError, match=r"empty\.pth: no tensor .* these are not MobileNetV1 weights"
    ):
        MobileNetV1().load(str(tmp_path / "empty.pth"))


@pytest.mark.parametrize(
    ("depth", "rates", "side"),
    [(18, [(1,)] * 4, 435), (50, [(1,)] * 4, 427), (34, [(1, 2, 3)] * 4, 1619)],
)
def test_receptive_field(depth, rates, side):
    assert HDCResNet(depth, width=0.125, rates=rates).receptive_field() == side


def test_receptive_field_matches_gradient():
    body = HDCResNet(18, width=0.125, rates=[(1,), (1, 2, 3), (1,), (1,)]).eval()
    side = body.receptive_field()
    image = torch.rand(1, 3, 1024, 64, requires_grad=True)
    body(image)["3"][0, :, 16, 1].sum().backward()
    rows = image.grad.abs().sum(dim=(0, 1, 3)).nonzero()[:, 0]
    assert side - 4 <= int(rows.max() - rows.min()) + 1 <= side


def test_frozen_norms_keep_half_precision_and_equal_torchvision():
    norm, reference = FrozenNorm(5), FrozenBatchNorm2d(5)
    for name, buffer in norm.named_buffers():
        buffer.uniform_(0.5, 2.0)
        reference.get_buffer(name).copy_(buffer)
    image = torch.rand(2, 5, 6, 7)
    torch.testing.assert_close(
        norm(image), reference(image), rtol=1e-6, atol=1e-6
    )  # one pass rounds differently
    half = image.bfloat16().requires_grad_()
    out = norm(half)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.float(), reference(half.float()), rtol=2**-8, atol=1e-3)
    out.float().sum().backward()
    scale = (norm.weight * (norm.running_var + norm.eps).rsqrt())[None, :, None, None]
    torch.testing.assert_close(half.grad.float(), scale.expand_as(half), rtol=2**-7, atol=0)
