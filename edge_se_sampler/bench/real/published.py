"""What others have published of NeRF-synthetic: test PSNR at 800 x 800 over all 200 test views, in front of white
unless a name says otherwise, and how long a training took on one GPU."""

from __future__ import annotations

from dataclasses import dataclass

PIXELS = 800


@dataclass(frozen=True)
class Published:
    """A method's result, by its paper."""

    method: str
    source: str
    seconds: float
    training: str
    """The seconds in words, and the GPU."""
    psnr: dict[str, float]
    """By scene."""


PUBLISHED = (
    Published("NeRF", "Mildenhall et al. 2020", 36 * 3600, "one to two days, V100", {"lego": 32.54, "chair": 33.00}),
    Published("DVGO", "Sun et al. 2022", 15 * 60, "15 minutes, RTX 2080 Ti", {"lego": 34.64, "chair": 34.09}),
    Published(
        "Plenoxels", "Fridovich-Keil et al. 2022", 11 * 60, "11 minutes, one GPU", {"lego": 34.10, "chair": 33.98}
    ),
    Published("TensoRF VM-192", "Chen et al. 2022", 17 * 60, "17 minutes, V100", {"lego": 36.46, "chair": 35.76}),
    Published(
        "instant-ngp on black", "Mueller et al. 2022", 5 * 60, "5 minutes, RTX 3090",
        {"lego": 36.39, "chair": 35.00},
    ),
    Published("instant-ngp in nerfacc", "Li et al. 2023", 269, "269 seconds, one GPU", {"lego": 35.67}),
)  # fmt: skip
