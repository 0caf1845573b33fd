"""The exportable operators, where one has two ways."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.models.ops import nms_keep, nms_keep_batched


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), images=st.integers(1, 5), count=st.integers(1, 60))
def test_batched_suppression_equals_image_by_image(seed, images, count):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(images, count, 2, generator=generator) * 500
    boxes = torch.cat(
        [corner, corner + torch.rand(images, count, 2, generator=generator) * 200], dim=2
    )
    scores = torch.rand(images, count, generator=generator)
    batched = nms_keep_batched(boxes, scores, 0.5, 0.3)
    assert torch.equal(batched, nms_keep(boxes, scores, 0.5, 0.3))
    assert not batched[scores <= 0.3].any()
    assert batched.any(dim=1).equal((scores > 0.3).any(dim=1))
