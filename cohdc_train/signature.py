"""The ONNX contract between the workstation that trains and the robot that runs: names, shapes,
dtypes, units.

B images of one call share a height H and a width W, both free at run time. N (padded detections)
and M (mask side) are fixed in the file. Rows at or after `count` are padding and hold zeros.

| tensor | dtype, shape | meaning |
|---|---|---|
| images | uint8 [B, H, W, 3] | RGB |
| boxes | float32 [B, N, 4] | xyxy, px of the input image, origin at the corner of its first pixel |
| labels | int64 [B, N] | index into the class names |
| scores | float32 [B, N] | class score, falling |
| quality | float32 [B, N] | CQE's estimate of the mask's IoU with the object, 0..1 |
| masks | float32 [B, N, M, M] | of the box, cut at `KEY_THRESHOLDS`; cell (i, j) is centered (i +
.5) / M of its side |
| count | int64 [B] | how many leading rows are detections |
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
