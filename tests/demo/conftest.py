# SPDX-License-Identifier: Apache-2.0
"""The scripts of tools/, which are no package, and a report such as a good run writes."""

import copy
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent / "tools"))

GOOD = {
    "seed": 1,
    "fresh": False,
    "setup_s": 1.0,
    "total_s": 100.0,
    "flash": {"bytes": 20854, "verified": True, "seconds": 4.5},
    "model": {"n_vectors": 64, "crc_host": "0BADCAFE", "crc_before": "0BADCAFE", "crc_device": "0BADCAFE"},
    "stream": {
        "seconds": 25.0,
        "wall_seconds": 25.01,
        "rate_hz": 640.4,
        "limit_hz": 640,
        "frames": 16010,
        "lost": 0,
        "torn": 0,
        "differing": 0,
        "bit_identical": True,
    },
    "accuracy": {
        "mean_deg": 0.70,
        "median_deg": 0.60,
        "p95_deg": 1.50,
        "accuracy_deg": 0.55,
        "rms_s2s_deg": 0.25,
        "data_loss": 0.1,
        "to_true_gaze_mean_deg": 0.6,
        "gp64_mean_deg": 0.71,
    },
    "inference": {"cycles": 15900.0},
    "frame": {"cycles": 22700.0, "period_cycles": 24984.0},
    "fast": {"n_vectors": 18, "rate_hz": 1001.0, "limit_hz": 1001, "lost": 0, "late": 0},
    "latency_ms": {
        "mean_sample_to_last_byte": 2.1,
        "mean_sample_to_last_byte_max": 2.2,
        "last_sample_to_last_byte": 1.25,
        "last_sample_to_last_byte_max": 1.3,
    },
}


@pytest.fixture
def good():
    """A report that meets every bar, to be spoiled."""
    return copy.deepcopy(GOOD)
