"""What is claimed of the ways of choosing pixels, by those who published them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """In one line, and where it is made."""

    text: str
    source: str


_PAPER = "Important Pixels Sampling, section 4, tables 1 to 4"
_SE = Claim("accelerates training, with all views and with ten", _PAPER)
_NO_ABLATION = "no significant influence on quality, says torch-ngp's author"

CLAIMS = {
    "precrop": Claim("keeps small objects before much white from diverging", "bmild/nerf, issue 29"),
    "edge": Claim("stable wherever the object is; no worse than precrop where that works", _PAPER),
    "se": _SE,
    "se-coarse": _SE,
    "se-cached": _SE,
    "edge-se": Claim("stable from the edges, faster from the errors", _PAPER),
    "error-map": Claim(_NO_ABLATION, "ashawkey/torch-ngp, issue 20"),
    "error-cdf": Claim(_NO_ABLATION, "ashawkey/torch-ngp, issue 20, on instant-ngp's"),
    "soft-mining": Claim("converges more than twice as fast", "Kheradmand et al. 2024, abstract"),
    "actray": Claim("trains 6.5 times as fast", "Wu et al. 2023, abstract"),
    "regions": Claim("converges faster, better in textured regions", "Sun et al. 2023, arXiv 2308.15547, abstract"),
    "quadtree": Claim(
        "far fewer rays, comparable accuracy, much faster", "Zhang et al. 2022, arXiv 2208.06821, abstract"
    ),
    "expansive": Claim(
        "52 % less memory and 16 % less time at comparable quality", "Zhang et al. 2024, arXiv 2409.08056, abstract"
    ),
    "hard-samples": Claim(
        "1 dB better at equal time, or twice as fast; 40 % less memory",
        "Korhonen et al. 2024, arXiv 2408.03193, abstract, of Instant-NGP",
    ),
}
"""By the names of `trials.STRATEGIES`; nobody claims anything of the others."""
