# SPDX-License-Identifier: Apache-2.0
"""How many calibration vectors a device model gets, and what they cost."""

import numpy as np

from .errors import ModelError
from .model import HEAD_BYTES, RECORD_BYTES
from .trust import NODE_BYTES
from .trustfit import CELLS_MAX

# Cycles of an inference on the ATmega328P with the assembly loop, as `sparsegaze predict --on nano` counts
# them, the same for every input: those of a model without vectors, and of a vector.
# tests/unit/test_fit_choice.py holds them against tests/budget.csv.
CYCLES_BASE, CYCLES_EACH = 2770, 157.5
NANO_SLOT_BYTES = 1536  # of one of the Nano's two model slots, as its firmware says in HELLO
CELLS_LEAST = 5  # per axis, of the grid of what to expect: cells of some 9 degrees
ROOM = (NANO_SLOT_BYTES - HEAD_BYTES - NODE_BYTES * (CELLS_LEAST + 1) ** 2) // RECORD_BYTES
MOST = 64  # vectors chosen without being asked for: past this nothing is gained, and the grid gets coarser
AIM_DEG = 0.05  # rms distance to the full process
LOSS = 1.05  # and the truth error may be this much the full process's
FINE_DEG = 0.01  # rms distance below which more vectors change nothing: the output has steps of 1/128 deg


def cycles(vectors):
    """Cycles of an inference on the Nano, features in to gaze out."""
    return int(np.ceil(CYCLES_BASE + CYCLES_EACH * vectors))


def cells(vectors):
    """Cells per axis of the largest grid that a slot of the Nano has room for beside so many vectors."""
    left = NANO_SLOT_BYTES - HEAD_BYTES - RECORD_BYTES * vectors
    return int(np.clip(np.sqrt(max(left, 0) // NODE_BYTES) - 1, 1, CELLS_MAX))


def most_vectors(budget_cycles=None, n_vectors=None):
    """Vectors to make at most, from a wish and a budget (either may be None). Raises ModelError."""
    if n_vectors is not None and not 1 <= n_vectors <= ROOM:
        raise ModelError(f"{n_vectors} vectors do not fit the device", f"ask for 1 to {ROOM}")
    most = n_vectors or (MOST if budget_cycles is None else ROOM)
    if budget_cycles is None:
        return most
    fitting = int((budget_cycles - CYCLES_BASE) // CYCLES_EACH)
    if fitting < (n_vectors or 1):
        least = cycles(n_vectors or 1)
        what = f"{n_vectors} vectors" if n_vectors else "not even one vector"
        raise ModelError(
            f"{what} in {budget_cycles} cycles: that is too few",
            f"give at least --budget-cycles {least}",
        )
    return min(most, fitting)


def aim_deg(loo_deg, budget_cycles=None):
    """Rms distance from the full process, degrees, at which more vectors are of no use.

    loo_deg  leave-one-fixation-out error of the full process. A distance independent of its error adds as
    squares
    do; together they may be LOSS times the error. With a budget in cycles the vectors are there to be used:
    the
    aim is then FINE_DEG.
    """
    if budget_cycles is not None:
        return FINE_DEG
    return float(min(AIM_DEG, loo_deg * np.sqrt(LOSS**2 - 1.0)))
