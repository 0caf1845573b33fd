"""ONNX contract between training and the robot: names, shapes, dtypes and units of the tensors.

B images of one call share a height H and a width W, both free at run time. N (padded detections)
and M (side of a mask) are fixed in the file. Rows from `count` on are padding and hold zeros.

| tensor | dtype, shape | meaning |
|---|---|---|
| images | uint8 [B, H, W, 3] | RGB |
| boxes | float32 [B, N, 4] | xyxy, px of the input image, origin at the corner of its first pixel |
| labels | int64 [B, N] | index into the class names |
| scores | float32 [B, N] | class score, falling |
| quality | float32 [B, N] | CQE's estimate of the mask's IoU with the object, 0..1 |
| masks | float32 [B, N, M, M] | mask in its box, cut at `KEY_THRESHOLDS`; see below |
| count | int64 [B] | number of leading rows that are detections |

The center of a mask's cell (i, j) lies at (i + .5) / M and (j + .5) / M of the box's sides.
"""

CONTRACT_VERSION = 1

INPUT = "images"
OUTPUTS = ("boxes", "labels", "scores", "quality", "masks", "count")

# Metadata keys of the file. Values are strings; those marked JSON are parsed.
KEY_CONTRACT = "cohdc.contract"  # CONTRACT_VERSION
KEY_VERSION = "cohdc.version"  # version of the package that wrote the file
KEY_CLASSES = "cohdc.classes"  # JSON: [name, ...] in label order
KEY_INPUT = "cohdc.input"  # JSON: {"color", "layout", "dtype", "canvas": [height, width], "resize"}
KEY_THRESHOLDS = (
    "cohdc.thresholds"  # JSON: {"score", "nms_iou", "mask", "mask_cut": "half", or "quality"}
)
METADATA_KEYS = (KEY_CONTRACT, KEY_VERSION, KEY_CLASSES, KEY_INPUT, KEY_THRESHOLDS)
