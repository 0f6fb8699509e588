"""Published numbers of the paper and others. Our tables show them beside our own numbers."""

PAPER = "paper"  #: Cheng et al., One Ring to Rule Them All, ICCV 2021

_COLUMNS = "normal_mean", "normal_median", "depth_mean", "depth_median", "psnr_input", "psnr_novel"

#: Table 1: normals [°], depth [% of the bounding box], PSNR [dB] of 50 input photographs and of 50 novel ones.
TABLE1 = [
    {"capture": name, "by": PAPER, **dict(zip(_COLUMNS, numbers))}
    for name, numbers in {
        "bunny": (3.61, 2.21, 0.18, 0.09, 33.9, 33.5),
        "girl": (4.81, 1.84, 0.40, 0.14, 31.1, 30.2),
        "head": (2.45, 1.50, 0.16, 0.09, 32.0, 29.5),
        "pig": (4.10, 1.97, 0.22, 0.11, 36.5, 37.4),
        "sofa": (5.44, 2.12, 0.55, 0.26, 30.0, 29.9),
        "teapot": (5.75, 2.55, 0.30, 0.11, 29.8, 27.6),
        "tool": (3.00, 1.18, 0.24, 0.14, 33.1, 31.6),
    }.items()
]  # fmt: skip

#: Table 2, DiLiGenT-MV: normals [°] and depth [mm].
TABLE2 = [
    {"object": name, "by": PAPER, "normal_mean": normal, "depth_mm": depth}
    for name, normal, depth in (("bear", 4.42, 0.75), ("buddha", 12.08, 0.67), ("cow", 4.21, 0.77),
                                ("pot2", 6.63, 0.58), ("reading", 7.61, 0.58))
]  # fmt: skip

#: Table 3: the bunny with a poor calibration. The paper does not say of which photographs the PSNR is.
TABLE3 = [
    {"capture": "bunny", "cameras": "wrong", "by": PAPER, "normal_mean": 10.3, "depth_mean": 1.34, "psnr_novel": 25.6},
    {"capture": "bunny", "cameras": "refined", "by": PAPER, "normal_mean": 6.60, "depth_mean": 0.65,
     "psnr_novel": 32.9},
]  # fmt: skip
