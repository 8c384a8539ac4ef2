"""What the two papers claim, in figures. P: Valiente et al., Table III; T: Toghi et al., section 6."""

from __future__ import annotations

# our networks that stand for P's VFN and VFN + P in every table
VFN, VFN_P = "vfn-demonstrated", "vfn-p-demonstrated"
APPROACHES = (
    "conv2d-dqn",
    "conv3d-a2c",
    "conv3d-dqn",
    "safe-dqn",
    VFN,
    VFN_P,
)  # P, Table III, top to bottom

# P, Table III: crashes in % of episodes under mixed behaviours; world -> approach.
TABLE_3 = {
    "exit": dict(zip(APPROACHES, (24.62, 9.23, 3.91, 2.51, 2.47, 1.91), strict=True)),
    "merge": dict(zip(APPROACHES, (29.12, 14.99, 2.59, 1.95, 1.96, 1.04), strict=True)),
    "roundabout": dict(zip(APPROACHES, (49.03, 21.17, 14.62, 9.04, 8.94, 7.01), strict=True)),
    "intersection": dict(zip(APPROACHES, (54.78, 36.62, 24.30, 18.67, 17.90, 11.10), strict=True)),
    "highway": dict(zip(APPROACHES, (17.21, 7.43, 1.31, 0.44, 0.39, 0.31), strict=True)),
}

# T, section 6 and figure 5: how far the merging vehicle comes, m.
MERGING_EGOISTIC, MERGING_ALTRUISTIC = 220.0, 450.0
