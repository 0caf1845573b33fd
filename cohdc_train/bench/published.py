"""Figures that other people published: the paper's Tables 3 and 5 to 7, and SLAM systems'."""

ERRORS = ("rmse", "mean", "median", "std", "min", "max")

# Paper, Table 3: mIoU, mAP (IoU > 0.5), mAP (IoU > 0.7) of each test.
TABLE3 = {
    1: (0.485, 0.569, 0.472),
    2: (0.492, 0.586, 0.488),
    3: (0.535, 0.495, 0.406),
    4: (0.498, 0.565, 0.485),
    5: (0.294, 0.395, 0.289),
    6: (0.545, 0.558, 0.489),
    7: (0.565, 0.573, 0.493),
    8: (0.652, 0.716, 0.575),
    9: (0.429, 0.345, 0.294),
    10: (0.684, 0.725, 0.585),
}

# Paper, Tables 5, 6 and 7, "proposed SLAM": m, in the order of ERRORS. The RPE is that of all
# pairs. Table 7's mean ATE repeats Table 6's by mistake and its std is misprinted: both are None.
TABLES_5_TO_7: dict[str, dict[str, tuple[float | None, ...]]] = {
    "walking_xyz": {
        "ATE": (0.027541, 0.023047, 0.018764, 0.015077, 0.001505, 0.141699),
        "RPE": (0.038877, 0.033508, 0.030002, 0.019715, 0.0, 0.186828),
    },
    "walking_halfsphere": {
        "ATE": (0.209539, 0.195746, 0.203446, 0.074766, 0.029710, 0.364841),
        "RPE": (0.326175, 0.240677, 0.103095, 0.220147, 0.0, 0.584625),
    },
    "walking_static": {
        "ATE": (0.071849, None, 0.030831, None, 0.003704, 0.428562),
        "RPE": (0.117698, 0.052240, 0.023353, 0.105470, 0.0, 0.606306),
    },
}

# ATE RMSE in m, from the systems' own papers.
ATE_RMSE = {
    "walking_xyz": {"DynaSLAM": 0.015, "DS-SLAM": 0.0247, "NGD-SLAM": 0.015, "WF-SLAM": 0.0127},
    "walking_halfsphere": {
        "DynaSLAM": 0.025,
        "DS-SLAM": 0.0303,
        "NGD-SLAM": 0.024,
        "WF-SLAM": 0.0244,
    },
    "walking_static": {"DynaSLAM": 0.006, "DS-SLAM": 0.0081, "NGD-SLAM": 0.007, "WF-SLAM": 0.0068},
    "walking_rpy": {"DynaSLAM": 0.035, "DS-SLAM": 0.4442, "NGD-SLAM": 0.034, "WF-SLAM": 0.0252},
}
